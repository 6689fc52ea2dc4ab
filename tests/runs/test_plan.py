"""Which solver computes which points, in which chunks."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import toy

from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.plan import chunk_size, make_plan
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene


def engine(scene):
    return resolve(load_scene(scene))


def test_every_point_is_in_exactly_one_chunk_of_the_cheapest_solver(grid_scene):
    e = engine(grid_scene)
    chunks = [e.plan.chunk(number) for number in range(len(e.plan.costs))]
    assert sorted(np.concatenate([c.points for c in chunks])) == list(range(e.total))
    for chunk in chunks:
        columns = e.grid.columns(chunk.points)
        cheap = (columns["a"] <= toy.LARGE) & (10 * columns["a"] <= 200 * columns["b"])
        name = e.solvers[chunk.solver].name
        assert np.all(cheap == (name == "broadcasting"))
        efforts = 10 * columns["a"] if name == "broadcasting" else 100 * columns["b"]
        assert chunk.effort == np.ceil(efforts.max())


def test_points_of_a_solver_are_sorted_by_effort(grid_scene):
    for group in engine(grid_scene).plan.groups:
        assert np.all(np.diff(group.efforts) <= 0)


def chunks_of(scene):
    plan = engine(scene).plan
    return [plan.chunk(number) for number in range(len(plan.costs))]


def test_plan_does_not_depend_on_how_effort_is_predicted(grid_scene, monkeypatch):
    whole = chunks_of(grid_scene)
    monkeypatch.setattr("drivetrain_jax.runs.plan._PIECE", 7)
    for a, b in zip(whole, chunks_of(grid_scene), strict=True):
        assert np.array_equal(a.points, b.points) and a.effort == b.effort


def test_blocks_are_sorted_one_by_one(grid_scene, monkeypatch):
    """Each point occurs once, in its block, and with the same solver as without blocks.

    Chunks are full except the last one of a block, and are ordered block by block.
    """
    whole = chunks_of(grid_scene)
    solver = {point: chunk.solver for chunk in whole for point in chunk.points}
    monkeypatch.setattr("drivetrain_jax.store.shards.MOST_POINTS", 50)
    plan = engine(grid_scene).plan
    chunks = [plan.chunk(number) for number in range(len(plan.costs))]
    assert sorted(np.concatenate([c.points for c in chunks])) == sorted(solver)
    assert {point: c.solver for c in chunks for point in c.points} == solver
    assert (
        {(c.solver, c.size) for c in chunks} == {(c.solver, c.size) for c in whole} == plan.kernels(range(len(chunks)))
    )
    blocks = [set((c.points // 41).tolist()) for c in chunks]
    assert all(len(block) == 1 for block in blocks) and max(max(block) for block in blocks) > 1
    order = [(*blocks[number], -plan.costs[number]) for number in plan.ordered(range(len(chunks)))]
    assert order == sorted(order)
    for group in plan.groups:
        counts = np.bincount([point // 41 for point, index in solver.items() if index == group.index], minlength=3)
        assert np.array_equal(np.diff(group.firsts), -(-counts // group.chunk)) and group.size == counts.sum()


def test_memory_of_a_plan_grows_with_its_chunks(monkeypatch):
    """Memory grows with the number of chunks, not with the number of points."""
    monkeypatch.setattr("drivetrain_jax.store.shards.MOST_POINTS", 1 << 12)
    monkeypatch.setattr("drivetrain_jax.runs.plan._PIECE", 1 << 10)

    def kept(rows):
        axes = {"b": {"start": 1, "stop": 1 + rows / 1000, "num": rows}, "a": {"start": 1, "stop": 2, "num": 1024}}
        tracemalloc.start()
        plan = engine({"system": "toy", "analysis": "toy", "axes": axes}).plan
        assert plan.size == rows * 1024
        memory = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return memory

    kept(2)
    assert kept(384) - kept(128) < 256 * 1024 / 2


@pytest.mark.parametrize(
    ("effort", "planned"),
    [
        ([2.0**62, 1.0], 1),
        ([2.0**62, 2.0**62], 0),
        ([1.0, 2.0**40], 2),
        ([np.nan, 3.0], 1),
        ([np.inf, np.inf], 0),
        ([-1.0, 0.0], 2),
    ],
)
def test_extreme_efforts(effort, planned):
    """Points of infinite, overflowing or undefined cost have no solver, and efforts stay in the range of a counter."""
    grid = Grid.of(load_scene({"system": "toy", "analysis": "toy", "points": {"a": [1.0, 2.0]}}))
    plan = make_plan([Solver("s", None, lambda columns: np.array(effort), unit_cost=1e291)], grid)
    assert plan.size == planned
    assert all(0 <= e < 2**31 for group in plan.groups for e in group.efforts)


@pytest.mark.parametrize(
    ("largest", "count", "expected"),
    [(256, 1, 1), (256, 3, 16), (256, 16, 16), (256, 17, 16), (256, 70, 64), (256, 1000, 256), (8, 1000, 8), (1, 5, 1)],
)
def test_chunk_size(largest, count, expected):
    assert chunk_size(largest, count) == expected


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (3, 4), (16, 16), (17, 16), (33, 32)])
def test_lengthy_points_are_not_padded_to_a_whole_chunk(count, expected):
    assert chunk_size(256, count, lengthy=True) == expected


def test_grid_numbers_points_in_c_order():
    e = engine({"system": "toy", "analysis": "toy", "axes": {"b": {"values": [1, 3, 2]}, "a": {"values": [0, 1]}}})
    columns = e.grid.columns(np.arange(6))
    assert columns["b"].tolist() == [1, 1, 3, 3, 2, 2] and columns["a"].tolist() == [0, 1, 0, 1, 0, 1]


def test_a_huge_grid_is_planned_by_number_alone():
    grid = engine(
        {"system": "toy", "analysis": "toy", "axes": {n: {"start": 1, "stop": 2, "num": 40_000} for n in ("a", "b")}}
    ).grid
    assert grid.size == 1_600_000_000
    columns = grid.columns(np.array([0, grid.size - 1]))
    assert columns["a"].tolist() == [1, 2] and columns["b"].tolist() == [1, 2]
