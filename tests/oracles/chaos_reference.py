"""Lyapunov spectra and strobes by SciPy and heyoka.py, independent of the package: oracles and rivals.

    y' = f(t, y),  v' = (df/dy) v for every tangent vector v, made orthonormal after every interval (Benettin);

Lorenz: x' = 10 (y - x), y' = x (28 - z) - y, z' = x y - 8/3 z; double tripod: (29) of :mod:`tests.oracles.tripod_reference`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

SIGMA, RHO, BETA = 10.0, 28.0, 8 / 3
# Interval between orthonormalisations of Lorenz' system.
INTERVAL = 0.5


def lorenz(_: float, w: np.ndarray) -> list[float]:
    """Rates of Lorenz' system with three tangent vectors, 12 numbers: the state, then one vector after the other."""
    # Python floats are faster than NumPy floats.
    return _lorenz_rates(w.tolist())


def _lorenz_rates(w: Sequence[Any]) -> list[Any]:
    """Rates for numbers, or for heyoka's variables."""
    x, y, z = w[:3]
    rates = [SIGMA * (y - x), x * (RHO - z) - y, x * y - BETA * z]
    for k in (3, 6, 9):
        a, b, c = w[k : k + 3]
        rates += [SIGMA * (b - a), a * (RHO - z) - x * c - b, a * y + x * b - BETA * c]
    return rates


def attractor(count: int) -> np.ndarray:
    """Points of Lorenz' attractor, shape ``(count, 3)``."""
    state, points = np.array([1.0, 1.0, 20.0, *np.eye(3).ravel()]), []
    for _ in range(count + 10):
        state[:3] = solve_ivp(lorenz, (0, 1.7), state, rtol=1e-8, atol=1e-8).y[:3, -1]
        state[3:] = np.eye(3).ravel()
        points.append(state[:3].copy())
    return np.array(points[10:])


def scipy_flow(starts: np.ndarray, duration: float, tolerance: float, field: Callable = lorenz) -> np.ndarray:
    """States and tangent vectors (unit vectors at first) after ``duration``, one row per start, by DOP853."""
    ends = []
    for start in starts:
        w = np.concatenate([start, np.eye(len(start)).ravel()])
        ends.append(solve_ivp(field, (0, duration), w, method="DOP853", rtol=tolerance, atol=tolerance).y[:, -1])
    return np.array(ends)


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


class HeyokaFlow:
    """A system of ``n`` equations with its tangent vectors in heyoka.py's batch Taylor integrator."""

    def __init__(self, equations: Sequence[tuple[Any, Any]], tolerance: float, batch: int = 8) -> None:
        import heyoka as hy

        self.n = round((len(equations) + 0.25) ** 0.5 - 0.5)
        self.batch = batch
        self.integrator = hy.taylor_adaptive_batch(
            list(equations), np.zeros((len(equations), batch)), tol=tolerance, force_avx512=True
        )

    def flow(self, starts: np.ndarray, duration: float) -> np.ndarray:
        """States and tangent vectors after ``duration``, a row per start; their number is a multiple of the batch."""
        members = self._members(starts)
        self._advance(members, 0.0, duration)
        return members.transpose(0, 2, 1).reshape(len(starts), -1)

    def spectrum(self, starts: np.ndarray, interval: float, count: int) -> np.ndarray:
        """Exponents ``(N, n)`` of all starts over ``count`` intervals; all starts are orthonormalised together."""
        members = self._members(starts)
        total = np.zeros((self.n, *members[:, 0].shape))
        for k in range(count):
            self._advance(members, k * interval, (k + 1) * interval)
            total += np.log(_orthonormalise(members[:, self.n :].reshape(len(members), self.n, self.n, self.batch)))
        return total.reshape(self.n, -1).T / (count * interval)

    def _members(self, starts: np.ndarray) -> np.ndarray:
        """States with unit vectors as tangent vectors, ``(N/batch, n + n^2, batch)``."""
        states = starts.reshape(-1, self.batch, self.n).transpose(0, 2, 1)
        vectors = np.broadcast_to(np.eye(self.n).reshape(-1, 1), (len(states), self.n**2, self.batch))
        return np.concatenate([states, vectors], axis=1)

    def _advance(self, members: np.ndarray, begin: float, end: float) -> None:
        integrator = self.integrator
        state = integrator.state
        for part in members:
            integrator.set_time(begin)
            state[:] = part
            integrator.propagate_until(end)
            part[:] = state


def _orthonormalise(vectors: np.ndarray) -> np.ndarray:
    """Gram-Schmidt in place on ``(..., vector, component, batch)``; returns the lengths ``(vector, ..., batch)``."""
    lengths = []
    for i in range(vectors.shape[-3]):
        own = vectors[..., i, :, :]
        for j in range(i):
            other = vectors[..., j, :, :]
            own -= np.sum(own * other, axis=-2, keepdims=True) * other
        lengths.append(np.sqrt(np.sum(own * own, axis=-2)))
        own /= lengths[-1][..., None, :]
    return np.array(lengths)


def heyoka_lorenz(tolerance: float) -> HeyokaFlow:
    """Lorenz' system."""
    import heyoka as hy

    w = hy.make_vars(*(f"w{i}" for i in range(12)))
    return HeyokaFlow(list(zip(w, _lorenz_rates(w), strict=True)), tolerance)


def heyoka_tripod(p: Mapping[str, float], tolerance: float) -> HeyokaFlow:
    """(29) with two tangent vectors, as :func:`tripod_field`."""
    import heyoka as hy

    w = hy.make_vars(*(f"w{i}" for i in range(6)))
    return HeyokaFlow(list(zip(w, _tripod_rates(p, hy.time, w, hy), strict=True)), tolerance)


def tripod_field(p: Mapping[str, float]) -> Callable[[float, np.ndarray], list[float]]:
    """(29) with two tangent vectors, state (phi, phi'/Omega), 6 numbers; ``p``: the constants of the reference file."""
    return lambda t, w: _tripod_rates(p, t, w.tolist(), math)


def _tripod_rates(p: Mapping[str, float], t: Any, w: Sequence[Any], functions: Any) -> list[Any]:
    """Rates for numbers, or for heyoka's variables; ``functions`` has ``sin``, ``cos`` and ``sqrt``."""
    cos, sin = functions.cos, functions.sin
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
    damping, stiffness = 2 * p["zeta"] * omega * functions.sqrt(g), omega * g
    rates = [omega * v, torque - damping * v - stiffness * phi]
    for a, b in (w[2:4], w[4:6]):
        rates += [omega * b, (slope - stiffness) * a - damping * b]
    return rates
