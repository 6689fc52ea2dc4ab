"""The grid on which an atlas is opened: values of each of its parameters, from the option ``grid``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._wording import shown
from drivetrain_jax.runs.atlas_file import StoredAtlas
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
