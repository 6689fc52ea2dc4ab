"""The analyses by name: ``floquet(shaft)`` and so on; each is :func:`~drivetrain_jax.functions.analyse` with its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from drivetrain_jax.functions import Result, analyse
from drivetrain_jax.systems import System


@dataclass(frozen=True)
class AnalysisFunction:
    """The analysis ``name`` of another package as a function, like :func:`floquet`."""

    name: str

    def __call__(self, system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
        """The :class:`Result` for one ``system``."""
        return analyse(self.name, system, outputs, options)


def floquet(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Floquet stability of the equilibrium: multipliers of ``x' = A(t) x`` over one period, spectral radius and verdict.

    Args:
        system: a system with a model for it, such as ``Cardan`` or ``Tripod``; one point, or a batch under ``jax.vmap``.
        outputs: variables wanted; default ``spectral_radius``, ``spectral_radius_error`` (absolute bound), ``verdict`` (0
            stable, 1 unstable, 2 undecided). Also ``floquet_multiplier`` (n,) with ``floquet_multiplier_error``, and
            ``floquet_exponent`` (n,) [1/s], NaN where below the error; ``liouville_residual``.
        options: ``method`` ("auto", "direct", "diffrax"), ``rtol``; see ``drivetrain list cardan``.

    Returns: a :class:`Result`. Differentiable: radius, multipliers and exponents; NaN where multipliers coalesce or tie.

    Raises: :class:`~drivetrain_jax.InputError` for options that are unknown or out of range.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.416, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(f"{dt.floquet(shaft).spectral_radius:.8f}")
    1.03193549
    """
    return analyse("floquet", system, outputs, options)


def forced(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Periodic response to the forcing: of the linear system, ``y0 = (I - Z)^-1 r``, and the nonlinear orbit.

    Args as of :func:`floquet`. Outputs: ``periodic_state`` (4,), ``amplitude`` (2,) [rad], ``condition`` (default);
    ``orbit_state``, ``orbit_amplitude``, ``orbit_spectral_radius``. All are differentiable.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.0, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(dt.forced(shaft).amplitude.round(4))
    [0.0115 0.0344]
    """
    return analyse("forced", system, outputs, options)


def history(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """The components of the state at ``times`` [s], or at ``num`` times from 0 to ``stop``.

    Args as of :func:`floquet`. ``Tripod``: ``phi`` [rad], ``velocity`` [rad/s]. ``Cardan``: ``theta1``, ``theta2`` and their
    rates [rad], times in rad of the shaft. ``Rattle``: ``u`` [m], ``v`` [m/s]; also
    ``acceleration``, ``event_time`` [s] and so on; method "slow_flow" gives ``amplitude`` and ``phase``. Outputs over time
    are differentiable, except by "slow_flow".

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.history(shaft, stop=1e-3, num=5).phi.shape
    (5,)
    """
    return analyse("history", system, outputs, options)


def lyapunov(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Lyapunov spectrum [1/s], falling, with its standard error, the residual of the sum rule and a verdict.

    Args as of :func:`floquet`; options ``standard_error``, ``max_time`` [s], ``steps``. No derivatives.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.lyapunov(shaft, max_time=0.05).lyapunov_spectrum.shape
    (2,)
    """
    return analyse("lyapunov", system, outputs, options)


def poincare(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Poincare section: the state ``section`` (strobe, 2) at ``strobes`` periods of the excitation after ``discard`` others.

    Args as of :func:`floquet`. No derivatives.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.poincare(shaft, strobes=128, discard=10).section.shape
    (128, 2)
    """
    return analyse("poincare", system, outputs, options)


def steady_state(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Attractor of an oscillator with play: ``u_max``, ``u_min``, ``u_rms`` [m], ``period_multiple``, ``regime``, impacts.

    Args as of :func:`floquet`. Extremes, means and multipliers of a periodic motion are differentiable; any other
    motion gives NaN.

    >>> import drivetrain_jax as dt
    >>> gears = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
    >>> print(f"{dt.steady_state(gears).u_max:.6f}")
    0.449100
    """
    return analyse("steady_state", system, outputs, options)


def frequency_response(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Response along the frequencies ``system.omega`` (L,), swept up and down: ``u_max`` (L, 2) and so on.

    ``Cardan``: branches of the forced orbit along ``system.Omega``, ``branch_amplitude`` (L, 7, 2) and so on. Args as of
    :func:`floquet`; the frequencies are concrete numbers. Options ``method`` ("exact", "harmonic_balance",
    "multiple_scales", "describing_function"). No derivatives.

    >>> import drivetrain_jax as dt, numpy as np
    >>> gears = dt.Rattle(omega=np.linspace(0.5, 0.9, 3), **dt.Rattle.presets["table1"])
    >>> dt.frequency_response(gears, method="describing_function").u_max.shape
    (3, 2)
    """
    return analyse("frequency_response", system, outputs, options)


def basins(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Shares of random initial states that lead to each attractor of an oscillator with play: ``basin_fraction`` (8,).

    Args as of :func:`floquet`; options ``samples``, ``seed``, ``reach_u`` [m], ``reach_v`` [m/s]. No derivatives.

    >>> import drivetrain_jax as dt
    >>> gears = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
    >>> dt.basins(gears, samples=16).basin_fraction.shape
    (8,)
    """
    return analyse("basins", system, outputs, options)


def critical_speeds(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Critical speeds ``n = 30 p/pi`` [rpm] of a stepped shaft, rising, each certified by a count.

    Args as of :func:`floquet`; options ``modes`` (default 6), ``method``. Outputs ``critical_speed`` (modes,),
    ``natural_frequency`` [Hz], ``angular_frequency`` [rad/s] and ``separation_margin`` are differentiable.

    >>> import drivetrain_jax as dt
    >>> print(dt.critical_speeds(dt.Bicardan(**dt.Bicardan.presets["paper"]), modes=2).critical_speed.round(1))
    [ 8373.8 27007.5]
    """
    return analyse("critical_speeds", system, outputs, options)


def phasing(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Uneven rotation of the rigid output of a driveline, and the phases of the yokes that minimise it.

    Args as of :func:`floquet`. Outputs: ``speed_variation`` (peak to peak over the mean), ``angle_variation`` [rad],
    ``least_variation``, ``best_phase`` (joint,) [rad].

    >>> import drivetrain_jax as dt
    >>> line = {"speed": 100.0, "k": [1e4, 1e4], "c": [0.1, 0.1], "J": [0.1, 1.0]}
    >>> print(f"{dt.phasing(dt.Driveline(beta=['30 deg', '30 deg'], **line)).speed_variation:.5f}")
    0.58333
    """
    return analyse("phasing", system, outputs, options)


def modes(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Natural frequencies [Hz] of a planetary gear, rising, with the type of each mode.

    Args as of :func:`floquet`; outputs also ``dominant_family`` with ``dominant_share`` (default), ``multiplicity``,
    ``participation``, ``mode_shape``, ``kinetic_energy``. ``natural_frequency`` is
    differentiable; NaN where a parameter splits frequencies that are equal.

    >>> import drivetrain_jax as dt
    >>> print(dt.modes(dt.Planetary()).natural_frequency[1].round(2))
    727.27
    """
    return analyse("modes", system, outputs, options)


def harmonic_response(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Steady vibration of a planetary gear under harmonic transmission errors and torques, over the frequency.

    Args as of :func:`floquet`; options ``stop`` [Hz] with ``start`` and ``num``, ``damping_ratio`` of all modes. Outputs
    ``amplitude`` (num, dofs) [m] (default) and ``phase`` [rad]. No derivatives.

    >>> import drivetrain_jax as dt
    >>> dt.harmonic_response(dt.Planetary(e_s=1e-6), stop=3000.0, num=101).amplitude.shape
    (101, 21)
    """
    return analyse("harmonic_response", system, outputs, options)
