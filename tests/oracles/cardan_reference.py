"""The cardan shaft in plain NumPy and SciPy: the oracle of the tests and the baseline of the benchmarks.

The code is independent of drivetrain_jax. The equations are the linearised ones in the paper's coordinates,

    theta'' + E(tau) theta' + P(tau) theta = 0,    u = (theta1, theta2, theta1', theta2'),    period pi,

and the monodromy matrix is the fundamental matrix at tau = pi. Parameters are a mapping of the six names in
``NAMES`` to scalars or arrays of shape ``(N,)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

NAMES = ("beta", "Omega", "zeta", "alpha", "mu", "gamma")
BASE_CASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
PERIOD = np.pi
# Methods of solve_ivp that take a Jacobian.
IMPLICIT = ("Radau", "BDF", "LSODA")

Parameters = Mapping[str, Any]
Pair = tuple[tuple[Any, Any], tuple[Any, Any]]
Matrices = Callable[[float, Parameters], tuple[Pair, Pair]]


def speed_ratio(tau: float, c: Any, s2: Any) -> tuple[Any, Any, Any]:
    """``eta = c/(1 - s2 sin(tau)^2)``, c = cos(beta), s2 = sin(beta)^2, and its first two derivatives in ``tau``."""
    d = 1 - s2 * math.sin(tau) ** 2
    # Derivatives of the denominator d, then the quotient rule.
    d1, d2 = -s2 * math.sin(2 * tau), -2 * s2 * math.cos(2 * tau)
    return c / d, -c * d1 / d**2, c * (2 * d1**2 / d**3 - d2 / d**2)


def damping_and_stiffness(tau: float, p: Parameters) -> tuple[Pair, Pair]:
    """The correct ``E`` and ``P``; the printed matrices lack eta'', half of eta' and a sign (docs/validation/cardan.md).

    Besides the six parameters ``p`` holds ``cos_beta`` and ``sin2_beta``, computed once and not at every ``tau``.
    """
    eta, d1, d2 = speed_ratio(tau, p["cos_beta"], p["sin2_beta"])
    stiffness, damping = 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"]
    alpha, mu, inertia = p["alpha"], p["mu"], eta**2 + 1 / p["gamma"]
    e = ((damping, -alpha * damping * eta), (2 * d1 - damping * eta, alpha * damping * inertia))
    k = ((stiffness, -mu * stiffness * eta), (d2 - stiffness * eta, mu * stiffness * inertia))
    return e, k


def monodromy(
    p: Parameters,
    method: str = "DOP853",
    rtol: float = 1e-12,
    atol: float = 1e-12,
    matrices: Matrices = damping_and_stiffness,
) -> np.ndarray:
    """Monodromy matrix, shape ``(4, 4)``, of one point by any ``method`` of ``scipy.integrate.solve_ivp``."""
    point = {name: float(p[name]) for name in NAMES}
    point |= {"cos_beta": math.cos(point["beta"]), "sin2_beta": math.sin(point["beta"]) ** 2}
    a = np.zeros((4, 4))
    a[0, 2] = a[1, 3] = 1.0

    lower = a.reshape(-1)[8:]

    # One trajectory of 16 components with Python floats in the coefficients, as a careful user of solve_ivp writes it.
    def field(tau: float, y: np.ndarray) -> np.ndarray:
        ((e11, e12), (e21, e22)), ((k11, k12), (k21, k22)) = matrices(tau, point)
        lower[:] = (-k11, -k12, -e11, -e12, -k21, -k22, -e21, -e22)
        return a.dot(y.reshape(4, 4)).reshape(-1)

    def jacobian(tau: float, y: np.ndarray) -> np.ndarray:
        field(tau, y)
        return np.kron(a, np.eye(4))

    extra = {"jac": jacobian} if method in IMPLICIT else {}
    return _solve(field, np.eye(4), method, rtol, atol, **extra)


def stacked_monodromy(
    p: Parameters,
    rtol: float = 1e-10,
    atol: float = 1e-10,
    method: str = "DOP853",
    batch: int = 512,
    matrices: Matrices = damping_and_stiffness,
) -> np.ndarray:
    """Monodromy matrices, shape ``(N, 4, 4)``, of all points, with ``batch`` points as one state of solve_ivp.

    Points are grouped by stiffness (``Omega``, then ``beta``), because the hardest point determines the steps of a batch.
    """

    def solve(point: Parameters, identity: np.ndarray) -> np.ndarray:
        return np.moveaxis(_solve(_stacked_field(point, matrices), identity, method, rtol, atol), -1, 0)

    return _in_batches(solve, p, batch)


def stacked_half_period_monodromy(
    p: Parameters, rtol: float = 1e-10, atol: float = 1e-10, method: str = "DOP853", batch: int = 512
) -> np.ndarray:
    """Matrices similar to the monodromy matrices, from half the period like the results of heyoka and of the package.

    The state is (theta1, theta1', theta2, omega2) with omega2 = theta2' + (eta theta1)', which needs no eta''.
    """

    def solve(point: Parameters, identity: np.ndarray) -> np.ndarray:
        phi = _solve(_half_period_field(point), identity, method, rtol, atol, period=PERIOD / 2)
        return from_half_period(np.swapaxes(phi, 0, 1), point)

    return _in_batches(solve, p, batch)


def _in_batches(solve: Callable[[Parameters, np.ndarray], np.ndarray], p: Parameters, batch: int) -> np.ndarray:
    """Results (N, 4, 4) of ``solve(point, identity)`` for groups of up to ``batch`` points of similar stiffness."""
    columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(p[name], float)) for name in NAMES))
    out = np.empty((columns[0].size, 4, 4))
    order = np.lexsort((columns[0], columns[1]))
    for start in range(0, order.size, batch):
        chosen = order[start : start + batch]
        point = {name: column[chosen] for name, column in zip(NAMES, columns, strict=True)}
        out[chosen] = solve(point, np.repeat(np.eye(4)[:, :, None], chosen.size, axis=2))
    return out


def from_half_period(phi: np.ndarray, p: Parameters) -> np.ndarray:
    """``N0^-1 Phi^T N1 Phi``, shape ``(N, 4, 4)``, similar to the monodromy matrix; ``phi[j, i]``: entry i of column j.

    N = T^T X T, where X is the reversor of docs/theory/cardan.md and (q, q' + C0 q/2) = T (theta1, theta1', theta2,
    omega2) at an instant of symmetry (eta' = 0), is with d = 2 zeta/Omega

        [[d, 1, 0, gamma eta], [1, 0, 0, 0], [0, 0, alpha d, gamma], [gamma eta, 0, gamma, 0]].
    """
    c, size = np.cos(p["beta"]), p["Omega"].size
    image = [_times_reversor_form(column, 1 / c, p) for column in phi]
    gram = np.empty((4, 4, size))
    for i in range(4):
        for j in range(i, 4):
            gram[i, j] = gram[j, i] = sum(phi[i, k] * image[j][k] for k in range(4))
    return np.moveaxis(np.stack([_solve_reversor_form(gram[:, j], c, p) for j in range(4)], axis=1), -1, 0)


def spectral_radius(z: np.ndarray) -> np.ndarray:
    """Largest modulus of the eigenvalues of ``z``, shape ``(..., 4, 4)`` to ``(...)``; NaN where not finite."""
    finite = np.isfinite(z).all((-2, -1))
    moduli = np.abs(np.linalg.eigvals(np.where(finite[..., None, None], z, 0.0)))
    return np.where(finite, moduli.max(-1), np.nan)


def _stacked_field(p: Parameters, matrices: Matrices) -> Callable[[float, np.ndarray], np.ndarray]:
    point = {**p, "cos_beta": np.cos(p["beta"]), "sin2_beta": np.sin(p["beta"]) ** 2}

    def field(tau: float, y: np.ndarray) -> np.ndarray:
        theta1, theta2, rate1, rate2 = u = y.reshape(4, 4, -1)
        ((e11, e12), (e21, e22)), ((k11, k12), (k21, k22)) = matrices(tau, point)
        out = np.empty_like(u)
        out[0], out[1] = rate1, rate2
        out[2] = -(k11 * theta1 + k12 * theta2 + e11 * rate1 + e12 * rate2)
        out[3] = -(k21 * theta1 + k22 * theta2 + e21 * rate1 + e22 * rate2)
        return out.reshape(-1)

    return field


def _half_period_field(p: Parameters) -> Callable[[float, np.ndarray], np.ndarray]:
    c, s2 = np.cos(p["beta"]), np.sin(p["beta"]) ** 2
    stiffness, damping = 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"]
    spring, damper, inverse = stiffness * p["mu"], damping * p["alpha"], 1 / p["gamma"]

    def field(tau: float, y: np.ndarray) -> np.ndarray:
        theta1, rate1, theta2, speed2 = y.reshape(4, 4, -1)
        eta, d1, _ = speed_ratio(tau, c, s2)
        out = np.empty((4, *theta1.shape))
        out[0], out[2] = rate1, speed2 - d1 * theta1 - eta * rate1
        torque = spring * theta2 + damper * out[2]
        out[1], out[3] = eta * torque - damping * rate1 - stiffness * theta1, -inverse * torque
        return out.reshape(-1)

    return field


def _times_reversor_form(x: np.ndarray, eta: np.ndarray, p: Parameters) -> np.ndarray:
    d, gamma = 2 * p["zeta"] / p["Omega"], p["gamma"]
    coupling = gamma * eta
    return np.stack(
        [d * x[0] + x[1] + coupling * x[3], x[0], p["alpha"] * d * x[2] + gamma * x[3], coupling * x[0] + gamma * x[2]]
    )


def _solve_reversor_form(y: np.ndarray, eta: np.ndarray, p: Parameters) -> np.ndarray:
    d, gamma = 2 * p["zeta"] / p["Omega"], p["gamma"]
    x2 = y[3] / gamma - eta * y[1]
    x3 = (y[2] - p["alpha"] * d * x2) / gamma
    return np.stack([y[1], y[0] - d * y[1] - gamma * eta * x3, x2, x3])


def _solve(
    field: Callable[[float, np.ndarray], np.ndarray],
    start: np.ndarray,
    method: str,
    rtol: float,
    atol: float,
    period: float = PERIOD,
    **extra: Any,
) -> np.ndarray:
    solution = solve_ivp(
        field, (0.0, period), start.reshape(-1), method=method, rtol=rtol, atol=atol, t_eval=(period,), **extra
    )
    return solution.y[:, -1].reshape(start.shape) if solution.success else np.full(start.shape, np.nan)
