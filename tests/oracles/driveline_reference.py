"""A driveline by Lagrange multipliers, in plain NumPy and SciPy; independent of drivetrain_jax.

Coordinates are the rotations a_i of the inertias and the rotations b_i behind the joints, which have no inertia. A joint is
the constraint that the pins of its two yokes are perpendicular in space: with the unit vectors u(a) of the pin of the input
yoke and v(b) of that of the output yoke, ``u(a_{i-1} + phase_i) . v(b_i) = 0``. No ratio of speeds is used. The linear
equations come from complex steps of the torques about the rigid motion, in absolute rotations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.fft import fft, fftfreq, ifft
from scipy.integrate import solve_ivp
from scipy.linalg import solve

Chain = Mapping[str, Any]
_STEP = 1e-30


def _pins(beta: float, phase: float, a: Any, b: Any) -> tuple[Any, Any, Any]:
    """The constraint ``g = u . v`` and its derivatives by a and by b.

    The shafts lie in the plane x, z at the angle beta; the pin of the input yoke turns in the plane x, y, from the normal y
    of the plane of the shafts, and that of the output yoke across its own shaft, a quarter turn ahead of it at first.
    """
    c = math.cos(beta)
    phi, psi = a + phase, b + phase
    # u = (-sin phi, cos phi, 0), v = (-cos psi cos beta, -sin psi, cos psi sin beta).
    g = np.sin(phi) * np.cos(psi) * c - np.cos(phi) * np.sin(psi)
    ga = np.cos(phi) * np.cos(psi) * c + np.sin(phi) * np.sin(psi)
    gb = -np.sin(phi) * np.sin(psi) * c - np.cos(phi) * np.cos(psi)
    return g, ga, gb


def _behind(beta: float, phase: float, a: Any) -> Any:
    """The rotation behind the joint, by Newton's method on the constraint."""
    b = a
    for _ in range(60):
        g, _, gb = _pins(beta, phase, a, b)
        b = b - g / gb
        if abs(g) < 1e-17:
            break
    return b


def torques(chain: Chain, tau: float, a: Any, rate: Any) -> np.ndarray:
    """Torques on the inertias over speed^2, for absolute rotations ``a`` and their rates by tau."""
    w, force = chain["speed"], np.zeros(len(chain["k"]), complex)
    before, turned = tau, 1.0
    for i in range(len(force)):
        b = _behind(chain["beta"][i], chain["phase"][i], before)
        _, ga, gb = _pins(chain["beta"][i], chain["phase"][i], before, b)
        onward = -ga / gb * turned
        r = chain["ratio"][i]
        torque = chain["k"][i] * (a[i] - r * b) / w**2 + chain["c"][i] * (rate[i] - r * onward) / w
        # The massless part behind the joint is in equilibrium: r torque + multiplier gb = 0.
        multiplier = -r * torque / gb
        force[i] -= torque
        if i:
            force[i - 1] += multiplier * ga
        before, turned = a[i], rate[i]
    return force


def rigid(chain: Chain, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and rates of the rigid chain."""
    rotations, rates, before, turned = [], [], tau, 1.0
    for beta, phase, r in zip(chain["beta"], chain["phase"], chain["ratio"], strict=True):
        b = _behind(beta, phase, before)
        _, ga, gb = _pins(beta, phase, before, b)
        before, turned = r * b, -r * ga / gb * turned
        rotations.append(before)
        rates.append(turned)
    return np.array(rotations), np.array(rates)


def linear_matrix(chain: Chain, tau: float) -> np.ndarray:
    """The matrix of ``(x, x')' = A (x, x')`` about the rigid motion."""
    n, (rotations, rates) = len(chain["k"]), rigid(chain, tau)
    columns = []
    for j in range(2 * n):
        moved = np.zeros(2 * n, complex)
        moved[j] = 1j * _STEP
        columns.append(torques(chain, tau, rotations + moved[:n], rates + moved[n:]).imag / _STEP)  # pyright: ignore[reportAttributeAccessIssue]
    lower = np.transpose(columns) / np.asarray(chain["J"])[:, None]
    return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])


def multipliers(chain: Chain, period: float, rtol: float = 1e-11) -> np.ndarray:
    """Floquet multipliers over ``period``."""
    n = 2 * len(chain["k"])

    def field(tau: float, y: np.ndarray) -> np.ndarray:
        return (linear_matrix(chain, tau) @ y.reshape(n, n)).ravel()

    end = solve_ivp(field, (0.0, period), np.eye(n).ravel(), method="DOP853", rtol=rtol, atol=rtol / 100)
    return np.linalg.eigvals(end.y[:, -1].reshape(n, n))


def steady_twists(chain: Chain, period: float, periods: int) -> np.ndarray:
    """Largest twists [rad] of the shafts in the last one of ``periods`` of the nonlinear motion from rest, ``(N,)``."""
    n = len(chain["k"])

    def field(tau: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[n:], np.real(torques(chain, tau, y[:n], y[n:])) / np.asarray(chain["J"])])

    def twists(tau: float, a: np.ndarray) -> list[float]:
        before = [tau, *a[:-1]]
        behind = map(_behind, chain["beta"], chain["phase"], before)
        return [x - r * b for x, r, b in zip(a, chain["ratio"], behind, strict=True)]

    times = period * (periods - 1 + np.linspace(0, 1, 801))
    start = np.concatenate(rigid(chain, 0.0))
    end = solve_ivp(field, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-11)
    return np.abs([twists(tau, a) for tau, a in zip(times, end.y[:n].T, strict=True)]).max(axis=0)


def harmonic_response(chain: Chain, period: float, samples: int, finer: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Largest twists [rad] and torques [N m] of the shafts in the forced motion of the linear equations, ``(N,)`` each.

    Harmonics up to half of ``samples`` meet the equations at the samples; ``finer`` times as many points show the peaks.
    """
    n, w, times = len(chain["k"]), chain["speed"], period * np.arange(samples) / samples
    rates = np.array([rigid(chain, tau)[1] for tau in times])
    wave = 2j * math.pi * fftfreq(samples, period / samples)

    def derivative(values: np.ndarray) -> np.ndarray:
        return ifft(wave[:, None] * fft(values, axis=0), axis=0).real

    # y' - A y = f at every sample, y = (x, x'), f = (0, -Psi'').
    system = np.kron(derivative(np.eye(samples)), np.eye(2 * n))
    for i, tau in enumerate(times):
        system[2 * n * i : 2 * n * (i + 1), 2 * n * i : 2 * n * (i + 1)] -= linear_matrix(chain, float(tau))
    forcing = np.hstack([np.zeros((samples, n)), -derivative(rates)])
    x = solve(system, forcing.ravel()).reshape(samples, 2 * n)[:, :n]
    onward = np.hstack([np.zeros((samples, 1)), rates[:, 1:] / rates[:, :-1] * x[:, :-1]])
    twist = x - onward
    torque = np.asarray(chain["k"]) * twist + w * np.asarray(chain["c"]) * derivative(twist)
    fine = np.zeros((finer * samples, 2 * n), complex)
    place = np.concatenate([np.arange(samples // 2), np.arange(-samples // 2, 0)])
    fine[place] = finer * fft(np.hstack([twist, torque]), axis=0)
    peaks = np.abs(ifft(fine, axis=0).real).max(axis=0)
    return peaks[:n], peaks[n:]
