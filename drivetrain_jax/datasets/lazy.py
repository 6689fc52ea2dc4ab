"""Results of an atlas file as lazy arrays: only requested cells are evaluated."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from xarray.backends import BackendArray
from xarray.core import indexing

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._wording import shown
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.atlas_file import StoredAtlas, open_atlas
from drivetrain_jax.runs.physical import in_parameters

# Number of values of a parameter that the grid does not name.
_DEFAULT = 512
_ALLOWED = "a number of values (1000), (START, STOP, NUM), a row of values, or one value (0.5)"


def grid_values(atlas: StoredAtlas, grid: Any) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Axes ``(N,)`` in the order of the atlas's parameters, and the values of the parameters that do not vary.

    Args:
        grid: as of :meth:`.engine.AtlasEntrypoint.open_dataset`, with names of parameters.

    Raises: InputError for any other ``grid``, and for values outside the atlas.
    """
    given = dict.fromkeys(atlas.parameters, grid) if _is_count(grid) else grid
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise InputError(f"grid = {shown(grid)}: allowed is a number of values, or a table by the names of parameters")
    for name, value in given.items():
        if name not in atlas.parameters:
            atlas.refuse(str(name), value)
    values = {name: _values(atlas, name, given.get(name, _DEFAULT)) for name in atlas.parameters}
    axes = {name: value for name, value in values.items() if value.ndim}
    if not axes:
        raise InputError("grid: fixes all parameters; allowed is one that varies, and query answers for a point")
    return axes, {name: float(value) for name, value in values.items() if not value.ndim}


def in_atlas_parameters(atlas: StoredAtlas, grid: Any) -> tuple[Any, dict[str, tuple[Parameter, Any]]]:
    """``grid`` with parameters of the atlas for physical data and texts, and the quantities that replace parameters.

    A quantity comes with the function that gives its values. Raises :class:`InputError` for physical data that do not
    determine a parameter.
    """
    names = atlas.scene.system.physical.names if atlas.scene.system.physical else ()
    if not isinstance(grid, Mapping) or not any(name in names or _is_written(value) for name, value in grid.items()):
        return grid, {}
    counts = {name: value for name, value in grid.items() if _is_count(value)}
    rows = {name: value[:2] if _is_range(value) else value for name, value in grid.items() if name not in counts}
    given, _ = in_parameters(atlas.scene.system, rows, atlas.scene.data)
    found = atlas.in_parameters(rows)
    for name, value in grid.items():
        parameter = given.parameter_of(name) if given else name
        if name in counts:
            found[parameter] = value
        elif parameter in found and _is_range(value):
            found[parameter] = (*found[parameter], value[2])
    backs = {name: given.back(name) for name in found if given and name not in grid}
    return found, {name: back for name, back in backs.items() if back and back[0].name in grid}


def _is_written(given: Any) -> bool:
    ends = given if isinstance(given, (tuple, list)) else (given,)
    return any(isinstance(end, str) and _units.split(end) for end in ends)


def _is_range(given: Any) -> bool:
    return isinstance(given, tuple) and len(given) == 3 and _is_count(given[2])


def _values(atlas: StoredAtlas, name: str, given: Any) -> np.ndarray:
    if _is_count(given):
        values = np.linspace(*atlas.ranges[name], _count(name, given))
    elif _is_range(given):
        start, stop = (float(_number(name, end)) for end in given[:2])
        values = np.linspace(start, stop, _count(name, given[2]))
    else:
        values = _number(name, given)
    if values.ndim > 1 or not values.size:
        raise InputError(f"grid.{name}: an array of the shape {values.shape}; allowed is {_ALLOWED}")
    atlas.check_within(name, values)
    return values


def _number(name: str, given: Any) -> np.ndarray:
    try:
        values = np.asarray(given)
    except ValueError:
        # Rows of different lengths.
        values = np.empty(0, object)
    if values.dtype.kind not in "iuf":
        raise InputError(f"grid.{name} = {shown(given)}: allowed is {_ALLOWED}")
    return values.astype(float)


def _count(name: str, given: Any) -> int:
    if given < 2:
        allowed = f"allowed is 2 or more; {float(given)} would fix {name}"
        raise InputError(f"grid.{name} = {given}: is a number of values; {allowed}")
    return int(given)


def _is_count(given: Any) -> bool:
    return isinstance(given, (int, np.integer)) and not isinstance(given, bool)


# The outcome of a cell in a gap of the atlas that is not solved. No file contains this code.
GAP = len(Outcome)
# Bytes of the other results of a selection that are kept, and number of selections: the variables of a selection are usually
# requested one after another, each of them once.
_BYTES, _SELECTIONS = 6_000_000, 4

Key = tuple[int | slice | np.ndarray, ...]


class AtlasGrid:
    """Results of an atlas file on the outer product of ``axes``; the other parameters are ``fixed``.

    A pickle contains only the path and the grid, so another process opens the file itself.
    """

    def __init__(self, path: str, axes: Mapping[str, np.ndarray], fixed: Mapping[str, float], solve: bool) -> None:
        self.path, self.axes, self.fixed, self.solve = path, dict(axes), dict(fixed), solve
        self._stamp = _stamp(path)
        self._kept: dict[tuple, dict[str, np.ndarray]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_kept": {}}

    @property
    def atlas(self) -> StoredAtlas:
        """The atlas of the parameters that vary on the grid."""
        return self._part({})

    def _part(self, values: Mapping[str, float]) -> StoredAtlas:
        if _stamp(self.path) != self._stamp:
            raise InputError(f"file = {self.path!r}: has changed since it was opened; allowed is to open it again")
        return _sliced(self.path, self._stamp, tuple({**self.fixed, **values}.items()))

    def block(self, key: Key, name: str) -> np.ndarray:
        """The result ``name`` where ``key`` has a position, a slice or a row of positions for each axis."""
        columns = [axis[part] for axis, part in zip(self.axes.values(), key, strict=True)]
        return self._cached(("block", *columns), name, lambda: self._evaluated(columns))

    def points(self, positions: Sequence[np.ndarray], name: str) -> np.ndarray:
        """The result ``name`` at points, given by their positions along each axis, arrays of equal shape."""
        shape = positions[0].shape
        columns = [axis[part].reshape(-1) for axis, part in zip(self.axes.values(), positions, strict=True)]

        def evaluated() -> Mapping[str, np.ndarray]:
            found = self.atlas.arrays(dict(zip(self.axes, columns, strict=True)), zipped=True, solve=self.solve)
            return {name: values.reshape(shape + values.shape[1:]) for name, values in found.items()}

        return self._cached(("points", shape, *columns), name, evaluated)

    def _evaluated(self, columns: list[np.ndarray]) -> Mapping[str, np.ndarray]:
        by_name = dict(zip(self.axes, columns, strict=True))
        axes = {name: column for name, column in by_name.items() if column.ndim}
        numbers = {name: float(column) for name, column in by_name.items() if not column.ndim}
        if axes:
            return self._part(numbers).arrays(axes, solve=self.solve)
        single = {name: np.array([value]) for name, value in numbers.items()}
        found = self.atlas.arrays(single, zipped=True, solve=self.solve)
        return {name: values[0] for name, values in found.items()}

    def _cached(self, parts: tuple, name: str, evaluated: Callable[[], Mapping[str, np.ndarray]]) -> np.ndarray:
        """One result of a selection; the other results of the newest selections are kept until they are requested."""
        key = tuple(part.tobytes() if isinstance(part, np.ndarray) else part for part in parts)
        if (values := self._kept.get(key, {}).pop(name, None)) is None:
            results = {other: np.asarray(values) for other, values in evaluated().items()}
            if not self.solve:
                outcome = results[OUTCOME.name]
                results[OUTCOME.name] = np.where(outcome == Outcome.LOST, np.int8(GAP), outcome)
            values = results.pop(name)
            if sum(others.nbytes for others in results.values()) <= _BYTES:
                self._kept = dict([*self._kept.items(), (key, results)][-_SELECTIONS:])
        return values


class AtlasArray(BackendArray):
    """One result on an :class:`AtlasGrid`."""

    def __init__(self, grid: AtlasGrid, name: str, own: tuple[int, ...], dtype: np.dtype) -> None:
        self.grid, self.name, self.dtype = grid, name, np.dtype(dtype)
        self.shape = (*(axis.size for axis in grid.axes.values()), *own)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        if isinstance(key, indexing.VectorizedIndexer):
            positions = _spread_out(key.tuple, self.shape)
            swept, own = positions[: len(self.grid.axes)], positions[len(self.grid.axes) :]
            found = self.grid.points(np.broadcast_arrays(*swept), self.name)
            return np.take_along_axis(found, own[0], -1) if own else found
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._block)

    def _block(self, key: Key) -> np.ndarray:
        count = len(self.grid.axes)
        sizes = [1 if isinstance(k, (int, np.integer)) else _length(k, n) for k, n in zip(key, self.shape, strict=True)]
        if not all(sizes):
            kept = [size for size, k in zip(sizes, key, strict=True) if not isinstance(k, (int, np.integer))]
            return np.empty(kept, self.dtype)
        return self.grid.block(key[:count], self.name)[(..., *key[count:])]


def _length(part: slice | np.ndarray, size: int) -> int:
    return len(range(*part.indices(size))) if isinstance(part, slice) else len(part)


def _spread_out(key: Key, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Positions along each axis that broadcast against each other; the dimensions of slices follow those of arrays."""
    slices = [k for k in key if isinstance(k, slice)]
    ahead = next(k.ndim for k in key if isinstance(k, np.ndarray))
    positions, number = [], 0
    for part, size in zip(key, shape, strict=True):
        if isinstance(part, slice):
            behind = len(slices) - number - 1
            positions.append(np.arange(*part.indices(size)).reshape((1,) * (ahead + number) + (-1,) + (1,) * behind))
            number += 1
        else:
            array = np.asarray(part)
            positions.append(array.reshape(array.shape + (1,) * len(slices)))
    return positions


def _stamp(path: str) -> tuple[int, int]:
    try:
        about = os.stat(path)
    except OSError as error:
        raise InputError(f"file = {path!r}: {error.strerror}; give the file of an atlas") from None
    return about.st_mtime_ns, about.st_size


def whole(path: str) -> StoredAtlas:
    """The atlas in the file at ``path``; a file that has not changed is read once."""
    return _opened(path, _stamp(path))


@lru_cache(maxsize=4)
def _opened(path: str, stamp: tuple[int, int]) -> StoredAtlas:
    return open_atlas(path)


@lru_cache(maxsize=8)
def _sliced(path: str, stamp: tuple[int, int], values: tuple[tuple[str, float], ...]) -> StoredAtlas:
    return _opened(path, stamp).slice(dict(values))
