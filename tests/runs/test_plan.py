"""Which solver computes which points, in which blocks and chunks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs import job
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.job import Block, block_size, chunk_size, make_plan
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.store.parts import Shards
from drivetrain_jax.systems import get_system

pytestmark = pytest.mark.usefixtures("small_blocks")


def engine(scene):
    return resolve(load_scene(scene))


def test_every_point_is_in_exactly_one_chunk_of_the_cheapest_solver(grid_scene):
    e = engine(grid_scene)
    assert e.boxes.count > 2
    for some in (None, np.arange(0, 123, 3)):
        chunks = [chunk for block in e.blocks(some) for chunk in e.plan(block)]
        assert sorted(np.concatenate([c.points for c in chunks])) == list(range(123) if some is None else some)
    for block in e.blocks():
        chunks, points = e.plan(block), e.points(block)
        assert [c.cost for c in chunks] == sorted((c.cost for c in chunks), reverse=True)
        for chunk in chunks:
            assert np.array_equal(points[chunk.rows], chunk.points)
            columns, name = e.grid.columns(chunk.points), e.solvers[chunk.solver].name
            cheap = (columns["a"] <= toy.LARGE) & (10 * columns["a"] <= 200 * columns["b"])
            assert np.all(cheap == (name == "broadcasting"))
            efforts = 10 * columns["a"] if name == "broadcasting" else 100 * columns["b"]
            assert chunk.effort == np.ceil(efforts.max()) and np.all(np.diff(efforts) <= 0)


def test_only_a_job_of_one_point_takes_the_program_of_one_point():
    """One point of a chart, left by others that are reused or in the last block, takes the program of the chart."""
    fixed = {"beta": 0.3, **get_system("cardan").presets["base"]}
    for values in ([1.0], [1.0, 2.0]):
        axes = {"Omega": {"values": values}}
        e = engine({"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": fixed})
        ((chunk,),) = [e.plan(block) for block in e.blocks(np.array([0]))]
        assert e.solvers[chunk.solver].name.endswith("one point") == (len(values) == 1)


def test_an_atlas_of_multipliers_has_no_grid_but_solvers():
    axes, fixed = {"Omega": {"start": 1.0, "stop": 1.1}}, {"beta": 0.3, **get_system("cardan").presets["base"]}
    scene = {"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": fixed, "outputs": ["floquet_multiplier"]}
    (solver,) = engine(scene).solvers
    assert not solver.single


def test_plan_does_not_depend_on_how_effort_is_predicted(grid_scene, monkeypatch):
    whole = engine(grid_scene).plan(Block(0))
    monkeypatch.setattr(job, "_PIECE", 7)
    for a, b in zip(whole, engine(grid_scene).plan(Block(0)), strict=True):
        assert np.array_equal(a.points, b.points) and a.effort == b.effort


@pytest.mark.parametrize(
    ("seconds", "lengthy", "points"), [(1e-9, False, 1 << 18), (1e-3, False, 2000), (1.0, False, 128), (1.0, True, 16)]
)
def test_a_block_takes_two_seconds(monkeypatch, seconds, lengthy, points):
    monkeypatch.setattr(job, "_SECONDS", 2.0)
    monkeypatch.setattr(job, "_LEAST_CHUNKS", 8)
    axes = {n: {"start": 1, "stop": 2, "num": 40_000} for n in ("a", "b")}
    grid = engine({"system": "toy", "analysis": "toy", "axes": axes}).grid
    assert block_size([Solver("s", lambda *_: {}, chunk=16, seconds=seconds, lengthy=lengthy)], grid) == points
    assert grid.columns(np.array([0, grid.size - 1]))["a"].tolist() == [1, 2]


@pytest.mark.parametrize(("seconds", "points"), [(5e-6, 62_496), (1e-6, 250_000), (1e-3, 2000)])
def test_a_run_of_a_few_seconds_has_sixteen_blocks(monkeypatch, seconds, points):
    monkeypatch.setattr(job, "_SECONDS", 2.0)
    axes = {n: {"start": 1, "stop": 2, "num": 1000} for n in ("a", "b")}
    grid = engine({"system": "toy", "analysis": "toy", "axes": axes}).grid
    assert block_size([Solver("s", lambda *_: {}, chunk=16, seconds=seconds)], grid) == points


def test_a_chunk_is_no_longer_than_its_block():
    """Every lane of padding costs as much as a point."""
    grid = Grid.of(load_scene({"system": "toy", "analysis": "toy", "points": {"a": np.linspace(1, 2, 34).tolist()}}))
    fast, slow = (Solver("s", lambda *_: {}, lambda columns: np.ones(34), unit_cost=c, chunk=64) for c in (1.0, 2.0))
    for longest, sizes in ((40, [40]), (16, [16, 16, 16]), (80, [64]), (None, [64])):
        assert [chunk.size for chunk in make_plan([slow, fast], grid, np.arange(34), longest)] == sizes


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
    solver = Solver("s", lambda *_: {}, lambda columns: np.array(effort), unit_cost=1e291)
    chunks = make_plan([solver], grid, np.arange(2))
    assert sum(chunk.points.size for chunk in chunks) == planned
    assert all(0 <= chunk.effort < 2**31 for chunk in chunks)


@pytest.mark.parametrize(
    ("largest", "count", "expected"),
    [(256, 1, 1), (256, 3, 16), (256, 16, 16), (256, 17, 16), (256, 70, 64), (256, 1000, 256), (8, 1000, 8), (1, 5, 1)],
)
def test_chunk_size(largest, count, expected):
    solver = Solver("s", lambda *_: {}, seconds=1e-3, chunk=largest)
    assert chunk_size(solver, count) == expected
    assert chunk_size(replace(solver, seconds=1e-5), count, effort=100) == expected


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (16, 16), (17, 256), (1000, 256)])
def test_a_chunk_that_takes_no_time_is_not_divided(count, expected):
    assert chunk_size(Solver("s", lambda *_: {}, seconds=1e-5, chunk=256), count, effort=5) == expected


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (3, 4), (16, 16), (17, 16), (33, 32)])
def test_lengthy_points_are_not_padded_to_a_whole_chunk(count, expected):
    assert chunk_size(Solver("s", lambda *_: {}, seconds=1.0, lengthy=True), count) == expected


def test_grid_numbers_points_in_c_order():
    e = engine({"system": "toy", "analysis": "toy", "axes": {"b": {"values": [1, 3, 2]}, "a": {"values": [0, 1]}}})
    columns = e.grid.columns(np.arange(6))
    assert columns["b"].tolist() == [1, 1, 3, 3, 2, 2] and columns["a"].tolist() == [0, 1, 0, 1, 0, 1]


@pytest.mark.parametrize(
    ("shape", "path", "lengths"),
    [
        ((), None, ()),
        ((7,), None, (7,)),
        ((1000, 1000), None, (262, 1000)),
        ((3, 2, 1_000_000), None, (1, 1, 262_144)),
        ((10, 262_145), None, (1, 262_144)),
        ((2, 1_000_000), 1, (2, 1_000_000)),
    ],
)
def test_boxes_cover_the_sweep_once(shape, path, lengths):
    found = Shards.of(shape, path, 1 << 18)
    assert found.lengths == lengths
    seen, starts, inside = np.zeros(shape, np.int8), found.starts(path), 1 if path is None else shape[path]
    before = 0
    for shard in range(found.count):
        assert starts[shard] * inside == before
        seen[found.place(shard)] += 1
        before += seen[found.place(shard)].size
    assert (seen == 1).all() and starts[-1] * inside == seen.size
