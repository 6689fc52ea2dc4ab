"""Who computes what: a solver for every point, points of similar effort together, chunks of one shape per solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivetrain_jax.analysis import Solver
from drivetrain_jax.sweep.grid import Grid

# Points whose effort is predicted at a time.
_BLOCK = 1 << 18
_MAX_EFFORT = 2**31 - 1
# Small scenes are cut into at least this many chunks per solver. It is not the number of cores: bits must not depend
# on that.
_MIN_CHUNKS = 2
_LANES = 16


@dataclass(frozen=True)
class Group:
    """The points of one solver: ``order`` their numbers by rising effort, cut into ``len(efforts)`` chunks.

    ``index`` is the position of the solver, ``efforts`` the largest effort within each chunk.
    """

    index: int
    solver: Solver
    order: np.ndarray
    efforts: np.ndarray
    chunk: int


@dataclass(frozen=True)
class Chunk:
    """Number, position of the solver, points, the ``size`` that they are filled up to, and the largest effort.

    It says all that a worker has to know beside the scene.
    """

    number: int
    solver: int
    size: int
    points: np.ndarray
    effort: int


@dataclass(frozen=True)
class Plan:
    """All chunks, numbered through the groups. Points for which every solver predicts infinite cost are in none."""

    groups: tuple[Group, ...]

    @property
    def costs(self) -> np.ndarray:
        """Predicted cost of every chunk, in units of its own."""
        return np.concatenate([np.empty(0), *(g.efforts * (g.solver.unit_cost * g.chunk) for g in self.groups)])

    def chunk(self, number: int) -> Chunk:
        """Chunk number ``number``."""
        first = 0
        for group in self.groups:
            k = number - first
            if k < len(group.efforts):
                points = group.order[k * group.chunk : (k + 1) * group.chunk]
                return Chunk(number, group.index, group.chunk, points, int(group.efforts[k]))
            first += len(group.efforts)
        raise IndexError(number)


def chunk_size(largest: int, count: int) -> int:
    """Points per chunk for ``count`` points, at most ``largest``; fewer in small scenes, to give all cores work."""
    if count <= _LANES:
        return min(largest, 1 << (count - 1).bit_length())
    share = -(-count // _MIN_CHUNKS)
    return min(largest, -(-share // _LANES) * _LANES)


def make_plan(
    solvers: Sequence[Solver], grid: Grid, points: np.ndarray | None = None, *, full_size: bool = False
) -> Plan:
    """Give every one of ``points`` (all of ``grid``) to the solver with the smallest predicted cost, the first of equals.

    ``full_size`` keeps the size of chunks where points are few, so that further plans need no other kernels.
    """
    count = grid.size if points is None else len(points)
    # Effort and position in one number, sorted in place: 8 bytes a point are all that the plan of a large scene takes.
    # Room for all points with every solver is memory only where it is filled.
    bits = np.uint64(count.bit_length())
    keys, filled = [np.empty(count, np.uint64) for _ in solvers], [0 for _ in solvers]
    for start in range(0, count, _BLOCK):
        positions = np.arange(start, min(start + _BLOCK, count))
        choice, effort = _cheapest(solvers, grid, positions if points is None else points[positions])
        for index, key in enumerate(keys):
            mine = np.flatnonzero(choice == index)
            begin, filled[index] = filled[index], filled[index] + mine.size
            key[begin : filled[index]] = (effort[mine].astype(np.uint64) << bits) | positions[mine].astype(np.uint64)
    groups = []
    for index, solver in enumerate(solvers):
        key = keys[index][: filled[index]]
        if not key.size:
            continue
        key.sort()
        size = solver.chunk if full_size else chunk_size(solver.chunk, key.size)
        last = np.minimum(np.arange(size, key.size + size, size), key.size) - 1
        efforts = (key[last] >> bits).astype(np.int64)
        key &= (np.uint64(1) << bits) - np.uint64(1)
        order = key.view(np.int64)
        groups.append(Group(index, solver, order if points is None else points[order], efforts, size))
    return Plan(tuple(groups))


def _cheapest(solvers: Sequence[Solver], grid: Grid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position of the cheapest solver (-1 if all costs are infinite) and its effort, for each of ``points``."""
    columns = grid.arrays(points)
    efforts = np.stack([np.broadcast_to(np.asarray(s.effort(columns), float), points.shape) for s in solvers])
    efforts = np.where(np.isnan(efforts), np.inf, efforts)
    with np.errstate(over="ignore"):
        costs = efforts * np.array([s.unit_cost for s in solvers])[:, None]
    best = np.argmin(costs, axis=0)
    lanes = np.arange(points.size)
    effort = np.ceil(np.clip(efforts[best, lanes], 0, _MAX_EFFORT)).astype(np.int64)
    return np.where(np.isfinite(costs[best, lanes]), best, -1), effort
