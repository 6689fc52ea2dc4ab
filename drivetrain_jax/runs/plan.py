"""Plan of a run: a solver for every point, and chunks of points of similar effort, with one chunk size per solver.

Points are sorted block by block, so memory and the time to the first result do not grow with the grid. A plan keeps the
efforts of chunks, and sorts a block again when its chunks are computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivetrain_jax._machine import usable_cores
from drivetrain_jax._threads import in_double_precision
from drivetrain_jax.analysis import Solver
from drivetrain_jax.runs.point_grid import Grid
from drivetrain_jax.store.shards import MOST_POINTS

# Points whose effort is predicted together (small enough for the cache).
_PIECE = 1 << 15
# Number of sorted blocks that are kept.
_KEPT = 16
_BITS, _POSITION = np.uint64(32), np.uint64(2**32 - 1)
_MAX_EFFORT = 2**31 - 1
# Least number of chunks per solver in a small scene. A constant, because bits must not depend on the number of cores.
_MIN_CHUNKS = 2
# Points of the smallest chunk of more than one point.
_LANES = 16


@dataclass(frozen=True)
class Group:
    """The points of one solver, by falling effort in each block, in chunks of ``chunk`` points.

    The last chunk of a block may be shorter; it costs as much as a full one and has the least effort.

    ``index`` is the position of the solver, ``size`` the number of points, ``efforts`` the largest effort within each
    chunk, and ``firsts[b]`` the first chunk of block b (one entry more than blocks).
    """

    index: int
    solver: Solver
    size: int
    efforts: np.ndarray
    firsts: np.ndarray
    chunk: int


@dataclass(frozen=True)
class Chunk:
    """Number, position of the solver, points, padded ``size``, and largest effort of a chunk.

    A worker needs only this and the scene.
    """

    number: int
    solver: int
    size: int
    points: np.ndarray
    effort: int


@dataclass(frozen=True)
class Plan:
    """All chunks, numbered through the groups. Points of infinite predicted cost belong to no chunk."""

    groups: tuple[Group, ...]
    blocks: Blocks

    @cached_property
    def costs(self) -> np.ndarray:
        """Predicted cost of every chunk, in units of the plan."""
        return np.concatenate([np.empty(0), *(g.efforts * (g.solver.unit_cost * g.chunk) for g in self.groups)])

    @property
    def size(self) -> int:
        """Number of points in all chunks."""
        return sum(group.size for group in self.groups)

    @cached_property
    def _firsts(self) -> np.ndarray:
        """Number of the first chunk of each group, and number of all chunks."""
        return np.cumsum([0, *(len(group.efforts) for group in self.groups)])

    def kernels(self, numbers: Iterable[int]) -> set[tuple[int, int]]:
        """Pairs of solver position and chunk size of the chunks with these numbers."""
        used = np.unique(np.searchsorted(self._firsts, np.fromiter(numbers, np.int64), side="right") - 1)
        return {(self.groups[g].index, self.groups[g].chunk) for g in used}

    def ordered(self, numbers: Iterable[int]) -> np.ndarray:
        """These numbers block by block, the most expensive first in each block."""
        chosen = np.fromiter(numbers, np.int64)
        return chosen[np.lexsort((-self.costs[chosen], self.block_of[chosen]))]

    @cached_property
    def block_of(self) -> np.ndarray:
        """Number of the block of every chunk."""
        counts = [np.diff(group.firsts) for group in self.groups]
        return np.concatenate([np.empty(0, int), *(np.repeat(np.arange(len(n)), n) for n in counts)])

    def chunk(self, number: int) -> Chunk:
        """Chunk number ``number``."""
        if not 0 <= number < self._firsts[-1]:
            raise IndexError(number)
        g = int(np.searchsorted(self._firsts, number, side="right")) - 1
        group, k = self.groups[g], number - self._firsts[g]
        block = int(np.searchsorted(group.firsts, k, side="right")) - 1
        start = (k - group.firsts[block]) * group.chunk
        points = self.blocks.points(block, group.index, slice(start, start + group.chunk))
        return Chunk(int(number), group.index, group.chunk, points, int(group.efforts[k]))


class Blocks:
    """The points of a plan in blocks, each sorted on demand: the shards of the grid, or equal shares of ``points``."""

    def __init__(self, solvers: Sequence[Solver], grid: Grid, points: np.ndarray | None) -> None:
        self._solvers, self._grid, self._points = solvers, grid, points
        if points is None:
            self._starts = grid.starts
        else:
            self._starts = np.append(np.arange(0, len(points), MOST_POINTS), len(points))
        self.count = len(self._starts) - 1
        self._kept: dict[int, tuple[list[np.ndarray], list[np.ndarray]]] = {}

    def efforts(self, block: int) -> Sequence[np.ndarray]:
        """For each solver the efforts of its points in ``block``, falling."""
        return self._sorted(block)[1]

    def points(self, block: int, solver: int, part: slice) -> np.ndarray:
        """A part of the points of a solver in ``block``."""
        return self._number(self._sorted(block)[0][solver][part].astype(np.int64) + self._starts[block])

    def _number(self, positions: np.ndarray) -> np.ndarray:
        return positions if self._points is None else self._points[positions]

    def _sorted(self, block: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
        if block not in self._kept:
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[block] = self._sort(block)
        return self._kept[block]

    def _sort(self, block: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """For each solver its points, numbered within the block, and their efforts."""
        start, stop = self._starts[block : block + 2]
        pieces = [self._number(np.arange(i, min(i + _PIECE, stop))) for i in range(start, stop, _PIECE)]
        found = [_cheapest(self._solvers, self._grid, pieces[0])]
        if len(pieces) > 1:
            workers = min(usable_cores(), len(pieces) - 1)
            with ThreadPoolExecutor(workers, "plan", initializer=in_double_precision) as pool:
                found += pool.map(lambda points: _cheapest(self._solvers, self._grid, points), pieces[1:])
        choice, effort = (np.concatenate(column) for column in zip(*found, strict=True))
        orders, efforts = [], []
        for index in range(len(self._solvers)):
            mine = np.flatnonzero(choice == index).astype(np.uint64)
            # Effort and position in one integer: sorting it is the fastest way to sort by both.
            keys = ((_MAX_EFFORT - effort[mine]).astype(np.uint64) << _BITS) | mine
            keys.sort()
            orders.append((keys & _POSITION).astype(np.uint32))
            efforts.append(_MAX_EFFORT - (keys >> _BITS).astype(np.int32))
        return orders, efforts


class _EffortCounter:
    """Collects the efforts of one solver: of each point while chunks may be small, then the largest of each chunk."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self._efforts: list[np.ndarray] = []
        self.count, self._few = 0, True

    def add(self, efforts: np.ndarray) -> None:
        """Add the efforts of one more block, falling."""
        self.count += efforts.size
        self._efforts.append(efforts if self._few else efforts[:: self._solver.chunk])
        if self._few and self.count >= _MIN_CHUNKS * self._solver.chunk:
            self._few = False
            self._efforts = [block[:: self._solver.chunk] for block in self._efforts]

    def group(self, index: int, full_size: bool) -> Group:
        """The chunks of all blocks."""
        size = self._solver.chunk
        if self._few and not full_size:
            size = chunk_size(size, self.count, self._solver.lengthy)
        efforts = [block[::size] for block in self._efforts] if self._few else self._efforts
        firsts = np.cumsum([0, *map(len, efforts)])
        return Group(index, self._solver, self.count, np.concatenate(efforts), firsts, size)


def chunk_size(largest: int, count: int, lengthy: bool = False) -> int:
    """Points per chunk for ``count`` points, at most ``largest``; fewer in small scenes, to give all cores work.

    Sizes are 1, 16 and larger powers of two, so that another count seldom needs another kernel. ``lengthy`` points, which
    take long, may also have the sizes 2 to 8.
    """
    share = count if count <= _LANES else -(-count // _MIN_CHUNKS)
    least = 1 if lengthy or count == 1 else _LANES
    return min(largest, max(least, 1 << (share - 1).bit_length()))


def make_plan(
    solvers: Sequence[Solver], grid: Grid, points: np.ndarray | None = None, *, full_size: bool = False
) -> Plan:
    """Assign every one of ``points`` (default: all of ``grid``) to the solver with the smallest predicted cost.

    ``full_size`` keeps the chunk size for few points, so further plans need no other kernels. A plan of several blocks does
    so, because a worker plans one block without knowing the others.
    """
    blocks, counters = Blocks(solvers, grid, points), [_EffortCounter(solver) for solver in solvers]
    full_size = full_size or blocks.count > 1
    for block in range(blocks.count):
        for counter, efforts in zip(counters, blocks.efforts(block), strict=True):
            counter.add(efforts)
    return Plan(tuple(counter.group(i, full_size) for i, counter in enumerate(counters) if counter.count), blocks)


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
