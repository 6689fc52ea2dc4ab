"""Axes of a scene, and the points that they span. A grid is never stored as a whole."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, clipped, shown
from drivetrain_jax._machine import physical_memory
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.analysis._base import checked
from drivetrain_jax.runs import toml

if TYPE_CHECKING:
    from drivetrain_jax.runs.scene import Problem, Value

MAX_POINTS = 2_000_000_000
# Largest number of parameters of an atlas.
MAX_RANGES = 4
_SCALES = ("lin", "log")
# Bytes per value of an axis while it is created and checked.
_BYTES = 32


class AxisTable(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of one axis: ``start, stop, num`` and ``scale``, or ``values``; texts are numbers with units."""

    start: float | int | str | None = None
    stop: float | int | str | None = None
    num: int | None = None
    scale: str | None = None
    values: list[float | int | str] | None = None


@dataclass(frozen=True)
class Axis:
    """A varying parameter, or entry ``entry`` of a list. ``name`` is its key in the scene: ``Omega``, ``length[1]``.

    ``given`` holds the physical quantities (several for points) that the parameter follows from, in the units of the scene;
    the first one then names the dimension. Other parameters that follow from them vary ``also``.
    """

    name: str
    parameter: Parameter
    entry: int | None
    values: np.ndarray
    given: tuple[Axis, ...] = ()
    also: tuple[Axis, ...] = ()

    @property
    def own_dim(self) -> str:
        """Name of the coordinate: ``length_1``, letters, digits and underscores as CF asks."""
        return re.sub(r"\W+", "_", self.name).strip("_")

    @property
    def dim(self) -> str:
        """Name of the dimension."""
        return self.shown.own_dim

    @property
    def shown(self) -> Axis:
        """The axis as the scene gives it."""
        return self.given[0] if self.given else self

    @property
    def together(self) -> tuple[Axis, ...]:
        """All parameters that vary along this axis, itself the first."""
        return (self, *self.also)


def axis_table(parameter: Parameter, name: str, keys: Any, where: str, *, keep: bool) -> tuple[AxisTable, Parameter]:
    """The checked ``keys`` of an axis with numbers for texts such as ``"200 rpm"``, and the parameter in their unit.

    That is its own unit or, with ``keep``, the unit of the first text. Raises :class:`InputError` for keys that are neither
    a table nor a row of values, and for a number that is out of range.
    """
    if not isinstance(keys, (Mapping, list)):
        allowed = "expected a table { start, stop, num } or { values }, or a row of values"
        raise InputError(f"{where}.{name} = {shown(keys)}: {allowed}")
    keys = {"values": keys} if isinstance(keys, list) else dict(keys)
    if isinstance(num := keys.get("num"), float) and num.is_integer():
        # Options and parameters also accept 1e3 for 1000.
        keys["num"] = int(num)
    table = toml.converted(keys, AxisTable, f"{where}.{name}.")
    numbers = [*(end for end in (table.start, table.stop) if end is not None), *(table.values or ())]
    for value in numbers:
        checked(parameter, value, f"{where}.")
    texts = [value for value in numbers if isinstance(value, str)]
    split = _units.split(texts[0]) if keep and texts else None
    described = in_unit(parameter, split[1]) if split else parameter

    # The unit of the scene may leave out the radian, N m for N m/rad; the parameter's own does not.
    size = 1 if described is parameter else 1 / _units.factor(described.units, parameter.units)

    def plain(value: Any) -> Any:
        if not isinstance(value, str):
            return value and value * size
        # A quotient such as "11/41" has no unit.
        return parameter.check(value) if parameter.fraction else _units.number(value, described.units)

    values = None if table.values is None else [plain(value) for value in table.values]
    return msgspec.structs.replace(table, start=plain(table.start), stop=plain(table.stop), values=values), described


def in_unit(parameter: Parameter, unit: str) -> Parameter:
    """``parameter`` with its range in another unit."""
    if unit == parameter.units:
        return parameter
    size = _units.factor(unit, parameter.units)
    limits = {name: getattr(parameter, name) / size for name in ("lower", "upper", "usual")}
    return replace(parameter, units=unit, **limits)


def entry_of(name: str) -> tuple[str, int | None]:
    """Parameter and position of the name of an axis: ``length[1]`` is ``("length", 1)``."""
    # Each entry has one spelling, so two axes of different names never vary the same entry.
    match = re.fullmatch(r"(.+)\[(0|[1-9][0-9]{0,8})\]", name)
    return (match.group(1), int(match.group(2))) if match else (name, None)


def placed(whole: Any, entry: int | None, value: Any) -> Any:
    """The list ``whole`` with ``value`` as this ``entry``; ``value`` itself without one."""
    return value if entry is None else (*whole[:entry], value, *whole[entry + 1 :])


def axis_values(table: AxisTable, field: str, continuous: bool = False) -> np.ndarray:
    """The values of an axis, its two ends if it is ``continuous``."""
    keys = [key for key in table.__struct_fields__ if getattr(table, key) is not None]
    if continuous and (extra := [key for key in keys if key not in ("start", "stop")]):
        value = getattr(table, extra[0])
        raise InputError(f"{field}.{extra[0]} = {value!r}: an atlas has ranges; expected start and stop")
    if table.values is not None:
        if keys != ["values"]:
            allowed = f"expected one of the two ({field} = [...] replaces the whole axis)"
            raise InputError(f"{field}: values given together with {', '.join(keys[:-1])}; {allowed}")
        if not table.values:
            raise InputError(f"{field}.values = []: empty axis; expected one value or more")
        values = np.array(table.values, float)
    else:
        if missing := [key for key in ("start", "stop") if key not in keys]:
            allowed = "start and stop" if continuous else "start, stop and num, or values"
            raise InputError(f"{field}.{missing[0]}: missing; expected {allowed}")
        start, stop, num = cast(float, table.start), cast(float, table.stop), 2 if continuous else table.num
        if continuous and not start < stop:
            raise InputError(f"{field}.stop = {stop!r}: expected stop > start = {start!r}")
        if num is None:
            raise InputError(f"{field}.num: missing; expected num >= 1 (a range without num: analysis = 'atlas')")
        if num < 1:
            raise InputError(f"{field}.num = {num}: empty axis; expected num >= 1")
        if num == 1 and start != stop:
            ends = f"start = {start!r} and stop = {stop!r}"
            raise InputError(f"{field}.num = 1: {ends} are two values; expected num >= 2, or values = [{start!r}]")
        check_total(num)
        if num * _BYTES > (present := physical_memory()):
            raise InputError(f"{field}.num = {num}: expected up to {int(present / _BYTES)} with this memory")
        if table.scale not in (None, *_SCALES):
            raise InputError(f"{field}.scale = {table.scale!r}: expected one of {', '.join(_SCALES)}")
        if table.scale == "log" and not (start > 0 and stop > 0):
            key, value = ("stop", stop) if start > 0 else ("start", start)
            raise InputError(f"{field}.{key} = {value}: expected {key} > 0 on a log axis")
        values = (np.geomspace if table.scale == "log" else np.linspace)(float(start), float(stop), num)
    ordered = np.sort(values)
    double = np.flatnonzero(ordered[1:] == ordered[:-1])
    if double.size:
        raise InputError(f"{field}: the value {ordered[double[0]]:.10g} occurs twice; expected distinct values")
    return values


def check_total(count: int) -> None:
    """Raise :class:`InputError` for too many points."""
    if count > MAX_POINTS:
        raise InputError(f"axes: {clipped(str(count))} points; expected up to {MAX_POINTS}")


@dataclass(frozen=True)
class Grid:
    """Points numbered from 0 in C order of ``axes`` (``shape``), or one point per entry of ``axes`` if ``zipped``.

    With a path axis each point is a line: ``axes`` lacks ``path``. ``path_position`` is its position among the axes of the
    scene, or None for a line of one fixed value. ``numbers`` are the ``fixed`` numbers that are arguments of compiled code,
    ``result_bytes`` is the size of the results at a point.
    """

    axes: tuple[Axis, ...]
    zipped: bool
    fixed: Mapping[str, Value]
    parameters: tuple[str, ...]
    numbers: Mapping[str, float]
    path: Axis | None = None
    path_position: int | None = None
    result_bytes: int = 8

    @classmethod
    def of(cls, scene: Problem) -> Grid:
        """The grid of ``scene``; a fixed path parameter gives lines of one value."""
        parameters = scene.analysis.model(scene.system).parameters
        name, path = scene.path_axis, None
        # A model may conclude from 0, infinity or a default that a part is absent. Such numbers are constants of compiled
        # code, and so are lists, whose entries may be equal or equally spaced.
        numbers = {
            n: value
            for n in parameters
            if n != name
            and isinstance(value := scene.fixed.get(n), float)
            and value not in (0.0, math.inf, scene.system.parameter(n).default)
        }
        position = next((i for i, axis in enumerate(scene.axes) if axis.name == name), None)
        if position is not None:
            path = scene.axes[position]
        elif name is not None:
            path = Axis(name, scene.system.parameter(name), None, np.array([scene.fixed[name]]))
        others = tuple(axis for axis in scene.axes if axis is not path)
        return cls(others, scene.zipped, scene.fixed, parameters, numbers, path, position, scene.result_bytes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes; one length if they are zipped."""
        lengths = tuple(len(axis.values) for axis in self.axes)
        return lengths[:1] if self.zipped else lengths

    @property
    def varying(self) -> tuple[Axis, ...]:
        """All parameters that vary along ``axes``."""
        return tuple(part for axis in self.axes for part in axis.together)

    @property
    def size(self) -> int:
        """Number of points, or of lines if there is a path."""
        return math.prod(self.shape)

    @property
    def path_length(self) -> int:
        """Number of results along a line, 1 without a path."""
        return 1 if self.path is None else len(self.path.values)

    @property
    def path_is_fixed(self) -> bool:
        """True if the path is a line of one fixed value, and so not a dimension of the result."""
        return self.path is not None and self.path_position is None

    @property
    def result_shape(self) -> tuple[int, ...]:
        """Lengths of the axes in scene order, the path included."""
        if self.path_position is None:
            return self.shape
        return (*self.shape[: self.path_position], self.path_length, *self.shape[self.path_position :])

    def place(self, points: np.ndarray) -> tuple[Any, ...]:
        """Index of ``points`` in an array of shape ``shape``."""
        # Without axes there is one point, and unravel_index needs at least one axis.
        return np.unravel_index(points, self.shape) if self.shape else (np.newaxis,)

    def columns(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Values of the varying parameters at ``points`` by axis name, each of the shape of ``points``."""
        if self.zipped:
            return {part.name: part.values[points] for axis in self.axes for part in axis.together}
        places = zip(self.axes, self.place(points), strict=False)
        return {part.name: part.values[i] for axis, i in places for part in axis.together}

    def bind(self, columns: Mapping[str, Any], numbers: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
        """All parameters of the model: the fixed ones, ``columns`` of the varying ones, and the path as a whole.

        ``numbers`` replace fixed ones.
        """
        values: dict[str, Any] = {**self.fixed, **numbers}
        varying = [(part, columns[part.name]) for part in self.varying]
        if self.path is not None:
            varying.append((self.path, self.path.values))
        for axis, value in varying:
            name = axis.parameter.name
            values[name] = placed(values.get(name), axis.entry, value)
        # The model computes a derived parameter that is not given.
        return {name: values[name] for name in self.parameters if name in values}

    def arrays(self, points: np.ndarray) -> dict[str, Any]:
        """Like ``bind`` at ``points``, with every number as an array of the shape of ``points``.

        Fixed entries of lists stay numbers: kernels have them as constants, too.
        """
        values, path = self.bind(self.columns(points)), self.path and self.path.values
        whole = {n for n, x in values.items() if isinstance(x, (str, tuple)) or (path is not None and x is path)}
        return {n: x if n in whole else np.broadcast_to(x, points.shape) for n, x in values.items()}
