"""Coordinates in which the results of a model are smooth, growth and enclosures: declared by a system for its atlas."""

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


Columns = Mapping[str, Any]
# Half a unit in the last place of a number between 1 and 2.
UNIT = 2.0**-53


def rounding(n: float) -> float:
    """Bound of the relative error of ``n`` roundings."""
    return n * UNIT / (1 - n * UNIT)


def frobenius(a: np.ndarray) -> np.ndarray:
    """Frobenius norms of matrices, ``(..., n, n)``."""
    return np.sqrt((a * a).sum((-1, -2)))


@dataclass(frozen=True)
class Enclosure:
    """Propagators ``T Phi S`` of four states with proved bounds of their errors, from which an atlas proves its verdicts.

    ``varying`` are the parameters that an atlas with proofs may vary; its grids are cut along the first one, because points
    along the others share work.

    ``propagators(axes, fixed, middle)`` returns, for the grid of the coordinates ``axes``, the coordinates of its points
    ``(N, d)``, bounds of their errors, matrices ``(N, 4, 4)``, and bounds ``(N,)`` of the norms of their errors, infinite
    where there is none. ``coordinate(name, values)`` returns a coordinate and bounds of its errors.
    ``log_determinant(columns)`` is log det Z with a relative error of at most 24 units in the last place. It is 0 only
    without damping, and in a box least at a corner. ``growth(x, middle)`` bounds ``ln |T Phi S|`` (Frobenius norm) for
    columns ``x`` of the coordinates of all parameters, of which one may be complex. ``balls(values, middle)`` contains
    ``T Phi S`` at one point, an ``arb_mat`` of python-flint, by other code.
    """

    varying: tuple[str, ...]
    propagators: Callable[[Columns, Columns, Columns], tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    coordinate: Callable[[str, np.ndarray], tuple[np.ndarray, np.ndarray]]
    log_determinant: Callable[[Columns], np.ndarray]
    growth: Callable[[Columns, Columns], np.ndarray]
    balls: Callable[[Columns, Columns], Any] | None = None


@dataclass(frozen=True)
class Smoothness:
    """Coordinates by parameter in which the results of a model are smooth; a missing parameter is its own coordinate.

    ``series`` names a parameter with whose coordinate x the reduced form of the ``FloquetModel`` is ``A(t) = x B(t)``. The
    propagator is then a power series in x whose terms are integrals, and an atlas computes all its nodes along x together.

    ``balance(values, middle)`` returns the diagonals of T and S, ``(n, ...)`` each, for columns of parameters; ``middle``
    holds one value of each parameter, for the whole domain. An atlas then interpolates ``T Phi S``, whose multipliers are
    those of Phi and whose entries are of one size and bounded, with fewer polynomials.

    With ``enclosure`` the verdicts of an atlas are proved.
    """

    coordinates: Mapping[str, Coordinate]
    series: str = ""
    balance: Callable[[Columns, Columns], tuple[np.ndarray, np.ndarray]] | None = None
    enclosure: Enclosure | None = None

    def coordinate(self, parameter: str) -> Coordinate:
        """The coordinate of ``parameter``."""
        return self.coordinates.get(parameter) or identity(parameter)
