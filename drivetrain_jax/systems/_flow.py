"""An initial value problem whose explicit time enters through clocks.

``y' = f(theta_1, theta_2, ..., y)``, where the angle of clock i turns ``turns[i]`` times per strobe. Time is counted as
``(strobe + fraction) * period`` with an integer strobe, so the angles are as accurate after millions of strobes as at the
start. An autonomous system has no clock, and any interval can be its strobe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

Components = tuple[Any, ...]
# Turns are split at this binary digit: integer multiples of the upper part are exact up to 2^27 turns.
_SPLIT = 2.0**26


class Flow(eqx.Module):
    """A vector field with its clocks, its initial state and known properties.

    ``field(angles, y)`` returns the components of ``y'`` (per unit of time) from the angles of the clocks [rad] and the
    components of ``y``; each is a number or an array of shape ``(...)``, so a batch may be a trailing axis.

    - ``start``: components of ``y`` at t = 0.
    - ``period``: time between two strobes.
    - ``turns``: turns of each clock per strobe. A clock that defines the strobe has the integer 1; its angle is then the
      same for every member of a batch.
    - ``scale``: factor from one unit of each component to the reported units.
    - ``divergence(angles, y)``: trace of the field's Jacobian in closed form, if known. Its mean is the sum of all
      Lyapunov exponents.
    - ``phases``: components with a constant rate. Their exponents are always 0, so the verdict ignores them. (The clocks
      are not components.)
    - ``cyclic``: components that are angles up to whole turns. They may grow although the motion is bounded.
    - ``fastest``: largest angular frequency of the motion, if known; step sizes follow from it. Without ``fastest``,
      ``lyapunov`` makes 48 steps per strobe by default.
    """

    field: Callable[[Components, Any], Components]
    start: Components
    period: Any
    turns: Components = ()
    scale: tuple[Any, ...] | None = None
    divergence: Callable[[Components, Any], Any] | None = None
    phases: tuple[int, ...] = eqx.field(default=(), static=True)
    cyclic: tuple[int, ...] = eqx.field(default=(), static=True)
    fastest: Any = None

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.start)

    def angles(self, strobe: Any, fraction: Any) -> Components:
        """Angles of the clocks at ``(strobe + fraction) * period``, in [rad], reduced by the whole turns up to ``strobe``.

        ``strobe`` is an integer (array), ``fraction`` a number (array), usually in [0, 1]. The error is one rounding of the
        reduced angle, as long as no clock has made more than 2^27 turns.
        """
        return tuple(2 * math.pi * (_turned(turns, strobe) + turns * fraction) for turns in self.turns)

    def vector(self, strobe: Any, fraction: Any, y: Array) -> Array:
        """``y'`` as one array of shape ``(n, ...)`` for ``y`` of the same shape."""
        return jnp.stack(jnp.broadcast_arrays(*self.field(self.angles(strobe, fraction), y)))


def _turned(turns: Any, strobe: Any) -> Any:
    """Fractional part of ``turns * strobe``."""
    if isinstance(turns, int):
        return 0.0
    # The product with the upper part is exact; the product with the lower part is small.
    upper = jnp.round(turns * _SPLIT) / _SPLIT
    whole = upper * strobe
    return (whole - jnp.floor(whole)) + (turns - upper) * strobe
