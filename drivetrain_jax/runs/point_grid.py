"""The points of a scene by number. Parameter values are computed on demand, so a grid is never stored as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from drivetrain_jax.runs.axes import Axis
from drivetrain_jax.runs.scene import Problem, Value


@dataclass(frozen=True)
class Grid:
    """Points numbered from 0 in C order of ``axes`` (``shape``), or one point per entry of ``axes`` if ``zipped``.

    With a path axis each point is a line: ``axes`` lacks ``path``. ``path_position`` is its position among the axes of the
    scene, or None for a line of one fixed value. ``result_bytes`` is the size of the results at a point.
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
        name = scene.path_axis
        numbers = {n: value for n, value in _numbers(scene).items() if n != name}
        if name is None:
            return cls(scene.axes, scene.zipped, scene.fixed, parameters, numbers, result_bytes=scene.result_bytes)
        position = next((i for i, axis in enumerate(scene.axes) if axis.name == name), None)
        if position is None:
            path = Axis(name, scene.system.parameter(name), None, np.array([scene.fixed[name]]))
            return cls(scene.axes, scene.zipped, scene.fixed, parameters, numbers, path, None, scene.result_bytes)
        others = scene.axes[:position] + scene.axes[position + 1 :]
        path = scene.axes[position]
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
            if axis.entry is None:
                values[name] = value
            else:
                values[name] = (*values[name][: axis.entry], value, *values[name][axis.entry + 1 :])
        # The model computes a derived parameter that is not given.
        return {name: values[name] for name in self.parameters if name in values}

    def arrays(self, points: np.ndarray) -> dict[str, Any]:
        """Like ``bind`` at ``points``, with every number (and entry of a list) as an array of the shape of ``points``."""
        return {name: self._spread(value, points.shape) for name, value in self.bind(self.columns(points)).items()}

    def _spread(self, value: Any, shape: tuple[int, ...]) -> Any:
        if isinstance(value, tuple):
            return tuple(self._spread(entry, shape) for entry in value)
        whole = isinstance(value, str) or (self.path is not None and value is self.path.values)
        return value if whole else np.broadcast_to(value, shape)


def _numbers(scene: Problem) -> dict[str, float]:
    """The fixed numbers of the model, without those from which it may conclude that a part is absent.

    Such numbers are 0, infinity and defaults. They are constants of compiled code, and so are lists, whose entries may be
    equal or equally spaced.
    """
    names = scene.analysis.model(scene.system).parameters
    given = {name: scene.fixed[name] for name in names if name in scene.fixed}
    return {
        name: value
        for name, value in given.items()
        if isinstance(value, float) and value not in (0.0, math.inf, scene.system.parameter(name).default)
    }
