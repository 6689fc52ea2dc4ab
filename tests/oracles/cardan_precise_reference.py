"""The spectral radius of the cardan shaft to 30 digits and more, by Taylor series in fixed-point arithmetic.

    python -m tests.oracles.cardan_precise_reference 1.5 0.1        # beta Omega [zeta alpha mu gamma]

The code is independent of drivetrain_jax and SciPy. In theta1, v1 = theta1', phi = theta2 + eta theta1 and w = phi' the
linearised equations need no derivative of eta,

    v1' = -2 zeta s v1 - s^2 theta1 + eta T,    w' = -T/gamma,    s = 1/Omega,
    T = 2 alpha zeta s (w - (eta theta1)') + mu s^2 (phi - eta theta1).

Taylor coefficients follow from two products of power series for each column of the fundamental matrix. The step is a fixed
fraction of the distance to the nearest pole of eta. Numbers are integers over 2^BITS.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping

import mpmath
import numpy as np

BITS = 200
# Terms of the series, and the step relative to the radius of convergence and to 1/s: (1/4)^64 < 1e-38.
ORDER, _PART, _PHASE = 64, 0.25, 3.0
_DIGITS = 60


def spectral_radius(point: Mapping[str, float]) -> mpmath.mpf:
    """The spectral radius over the period pi; the stored parameters count as exact."""
    with mpmath.workdps(_DIGITS):
        return max(abs(s) for s in multipliers(point))


def multipliers(point: Mapping[str, float]) -> list[mpmath.mpc]:
    """The four multipliers over the period pi."""
    with mpmath.workdps(_DIGITS):
        z = mpmath.matrix(4, 4)
        for j, column in enumerate(_propagate(point)):
            for i, entry in enumerate(column):
                z[i, j] = mpmath.mpf(int(entry)) / mpmath.mpf(2) ** BITS
        return mpmath.eig(z, left=False, right=False)


def _propagate(point: Mapping[str, float]) -> list[list[int]]:
    """Columns of the fundamental matrix at tau = pi."""
    with mpmath.workdps(_DIGITS):
        p = {name: mpmath.mpf(value) for name, value in point.items()}
        s = 1 / p["Omega"]
        c, s2 = mpmath.cos(p["beta"]), mpmath.sin(p["beta"]) ** 2
        constants = [
            _fixed(x)
            for x in (2 * p["zeta"] * s, s * s, 2 * p["alpha"] * p["zeta"] * s, p["mu"] * s * s, 1 / p["gamma"])
        ]
        end, tau = mpmath.pi, mpmath.mpf(0)
        state = [[_fixed(mpmath.mpf(i == j)) for i in range(4)] for j in range(4)]
        while tau < end:
            h = min(mpmath.mpf(_step(float(tau), float(s2), float(s), point)), end - tau)
            eta, step = _speed_ratio(tau, h, c, s2), _fixed(h)
            state = [_advance(column, eta, step, constants) for column in state]
            tau += h
    return state


def _step(tau: float, s2: float, s: float, point: Mapping[str, float]) -> float:
    """Step at ``tau``: the poles of eta lie at pi/2 (mod pi) +- i arcosh(1/sin beta); both rates grow with eta."""
    imaginary = math.acosh(1 / math.sqrt(s2)) if s2 > 0 else math.inf
    distance = min(math.hypot(tau - at, imaginary) for at in (-math.pi / 2, math.pi / 2, 3 * math.pi / 2))
    h = min(_PART * distance, 1.0)
    peak = min(max(tau, math.pi / 2), tau + h)
    eta = math.sqrt(1 - s2) / (1 - s2 * math.sin(peak) ** 2)
    light = eta**2 + 1 / point["gamma"]
    oscillation = math.sqrt(1 + point["mu"] * light)
    decay = 2 * point["zeta"] * (1 + point["alpha"] * light)
    return min(h, _PHASE / (s * (oscillation + decay)))


def _fixed(x: mpmath.mpf) -> int:
    return int(mpmath.nint(x * mpmath.mpf(2) ** BITS))


def _speed_ratio(tau: mpmath.mpf, h: mpmath.mpf, c: mpmath.mpf, s2: mpmath.mpf) -> np.ndarray:
    """Taylor coefficients of eta = c/(1 - s2 sin^2) at ``tau``, times powers of ``h``."""
    derivatives = [mpmath.cos(2 * tau), -mpmath.sin(2 * tau), -mpmath.cos(2 * tau), mpmath.sin(2 * tau)]
    d, power = [], s2 / 2
    for k in range(ORDER + 1):
        d.append(_fixed(power * derivatives[k % 4] + (1 - s2 / 2 if k == 0 else 0)))
        power *= 2 * h / (k + 1)
    d = np.array(d, dtype=object)
    eta = np.zeros(ORDER + 1, dtype=object)
    for k in range(ORDER + 1):
        rest = int(np.dot(d[1 : k + 1], eta[:k][::-1])) if k else 0
        eta[k] = ((_fixed(c) << BITS if k == 0 else 0) - rest) // d[0]
    return eta


def _advance(column: list[int], eta: np.ndarray, h: int, constants: list[int]) -> list[int]:
    """One column after a step ``h``; its coefficients include powers of ``h``."""
    damping1, stiffness1, damping2, stiffness2, softness = constants
    theta, v, phi, w, u, torque = (np.zeros(ORDER + 2, dtype=object) for _ in range(6))
    theta[0], v[0], phi[0], w[0] = column
    u[0] = (eta[0] * theta[0]) >> BITS
    for k in range(ORDER):
        theta[k + 1] = ((h * v[k]) >> BITS) // (k + 1)
        phi[k + 1] = ((h * w[k]) >> BITS) // (k + 1)
        u[k + 1] = int(np.dot(eta[: k + 2], theta[: k + 2][::-1])) >> BITS
        slope = w[k] - ((k + 1) * u[k + 1] << BITS) // h
        torque[k] = (damping2 * slope + stiffness2 * (phi[k] - u[k])) >> BITS
        drive = int(np.dot(eta[: k + 1], torque[: k + 1][::-1])) - damping1 * v[k] - stiffness1 * theta[k]
        v[k + 1] = ((h * (drive >> BITS)) >> BITS) // (k + 1)
        w[k + 1] = -((h * ((softness * torque[k]) >> BITS)) >> BITS) // (k + 1)
    return [int(x[: ORDER + 1].sum()) for x in (theta, v, phi, w)]


def main() -> None:
    """Print the spectral radius of the point in the arguments."""
    known = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (
        ("beta", None),
        ("Omega", None),
        ("zeta", 0.001),
        ("alpha", 1.0),
        ("mu", 1.0),
        ("gamma", 100.0),
    ):
        known.add_argument(name, type=float, nargs="?" if default else None, default=default)
    print(mpmath.nstr(spectral_radius(vars(known.parse_args())), 32))


if __name__ == "__main__":
    main()
