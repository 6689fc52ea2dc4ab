"""The engine ``drivetrain`` of xarray: opens an atlas as a lazy Dataset whose cells are evaluated when they are accessed.

xarray imports this module whenever it looks for an engine. Modules that compute are therefore imported later, when an atlas
is opened.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, shown
from drivetrain_jax.store.files import ATLAS_PREFACE

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_file import StoredAtlas

_GAPS = ("solve", "nan")
# Number of values of a parameter that the grid does not name.
_DEFAULT = 512
_ALLOWED = "a number of values (1000), (START, STOP, NUM), a row of values, or one value (0.5)"
# Most cells of a chunk of automatic size, and most cells along one axis.
_CHUNK, _LONGEST = 1 << 18, 1 << 10
# Bytes of the other results of a selection that are kept, and number of selections: the variables of a selection are usually
# requested one after another, each of them once.
_BYTES, _SELECTIONS = 6_000_000, 4

Key = tuple[int | slice | np.ndarray, ...]


class AtlasEntrypoint(BackendEntrypoint):
    """Opens an atlas on any grid; cells are evaluated when they are accessed."""

    description: ClassVar[str] = "Open a stability atlas of drivetrain_jax on any grid"
    url: ClassVar[str] = ""

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """True if the file begins with the preface of an atlas. Copies by other tools need ``engine="drivetrain"``."""
        if not isinstance(filename_or_obj, (str, os.PathLike)) or not os.path.isfile(filename_or_obj):
            return False
        try:
            with open(filename_or_obj, "rb") as file:
                return file.read(len(ATLAS_PREFACE)) == ATLAS_PREFACE
        except OSError:
            return False

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        grid: Any = None,
        gaps: str = "solve",
    ) -> xr.Dataset:
        """The results of an atlas file on a grid, evaluated lazily.

        Args:
            filename_or_obj: path of the file.
            drop_variables: names of results to leave out.
            grid: a mapping from names of parameters, or of physical data, to a number of values between the ends of the
                atlas, ``(start, stop, num)``, a row of values, or one value (a float); or one number of values for all
                parameters. Default: 512.
            gaps: cells in a gap of the atlas are solved directly (``solve``), or have no value and the outcome ``gap``
                (``nan``).

        Returns: a Dataset with the names and attributes of a ``floquet`` result. The cells of a selection are evaluated
        together, so a cell may have other last digits in another selection, within its ``spectral_radius_error``.

        Raises: InputError for a file that is not an atlas or is damaged, and for a grid that reaches beyond the atlas.
        """
        if not isinstance(filename_or_obj, (str, os.PathLike)):
            kind = type(filename_or_obj).__name__
            raise InputError(f"filename_or_obj: got a {kind}; expected the path of the file of an atlas")
        if gaps not in _GAPS:
            raise InputError(f"gaps = {shown(gaps)}: expected one of {', '.join(_GAPS)}")
        path = os.path.abspath(os.path.expanduser(os.fspath(filename_or_obj)))
        dropped = {drop_variables} if isinstance(drop_variables, str) else set(drop_variables or ())
        return _on_grid(path, grid, gaps == "solve").drop_vars(dropped, errors="ignore")


def _on_grid(path: str, grid: Any, solve: bool) -> xr.Dataset:
    from drivetrain_jax.analysis import OUTCOME
    from drivetrain_jax.runs.assemble import labelled
    from drivetrain_jax.runs.atlas_file import PROVED

    whole = _opened(path, _stamp(path))
    grid, whole = _in_atlas_parameters(whole, grid)
    axes, fixed = _grid_values(whole, grid)
    cells = _Cells(path, axes, fixed, solve)
    atlas = cells.atlas({})
    point = atlas.stability.blank((), atlas.request.outputs)
    shape = tuple(len(values) for values in axes.values())
    # Broadcast numbers take no memory.
    blank = {name: np.broadcast_to(value, (*shape, *value.shape)) for name, value in point.items()}
    dataset = labelled(replace(atlas, views=whole.views).scene_on(axes), blank, {}).to_dataset()
    degrees = np.max([(0,) * len(axes), *(panel.degrees for panel in atlas.stability.atlas.panels)], axis=0)
    chunks = _chunks(axes, dict(zip(atlas.parameters, degrees.tolist(), strict=True)))
    for name, value in point.items():
        variable = dataset[name].variable
        data = indexing.LazilyIndexedArray(_Result(cells, name, variable.shape, value.dtype))
        sizes = dict(zip(variable.dims, (*chunks, *variable.shape[len(axes) :]), strict=True))
        dataset[name] = xr.Variable(variable.dims, data, variable.attrs, {"preferred_chunks": sizes})
    if "verdict" in dataset:
        verdict = dataset["verdict"].variable
        flags = indexing.LazilyIndexedArray(_Result(cells, "proved", verdict.shape, np.dtype(bool)))
        dataset["proved"] = xr.Variable(verdict.dims, flags, PROVED, verdict.encoding)
    if not solve:
        about = dataset[OUTCOME.name].attrs
        about["flag_values"] = np.arange(gap() + 1, dtype=OUTCOME.dtype)
        about["flag_meanings"] += " gap"
    return whole.with_fixed(dataset, fixed)


def gap() -> int:
    """The outcome of a cell in a gap of the atlas that is not solved. No file contains this code."""
    from drivetrain_jax.analysis import Outcome

    return len(Outcome)


def _chunks(axes: dict[str, Any], degrees: dict[str, int]) -> list[int]:
    """Sizes of chunks along the axes, equal for all chunks where possible, because each size needs its own kernels.

    Chunks are long along the two longest axes, whose cells are evaluated together. Among axes of equal length, those with
    low ``degrees`` come first, which take less work.
    """
    longest = sorted(axes, key=lambda name: (-len(axes[name]), degrees[name]))
    chunks, left = {}, _CHUNK
    for name in longest:
        length = len(axes[name])
        most = math.isqrt(_CHUNK) if name == longest[0] and len(axes) > 1 else left
        chunks[name] = -(-length // -(-length // max(1, min(length, most, _LONGEST))))
        left //= chunks[name]
    return [chunks[name] for name in axes]


def _in_atlas_parameters(atlas: StoredAtlas, grid: Any) -> tuple[Any, StoredAtlas]:
    """``grid`` with parameters of the atlas for physical data and texts, and the atlas that shows these data."""
    names = atlas.scene.system.physical.names if atlas.scene.system.physical else ()
    if not isinstance(grid, Mapping):
        return grid, atlas
    ends = [end for value in grid.values() for end in (value if isinstance(value, (tuple, list)) else (value,))]
    if not {*grid} & {*names} and not any(isinstance(end, str) and _units.split(end) for end in ends):
        return grid, atlas.viewed({}, grid)
    counts = {name: value for name, value in grid.items() if _is_count(value)}
    rows = {name: value[:2] if _is_range(value) else value for name, value in grid.items() if name not in counts}
    atlas, values = atlas.viewed(rows, counts), atlas.in_parameters(rows)
    parameters = {quantity.name: name for name, (quantity, _) in atlas.views.items()}
    for name, value in grid.items():
        parameter: Any = parameters.get(name, name)
        if name in counts:
            values[parameter] = value
        elif parameter in values and _is_range(value):
            values[parameter] = (*values[parameter], value[2])
    return values, atlas


def _is_count(entry: Any) -> bool:
    return isinstance(entry, (int, np.integer)) and not isinstance(entry, bool)


def _is_range(entry: Any) -> bool:
    return isinstance(entry, tuple) and len(entry) == 3 and _is_count(entry[2])


def _grid_values(atlas: StoredAtlas, grid: Any) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Axes ``(N,)`` in the order of the atlas's parameters, and the values of the parameters that do not vary.

    ``grid`` is that of :meth:`AtlasEntrypoint.open_dataset` with names of parameters; any other raises :class:`InputError`.
    """
    table = dict.fromkeys(atlas.parameters, grid) if _is_count(grid) else {} if grid is None else grid
    if not isinstance(table, Mapping):
        raise InputError(f"grid = {shown(grid)}: expected a number of values, or a table by the names of parameters")
    for name, value in table.items():
        if name not in atlas.parameters:
            atlas.refuse(str(name), value)
    values = {name: _values(atlas, name, table.get(name, _DEFAULT)) for name in atlas.parameters}
    axes = {name: value for name, value in values.items() if value.ndim}
    if not axes:
        raise InputError("grid: fixes all parameters; expected one that varies, and query answers for a point")
    return axes, {name: float(value) for name, value in values.items() if not value.ndim}


def _values(atlas: StoredAtlas, name: str, entry: Any) -> np.ndarray:
    """The values of a parameter that varies, or the one that it has."""
    label = atlas.viewed_as(name)[0].name
    start, stop, count = (*atlas.ranges[name], entry) if _is_count(entry) else entry if _is_range(entry) else (0, 0, 0)
    if count < 2 and (_is_count(entry) or _is_range(entry)):
        allowed = f"expected 2 or more; {float(count)} would fix {label}"
        raise InputError(f"grid.{label} = {count}: is a number of values; {allowed}")
    try:
        values = np.linspace(float(start), float(stop), count) if count else np.asarray(entry)
    # Words, and rows of different lengths.
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.dtype.kind not in "iuf" or values.ndim > 1 or not values.size:
        raise InputError(f"grid.{label} = {shown(entry)}: expected {_ALLOWED}")
    return atlas.check_within(name, values).astype(float)


class _Cells:
    """Results of an atlas file on the outer product of ``axes``; the other parameters are ``fixed``.

    A pickle contains only the path and the grid, so another process opens the file itself.
    """

    def __init__(self, path: str, axes: Mapping[str, np.ndarray], fixed: Mapping[str, float], solve: bool) -> None:
        self.path, self.axes, self.fixed, self.solve = path, dict(axes), dict(fixed), solve
        self._stamp = _stamp(path)
        self._kept: dict[tuple, dict[str, np.ndarray]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_kept": {}}

    def atlas(self, values: Mapping[str, float]) -> StoredAtlas:
        """The atlas of the parameters that vary, with ``values`` for some of them."""
        if _stamp(self.path) != self._stamp:
            raise InputError(f"file = {self.path!r}: has changed since it was opened; open it again")
        return _sliced(self.path, self._stamp, tuple({**self.fixed, **values}.items()))

    def block(self, key: Key, name: str) -> np.ndarray:
        """The result ``name`` where ``key`` has a position, a slice or a row of positions for each axis."""
        columns = {axis: values[part] for (axis, values), part in zip(self.axes.items(), key, strict=True)}
        varied = {axis: column for axis, column in columns.items() if column.ndim}
        numbers = {axis: float(column) for axis, column in columns.items() if not column.ndim}
        if not varied:
            return self.points(key, name)
        if name == "proved":
            cells = np.meshgrid(*varied.values(), indexing="ij")
            return self._proved({**numbers, **dict(zip(varied, cells, strict=True))}, self.block(key, "verdict"))
        return self._cached("block", columns, name, lambda: self.atlas(numbers).arrays(varied, solve=self.solve))

    def points(self, positions: Sequence[Any], name: str) -> np.ndarray:
        """The result ``name`` at points, given by their positions along each axis, numbers or arrays of equal shape."""
        columns = {axis: values[part] for (axis, values), part in zip(self.axes.items(), positions, strict=True)}
        shape = next(iter(columns.values())).shape
        if name == "proved":
            return self._proved(columns, self.points(positions, "verdict"))
        rows = {axis: column.reshape(-1) for axis, column in columns.items()}
        values = self._cached(
            "points", columns, name, lambda: self.atlas({}).arrays(rows, zipped=True, solve=self.solve)
        )
        return values.reshape(shape + values.shape[1:])

    def _proved(self, columns: Mapping[str, Any], verdict: np.ndarray) -> np.ndarray:
        return _opened(self.path, self._stamp).proved({**self.fixed, **columns}, verdict)

    def _cached(
        self, kind: str, columns: Mapping[str, np.ndarray], name: str, evaluate: Callable[[], Mapping[str, np.ndarray]]
    ) -> np.ndarray:
        """One result of a selection; the other results of the newest selections are kept until they are requested.

        The verdict stays, because the flags of what is proved need it.
        """
        key = (kind, *((column.shape, column.tobytes()) for column in columns.values()))
        kept = self._kept.get(key, {})
        if (values := kept.get(name) if name == "verdict" else kept.pop(name, None)) is None:
            results = {other: np.asarray(values) for other, values in evaluate().items()}
            if not self.solve:
                from drivetrain_jax.analysis import OUTCOME, Outcome

                outcome = results[OUTCOME.name]
                results[OUTCOME.name] = np.where(outcome == Outcome.LOST, np.int8(gap()), outcome)
            values = results[name] if name == "verdict" else results.pop(name)
            if sum(others.nbytes for others in results.values()) <= _BYTES:
                self._kept = dict([*self._kept.items(), (key, results)][-_SELECTIONS:])
        return values


class _Result(BackendArray):
    """One result on the grid of ``cells``."""

    def __init__(self, cells: _Cells, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.cells, self.name, self.shape, self.dtype = cells, name, shape, np.dtype(dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> np.ndarray:
        support = indexing.IndexingSupport
        if isinstance(key, indexing.VectorizedIndexer):
            return indexing.explicit_indexing_adapter(key, self.shape, support.VECTORIZED, self._points)
        return indexing.explicit_indexing_adapter(key, self.shape, support.OUTER, self._block)

    def _points(self, key: Key) -> np.ndarray:
        # Dimensions of arrays come first, those of slices follow.
        behind = sum(isinstance(part, slice) for part in key)
        spread, every = behind, []
        for part, size in zip(key, self.shape, strict=True):
            spread -= isinstance(part, slice)
            chosen = np.arange(size)[part]
            every.append(chosen.reshape(*chosen.shape, *(1,) * (spread if isinstance(part, slice) else behind)))
        every = np.broadcast_arrays(*every)
        swept, inner = every[: len(self.cells.axes)], every[len(self.cells.axes) :]
        if not inner:
            return self.cells.points(swept, self.name)
        # The dimension of a slice comes last, those of arrays are shared by all axes.
        sliced = isinstance(key[-1], slice)
        values = self.cells.points([part[..., 0] for part in swept] if sliced else swept, self.name)
        return values[..., key[-1]] if sliced else np.take_along_axis(values, inner[0][..., None], -1)[..., 0]

    def _block(self, key: Key) -> np.ndarray:
        sizes = [np.arange(n)[k].size for k, n in zip(key, self.shape, strict=True) if not _is_count(k)]
        if not all(sizes):
            return np.empty(sizes, self.dtype)
        count = len(self.cells.axes)
        return self.cells.block(key[:count], self.name)[(..., *key[count:])]


def _stamp(path: str) -> tuple[int, int]:
    try:
        about = os.stat(path)
    except OSError as error:
        raise InputError(f"file = {path!r}: {error.strerror}; give the file of an atlas") from None
    return about.st_mtime_ns, about.st_size


@lru_cache(maxsize=4)
def _opened(path: str, stamp: tuple[int, int]) -> StoredAtlas:
    """The atlas in the file at ``path``; a file that has not changed is read once."""
    from drivetrain_jax.runs.atlas_file import open_atlas

    return open_atlas(path)


@lru_cache(maxsize=8)
def _sliced(path: str, stamp: tuple[int, int], values: tuple[tuple[str, float], ...]) -> StoredAtlas:
    return _opened(path, stamp).slice(dict(values))
