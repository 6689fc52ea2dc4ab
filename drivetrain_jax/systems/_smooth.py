"""Coordinates in which the results of a model are smooth, declared by a system for its atlas."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Function = Callable[[Any], np.ndarray]


@dataclass(frozen=True)
class Coordinate:
    """A monotone function of one parameter in which polynomials converge fast; NumPy functions of arrays.

    ``forward`` maps the parameter to the coordinate, ``inverse`` maps back, and ``slope`` is the derivative of ``forward``.
    If ``even``, both signs of the parameter have the same coordinate and results, and ``inverse`` returns the positive sign.
    """

    name: str
    forward: Function
    inverse: Function
    slope: Function
    even: bool = False


def identity(name: str) -> Coordinate:
    """The parameter ``name`` itself."""
    return Coordinate(name, np.asarray, np.asarray, lambda x: np.ones_like(np.asarray(x, float)))


@dataclass(frozen=True)
class Series:
    """``A(t) = A0(t) + x A1(t)`` with the coordinate x of ``parameter``, for the reduced form of a ``FloquetModel``.

    ``A0`` leads only from the ``first`` states to the others: ``A0[i, j] = 0`` unless ``i >= first > j``. The propagator is
    then a power series in x whose terms are integrals.
    """

    parameter: str
    first: int


@dataclass(frozen=True)
class Smoothness:
    """Coordinates by parameter in which the results of a model are smooth; a missing parameter is its own coordinate.

    With ``series`` an atlas solves all its nodes along the parameter of the series together.
    """

    coordinates: Mapping[str, Coordinate]
    series: Series | None = None

    def coordinate(self, parameter: str) -> Coordinate:
        """The coordinate of ``parameter``."""
        return self.coordinates.get(parameter) or identity(parameter)
