"""Lyapunov spectra by SciPy, independent of the package.

    y' = f(t, y),  v' = (df/dy) v for every tangent vector v, made orthonormal after every interval (Benettin);

double tripod: (29) of :mod:`tests.oracles.tripod_reference`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.integrate import solve_ivp


def scipy_spectrum(field: Callable, start: np.ndarray, interval: float, count: int, tolerance: float) -> np.ndarray:
    """Exponents by Benettin's method with QR after each of ``count`` intervals; ``field(t, w)`` includes tangent vectors."""
    n = len(start)
    w, total = np.concatenate([start, np.eye(n).ravel()]), np.zeros(n)
    for k in range(count):
        t = k * interval
        w = solve_ivp(field, (t, t + interval), w, method="DOP853", rtol=tolerance, atol=tolerance).y[:, -1]
        q, r = np.linalg.qr(w[n:].reshape(n, n).T)
        total += np.log(np.abs(np.diag(r)))
        w[n:] = q.T.ravel()
    return total / (count * interval)


def tripod_field(p: Mapping[str, float]) -> Callable[[float, np.ndarray], list[float]]:
    """(29) with two tangent vectors, state (phi, phi'/Omega), 6 numbers; ``p``: the constants of the reference file."""
    return lambda t, w: _tripod_rates(p, t, w.tolist())


def _tripod_rates(p: Mapping[str, float], t: float, w: Sequence[float]) -> list[float]:
    cos, sin = math.cos, math.sin
    omega, chi, a_tj = p["Omega"], p["chi"], p["A_TJ"]
    phi, v = w[0], w[1]
    x, wave = cos(2 * math.pi * p["frequency"] * t), cos(600 * math.pi * t)
    g = (1 + p["c1"] * x) / ((1 + p["c2"] * x) * (1 + chi * x))
    ripple, weight = 0.5 * wave, 0.5
    for _ in range(5):
        # cos 2x follows from cos x.
        wave, weight = 2 * wave * wave - 1, weight / 2
        ripple += weight * wave
    drive = p["F_over_I"] / omega * (1 + p["chi_T"] * ripple)
    joint, inertia = 1 - 3 * a_tj * sin(3 * phi), 1 + chi * cos(2 * phi)
    torque = drive * joint / inertia
    slope = drive * (-9 * a_tj * cos(3 * phi) / inertia + joint * 2 * chi * sin(2 * phi) / inertia**2)
    damping, stiffness = 2 * p["zeta"] * omega * math.sqrt(g), omega * g
    rates = [omega * v, torque - damping * v - stiffness * phi]
    for a, b in (w[2:4], w[4:6]):
        rates += [omega * b, (slope - stiffness) * a - damping * b]
    return rates
