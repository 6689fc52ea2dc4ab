"""Lyapunov spectra and strobes by SciPy and heyoka.py, independent of the package: oracles and rivals.

    y' = f(t, y),  v' = (df/dy) v for every tangent vector v, made orthonormal after every interval (Benettin);

Lorenz: x' = 10 (y - x), y' = x (28 - z) - y, z' = x y - 8/3 z; double tripod: (29), see :mod:`benchmarks.tripod_reference`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from scipy.integrate import solve_ivp

SIGMA, RHO, BETA = 10.0, 28.0, 8 / 3
# Interval between two orthonormalisations of Lorenz' system.
INTERVAL = 0.5


def lorenz(_: float, w: np.ndarray) -> np.ndarray:
    """Lorenz' system and three tangent vectors, 12 numbers: the state, then the vectors one after another."""
    x, y, z = w[:3]
    rates = [SIGMA * (y - x), x * (RHO - z) - y, x * y - BETA * z]
    for k in (3, 6, 9):
        a, b, c = w[k : k + 3]
        rates += [SIGMA * (b - a), a * (RHO - z) - x * c - b, a * y + x * b - BETA * c]
    return np.array(rates)


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
    """Exponents by Benettin's method: ``count`` intervals, QR after each; ``field(t, w)`` carries the tangent vectors."""
    n = len(start)
    w, total = np.concatenate([start, np.eye(n).ravel()]), np.zeros(n)
    for k in range(count):
        t = k * interval
        w = solve_ivp(field, (t, t + interval), w, method="DOP853", rtol=tolerance, atol=tolerance).y[:, -1]
        q, r = np.linalg.qr(w[n:].reshape(n, n).T)
        total += np.log(np.abs(np.diag(r)))
        w[n:] = q.T.ravel()
    return total / (count * interval)


class HeyokaLorenz:
    """Lorenz' system with three tangent vectors in heyoka.py's batch Taylor integrator."""

    def __init__(self, tolerance: float, batch: int = 8) -> None:
        import heyoka as hy

        names = [f"w{i}" for i in range(12)]
        w = hy.make_vars(*names)
        x, y, z = w[:3]
        rates = [SIGMA * (y - x), x * (RHO - z) - y, x * y - BETA * z]
        for k in (3, 6, 9):
            a, b, c = w[k : k + 3]
            rates += [SIGMA * (b - a), a * (RHO - z) - x * c - b, a * y + x * b - BETA * c]
        self.batch = batch
        self.integrator = hy.taylor_adaptive_batch(
            list(zip(w, rates, strict=True)), np.zeros((12, batch)), tol=tolerance, force_avx512=True
        )

    def flow(self, starts: np.ndarray, duration: float) -> np.ndarray:
        """States and tangent vectors after ``duration``, shape ``(N, 12)``; N a multiple of the batch."""
        ends = []
        for part in starts.reshape(-1, self.batch, 3):
            self._set(part.T, np.eye(3).reshape(9, 1).repeat(self.batch, 1))
            self.integrator.propagate_until(duration)
            ends.append(self.integrator.state.T.copy())
        return np.concatenate(ends)

    def spectrum(self, starts: np.ndarray, count: int) -> np.ndarray:
        """Exponents of one batch, shape ``(batch, 3)``, ``count`` intervals."""
        self._set(starts[: self.batch].T, np.eye(3).reshape(9, 1).repeat(self.batch, 1))
        total = np.zeros((self.batch, 3))
        for _ in range(count):
            self.integrator.set_time(0.0)
            self.integrator.propagate_until(INTERVAL)
            q, r = np.linalg.qr(self.integrator.state[3:].T.reshape(-1, 3, 3).transpose(0, 2, 1))
            total += np.log(np.abs(np.diagonal(r, axis1=1, axis2=2)))
            self.integrator.state[3:] = q.transpose(0, 2, 1).reshape(-1, 9).T
        return total / (count * INTERVAL)

    def _set(self, states: np.ndarray, vectors: np.ndarray) -> None:
        self.integrator.state[:3], self.integrator.state[3:] = states, vectors
        self.integrator.set_time(0.0)


def tripod_field(p: Mapping[str, float]) -> Callable[[float, np.ndarray], np.ndarray]:
    """(29) with two tangent vectors, state (phi, phi'/Omega), 6 numbers; ``p``: the constants of the reference file."""
    omega, chi, c1, c2 = p["Omega"], p["chi"], p["c1"], p["c2"]
    motor, excitation = 600 * math.pi, 2 * math.pi * p["frequency"]

    def field(t: float, w: np.ndarray) -> np.ndarray:
        phi, v = w[0], w[1]
        x = math.cos(excitation * t)
        g = (1 + c1 * x) / ((1 + c2 * x) * (1 + chi * x))
        ripple = sum(math.cos(2**i * motor * t) / 2 ** (i + 1) for i in range(6))
        drive = p["F_over_I"] / omega * (1 + p["chi_T"] * ripple)
        joint, inertia = 1 - 3 * p["A_TJ"] * math.sin(3 * phi), 1 + chi * math.cos(2 * phi)
        torque = drive * joint / inertia
        slope = drive * (
            -9 * p["A_TJ"] * math.cos(3 * phi) / inertia + joint * 2 * chi * math.sin(2 * phi) / inertia**2
        )
        damping, stiffness = 2 * p["zeta"] * omega * math.sqrt(g), omega * g
        return np.array(
            [omega * v, torque - damping * v - stiffness * phi]
            + [r for a, b in (w[2:4], w[4:6]) for r in (omega * b, (slope - stiffness) * a - damping * b)]
        )

    return field
