"""A driven oscillator with a play in its spring: linear in each of three regions.

Equation: ``u'' + damping u' + stiffness f_s(u) = B0 + B1 cos(omega t)`` with
``f_s = u - (1 - alpha) b`` for ``u > b``, ``alpha u`` for ``|u| <= b``, ``u + (1 - alpha) b`` for ``u < -b``. The damper
acts always, or in contact only (``|u| > b``): the force then jumps at a flank, unless ``u' = 0`` there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError


class PiecewiseLinearOscillator(eqx.Module):
    """The equation in the module's docstring; every field is a number or an array, all of one common shape ``(...)``.

    ``damping`` is c/I [1/s], ``stiffness`` k/I [1/s^2], ``alpha`` the stiffness within the play over the stiffness in
    contact [1], ``b`` half the play [m], ``B0`` and ``B1`` mean and amplitude of the drive [m/s^2], ``omega`` the frequency
    of the drive [rad/s].

    An ``unbalance`` [m] adds ``unbalance omega^2`` to B1 along a range of frequencies. The equation itself, and all that
    solves it at one frequency, take :meth:`at`. The number 0.0 stands for none.

    ``damps_play`` is false if the damper acts in contact only; exact methods serve both.
    """

    damping: Any
    stiffness: Any
    alpha: Any
    b: Any
    B0: Any
    B1: Any
    omega: Any
    unbalance: Any = 0.0
    damps_play: bool = eqx.field(static=True, default=True)

    @staticmethod
    def check_method(damps_play: bool, method: str) -> None:
        """Raise :class:`InputError` for an approximate method, unless the damper always acts."""
        if not damps_play and method != "exact":
            raise InputError(f"options.method = {method!r}: allowed for a damper in contact only is 'exact'")

    @property
    def follows(self) -> bool:
        """True if the amplitude of the drive depends on its frequency."""
        return not (isinstance(self.unbalance, float) and self.unbalance == 0.0)

    def amplitude(self, omega: Any) -> Any:
        """``B1 + unbalance omega^2`` [m/s^2]."""
        return self.B1 + self.unbalance * omega**2 if self.follows else self.B1

    def at(self, omega: Any) -> PiecewiseLinearOscillator:
        """The oscillator at the frequency ``omega``, its whole amplitude in B1."""
        return replace(self, omega=omega, B1=self.amplitude(omega), unbalance=0.0)

    @property
    def oscillates(self) -> Any:
        """True where free motion is underdamped in contact and within the play."""
        # A square that overflows is infinite, and so compares as it should.
        with np.errstate(over="ignore"):
            return (self.damping / 2) ** 2 < self.stiffness * jnp.minimum(1.0, self.alpha)

    @property
    def period(self) -> Any:
        """``T = 2 pi/omega`` [s]."""
        return 2 * np.pi / self.omega

    def restoring(self, u: Any) -> Array:
        """``f_s(u)`` in the units of ``u``, in the common shape of ``u`` and the parameters."""
        # u minus the force lost in the play is exact for b = 0 and continuous in floating point.
        return u - (1 - self.alpha) * jnp.clip(u, -self.b, self.b)

    def field(self, t: Any, state: Array) -> Array:
        """``(u', u'')`` of ``state = (u, u')``, shape ``(2, ...)``.

        Its derivative jumps where :meth:`switching` changes sign, and the field itself with a damper in contact only:
        integrators must locate the jumps.
        """
        u, v = state
        damping = self.damping if self.damps_play else jnp.where(jnp.abs(u) > self.b, self.damping, 0.0)
        drive = self.B0 + self.B1 * jnp.cos(self.omega * t)
        return jnp.stack(jnp.broadcast_arrays(v, drive - damping * v - self.stiffness * self.restoring(u)))

    def switching(self, state: Array) -> Array:
        """Distances ``(u - b, u + b)`` to the flanks, where the derivative jumps, shape ``(2, ...)``."""
        return jnp.stack(jnp.broadcast_arrays(state[0] - self.b, state[0] + self.b))


class UnderdampedOscillator(PiecewiseLinearOscillator):
    """An oscillator whose free motion oscillates in contact and within the play; kernels omit the overdamped flow."""
