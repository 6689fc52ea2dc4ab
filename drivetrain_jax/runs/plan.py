"""Plan of a block: a solver for every point, and chunks of points of similar effort, with one chunk size per solver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from drivetrain_jax._machine import usable_cores
from drivetrain_jax._threads import in_double_precision
from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.point_grid import Grid

# A block: predicted work of one core in s, upper limits of its points and of the bytes of its results, and least number of
# full chunks, so that padding the last one costs little. Chunks of lengthy points need no such limit.
_SECONDS, _MOST_POINTS, _MOST_BYTES, _LEAST_CHUNKS = 2.0, 1 << 18, 1 << 28, 8
# Number of points from which the work of a block is predicted.
_SAMPLE = 1024
# Points whose effort is predicted together (small enough for the cache).
_PIECE = 1 << 15
# Effort and position of a point share one integer.
_MAX_EFFORT, _BITS = 2**31 - 1, 32
# Least number of chunks per solver in a small scene. A constant, because bits must not depend on the number of cores.
_MIN_CHUNKS = 2
# Points of the smallest chunk of more than one point.
_LANES = 16


@dataclass(frozen=True)
class Chunk:
    """Points for one call of a kernel: position of the solver, padded ``size``, largest ``effort``, and predicted ``cost``.

    ``rows`` are the positions of the ``points`` in their block.
    """

    solver: int
    size: int
    rows: np.ndarray
    points: np.ndarray
    effort: int
    cost: float


def block_size(solvers: Sequence[Solver], grid: Grid) -> int:
    """Number of points of a block (lines along the path, if there is one); depends on grid and solvers alone."""
    sample = np.unique(np.linspace(0, grid.size - 1, min(grid.size, _SAMPLE)).astype(np.int64))
    choice, effort = _cheapest(solvers, grid, sample)
    seconds = float(np.mean(effort * np.array([*(solver.seconds for solver in solvers), 0.0])[choice]))
    seconds *= grid.path_length
    lines = max(min(_MOST_POINTS, _MOST_BYTES // max(grid.result_bytes, 1)) // grid.path_length, 1)
    least = max(solver.chunk * (1 if solver.lengthy else _LEAST_CHUNKS) for solver in solvers)
    wanted = math.ceil(_SECONDS / seconds) if seconds > _SECONDS / lines else lines
    return min(max(wanted, least), lines)


def make_plan(
    solvers: Sequence[Solver], grid: Grid, points: np.ndarray, *, full_size: bool = False
) -> tuple[Chunk, ...]:
    """Chunks of ``points``, each by the solver of the smallest predicted cost; the most expensive chunk comes first.

    Points of infinite predicted cost belong to no chunk. Chunks of few points are smaller, unless they have ``full_size``;
    so those of several blocks need no further kernels.
    """
    pieces = [points[start : start + _PIECE] for start in range(0, len(points), _PIECE)]
    if len(pieces) > 1:
        with ThreadPoolExecutor(min(usable_cores(), len(pieces)), "plan", initializer=in_double_precision) as pool:
            predicted = list(pool.map(lambda piece: _cheapest(solvers, grid, piece), pieces))
    else:
        predicted = [_cheapest(solvers, grid, points)]
    choice, effort = (np.concatenate(column) for column in zip(*predicted, strict=True))
    chunks: list[Chunk] = []
    for index, solver in enumerate(solvers):
        rows = np.flatnonzero(choice == index)
        if not rows.size:
            continue
        # Effort and position in one integer: sorting it is the fastest way to sort by both.
        keys = ((_MAX_EFFORT - effort[rows]) << _BITS) | rows
        keys.sort()
        rows = keys & ((1 << _BITS) - 1)
        size = solver.chunk if full_size else chunk_size(solver.chunk, rows.size, solver.lengthy)
        for start in range(0, rows.size, size):
            part = rows[start : start + size]
            most = int(effort[part[0]])
            chunks.append(Chunk(index, size, part, points[part], most, most * solver.unit_cost * size))
    return tuple(sorted(chunks, key=lambda chunk: -chunk.cost))


def chunk_size(largest: int, count: int, lengthy: bool = False) -> int:
    """Points per chunk for ``count`` points, at most ``largest``; fewer in small scenes, to give all cores work.

    Sizes are 1, 16 and larger powers of two, so that another count seldom needs another kernel. ``lengthy`` points, which
    take long, may also have the sizes 2 to 8.
    """
    share = count if count <= _LANES else -(-count // _MIN_CHUNKS)
    least = 1 if lengthy or count == 1 else _LANES
    return min(largest, max(least, 1 << (share - 1).bit_length()))


def mean_cost(solvers: Sequence[Solver], grid: Grid, points: np.ndarray) -> float:
    """Mean predicted cost of these points, in units of the plan; points that no solver can compute cost nothing."""
    choice, effort = _cheapest(solvers, grid, points)
    unit = np.array([*(solver.unit_cost for solver in solvers), 0.0])
    return float(np.mean(effort * unit[choice]))


def _cheapest(solvers: Sequence[Solver], grid: Grid, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position of the cheapest solver (-1 if all costs are infinite) and its effort, for each of ``points``."""
    columns = grid.arrays(points)
    best, effort, cost = np.full(points.shape, -1), np.zeros(points.shape), np.full(points.shape, np.inf)
    for index, solver in enumerate(solvers):
        own = np.broadcast_to(np.asarray(solver.effort(columns), float), points.shape)
        with np.errstate(over="ignore"):
            own_cost = own * solver.unit_cost
        # False for a cost of NaN or infinity.
        less = own_cost < cost
        best[less], cost, effort = index, np.where(less, own_cost, cost), np.where(less, own, effort)
    return best, np.ceil(np.clip(effort, 0, _MAX_EFFORT)).astype(np.int64)
