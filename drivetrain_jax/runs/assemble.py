"""Assemble the results of chunks into the labelled result of a scene."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

import drivetrain_jax
from drivetrain_jax._machine import machine
from drivetrain_jax._programs import PACKAGES
from drivetrain_jax._quantities import Variable
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.scene import Problem, Scene, result_variables
from drivetrain_jax.store.consolidate import CONVENTIONS, Coordinate, Labelled, release
from drivetrain_jax.store.files import command, now, versions
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    import xarray as xr

# Code of points that are not computed yet, which no finished result contains.
PENDING = len(Outcome)
# Bytes of mapped results kept in memory.
_RESIDENT = 1 << 26
_STORAGE = ("h5py",)


class ResultBuffer:
    """Results of all points of a grid, filled block by block.

    ``arrays`` holds all values: the axes in scene order (or the points), then the dimensions of the result.
    ``allocate(template)`` returns such arrays for a labelled result (default: in memory). A point that is never filled is
    undefined, or has no value and the outcome ``blank``.
    """

    def __init__(
        self,
        scene: Scene,
        grid: Grid,
        allocate: Callable[[Labelled], Mapping[str, np.ndarray]] | None = None,
        blank: int | None = None,
    ) -> None:
        self.variables = result_variables(scene)
        self._scene, self._grid, self._allocate, self._blank = scene, grid, allocate, blank
        self._unreleased = 0
        self.arrays: Mapping[str, np.ndarray] = {}

    @property
    def on_disk(self) -> bool:
        """True if the values are in a file, not in memory."""
        return self._allocate is not None

    def fill(self, points: np.ndarray, results: Mapping[str, np.ndarray]) -> None:
        """Write the results of ``points``."""
        self._lay_out_for(results)
        for variable in self.variables:
            values = results[variable.name]
            # A fixed path parameter is not a dimension of the result.
            enter(self.arrays[variable.name], self._grid, points, values[:, 0] if self._grid.path_is_fixed else values)
        self.release_after(results)

    def block(self, place: tuple[slice, ...], like: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Views of the arrays at a block of the grid, or a range of the points, to be overwritten.

        ``like`` holds the results of one point.
        """
        self._lay_out_for(like)
        return {name: values[place] for name, values in self.arrays.items()}

    def release_after(self, results: Mapping[str, np.ndarray]) -> None:
        """Periodically release pages of the memory map."""
        self._unreleased += sum(values.nbytes for values in results.values())
        if self._unreleased >= _RESIDENT:
            self._unreleased = 0
            release(self.arrays.values())

    def _lay_out_for(self, results: Mapping[str, np.ndarray]) -> None:
        """Create the arrays; the first results give the lengths of dimensions that depend on the system."""
        if not self.arrays:
            sizes = {d.name: len(d.values) for d in self._scene.dimensions}
            for variable in self.variables:
                sizes |= zip(reversed(variable.dims), reversed(results[variable.name].shape), strict=False)
            self._create(sizes)

    def lay_out(self) -> Mapping[str, np.ndarray]:
        """The arrays, which are created if nothing has been filled."""
        if not self.arrays:
            self._create(dimension_sizes(self._scene, self._grid))
        return self.arrays

    def _create(self, sizes: Mapping[str, int]) -> None:
        if self._allocate is None:
            shapes = {v: (*self._grid.result_shape, *(sizes[dim] for dim in v.dims)) for v in self.variables}
            self.arrays = {v.name: np.empty(shape, v.dtype) for v, shape in shapes.items()}
        else:
            self.arrays = self._allocate(template(self._scene, self._grid, {}, sizes))
        for variable in self.variables if self._blank is not None else ():
            self.arrays[variable.name][...] = self._blank if variable.name == OUTCOME.name else variable.missing


def enter(array: np.ndarray, grid: Grid, points: np.ndarray, values: np.ndarray | int) -> None:
    """Write ``values`` of ``points`` into the ``array`` of a result."""
    if grid.path_position is None:
        array.reshape(grid.size, *array.shape[len(grid.shape) :])[points] = values
    else:
        sweep_first(array, grid)[grid.place(points)] = values


def sweep_first(array: np.ndarray, grid: Grid) -> np.ndarray:
    """``array`` of a result, with a path axis moved behind the other axes of the sweep."""
    position = grid.path_position
    return array if position is None else np.moveaxis(array, position, len(grid.shape))


def missing_value(variable: Variable) -> float | int:
    """The value that marks a missing result of ``variable``."""
    return Outcome.STEP_LIMIT if variable.name == OUTCOME.name else variable.missing


def misfits(layout: Mapping[str, tuple[Any, tuple[int, ...]]], scene: Scene) -> list[str]:
    """Names of the results whose type or shape in a file (``layout``) is not that of ``scene``; none for an atlas."""
    shape = Grid.of(scene).result_shape

    def fits(variable: Variable) -> bool:
        kind, found = layout.get(variable.name, ("", ()))
        return kind == variable.dtype and found[: len(shape)] == shape and len(found) == len(shape) + len(variable.dims)

    return [v.name for v in (() if scene.analysis.continuous else result_variables(scene)) if not fits(v)]


def dimension_sizes(scene: Problem, grid: Grid) -> dict[str, int]:
    """Lengths of the dimensions of the results besides those of the sweep, those that depend on the system included."""
    sizes, variables = {d.name: len(d.values) for d in scene.dimensions}, result_variables(scene)
    if not all(sizes[dim] for variable in variables for dim in variable.dims):
        # Local import: `kernel` imports jax and this module.
        from drivetrain_jax.runs.kernel import result_shapes

        shapes = result_shapes(scene, grid, scene.solvers[0])
        for variable in variables:
            sizes |= zip(reversed(variable.dims), reversed(shapes[variable.name]), strict=False)
    return sizes


def labelled(scene: Scene, arrays: Mapping[str, np.ndarray], attrs: Mapping[str, str | float]) -> Labelled:
    """The labelled result: dimensions are the axes in scene order (or ``point``), then those of the variable."""
    sweep_dims = ("point",) if scene.zipped else tuple(axis.dim for axis in scene.axes)
    results = [(v, arrays[v.name]) for v in result_variables(scene)]
    return Labelled.build(
        sweep_dims, axis_coordinates(scene), scene.dimensions, results, result_attrs(scene) | dict(attrs)
    )


def template(
    scene: Scene, grid: Grid, attrs: Mapping[str, str | float], sizes: Mapping[str, int] | None = None
) -> Labelled:
    """The labelled result with zeros, which take no memory, for its data."""
    sizes, zeros = dimension_sizes(scene, grid) if sizes is None else sizes, {}
    for v in result_variables(scene):
        shape = (*grid.result_shape, *(sizes[dim] for dim in v.dims))
        zeros[v.name] = np.broadcast_to(np.zeros((), v.dtype), shape)
    return labelled(scene, zeros, attrs)


def with_pending(result: Labelled) -> Labelled:
    """``result`` with the meaning of the code ``PENDING`` added."""
    outcome = result.data[OUTCOME.name]
    meanings = f"{outcome.attrs['flag_meanings']} pending"
    codes = np.arange(PENDING + 1, dtype=OUTCOME.dtype)
    entry = replace(outcome, attrs={**outcome.attrs, "flag_values": codes, "flag_meanings": meanings})
    return replace(result, data={**result.data, OUTCOME.name: entry})


def to_dataset(scene: Scene, arrays: Mapping[str, np.ndarray], attrs: Mapping[str, str | float]) -> xr.Dataset:
    """The labelled result as a Dataset."""
    return labelled(scene, arrays, attrs).to_dataset()


def axis_coordinates(scene: Scene) -> list[Coordinate]:
    """The axes as the scene gives them, and the parameters that vary along them."""
    coordinates = [
        Coordinate(
            part.own_dim,
            ("point",) if scene.zipped else (axis.dim,),
            part.values,
            part.parameter.units,
            part.long_name,
            "" if part.name == part.own_dim else part.name,
        )
        for axis in scene.axes
        for part in (*axis.given, *axis.together)
    ]
    if scene.zipped:
        numbers = np.arange(len(scene.axes[0].values))
        coordinates.insert(0, Coordinate("point", ("point",), numbers, "1", "position of the point in the lists"))
    return coordinates


def _drawn(system: type[System]) -> dict[str, Any]:
    """Attributes that figures need: state, families of resonances, periods of the equations in a turn."""
    families = system.resonances.families if system.resonances else ()
    attrs = {
        "state": [vars(component) for component in system.state],
        "resonance_families": {f.prefix: {k: v for k, v in vars(f).items() if k != "prefix"} for f in families},
    }
    shown = {name: json.dumps(value) for name, value in attrs.items() if value}
    return shown | ({"periods_per_turn": system.periods_per_turn} if system.periods_per_turn else {})


def _roles(scene: Scene) -> dict[str, str]:
    """The roles of the system; an axis given in physical data takes the role of its parameter."""
    given = {axis.name: axis.dim for axis in scene.axes if axis.given}
    return {role: given.get(name, name) for role, name in scene.system.roles.items()}


def _physical(scene: Scene) -> dict[str, str]:
    """The physical data of a scene that do not vary."""
    if not scene.data or scene.system.physical is None:
        return {}
    known = {name: (value, scene.system.physical.quantity(name)) for name, value in scene.data.items()}
    about = {n: {"value": value, "units": q.units, "long_name": q.long_name} for n, (value, q) in known.items()}
    return {"physical_data": json.dumps(about)}


def _finite(value: Any) -> Any:
    """``value`` for JSON, which has no infinity; the word "inf" is read by every parser of numbers."""
    return str(value) if value == math.inf else value


def result_attrs(scene: Scene) -> dict[str, str]:
    """Attributes of the result that do not depend on the single run."""
    fixed: dict[str, Any] = {}
    for name, value in scene.fixed.items():
        parameter = scene.system.parameter(name)
        fixed[name] = {"value": _finite(value), "units": parameter.units, "long_name": parameter.long_name}
    installed, created, version = (
        versions((*PACKAGES, *_STORAGE)),
        now(),
        drivetrain_jax.__version__,
    )
    cited = {"references": scene.system.source} if scene.system.source else {}
    return {
        "Conventions": CONVENTIONS,
        "title": scene.title,
        "source": f"drivetrain_jax {version}",
        "history": f"{created}: {command()}",
        **cited,
        "system": scene.system.name,
        "roles": json.dumps(_roles(scene)),
        **_drawn(scene.system),
        "analysis": scene.analysis.name,
        "method": scene.request.method,
        "options": json.dumps({name: _finite(value) for name, value in scene.request.options.items()}),
        "scene": scene.text,
        "fixed_parameters": json.dumps(fixed),
        **_physical(scene),
        "drivetrain_jax_version": version,
        "versions": ", ".join(f"{name} {number}" for name, number in installed.items()),
        "machine": machine(),
        "created": created,
    }
