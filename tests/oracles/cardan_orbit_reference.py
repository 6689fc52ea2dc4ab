"""The forced cardan shaft with SciPy alone: the linear periodic response and the true nonlinear orbit.

    theta1'' = eta T - d theta1' - s theta1,   theta2'' = -eta_phi (1 + theta1')^2 - eta theta1'' - T/gamma,
    T = alpha d theta2' + mu s theta2,   s = 1/Omega^2,   d = 2 zeta/Omega,   eta, eta_phi at phi = tau + theta1;

The linear response obeys the same equations to first order in theta1, theta2 and their rates. The code is independent of
drivetrain_jax, like :mod:`tests.oracles.cardan_reference`; states are (theta1, theta2, theta1', theta2').
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.cardan_reference import PERIOD, damping_and_stiffness, speed_ratio

_TOLERANCES = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14}


def geometry(p: Mapping[str, float]) -> dict[str, float]:
    """``p`` with the cosine and the squared sine of the joint angle, as the fields need it."""
    return {**p, "cos_beta": math.cos(p["beta"]), "sin2_beta": math.sin(p["beta"]) ** 2}


def nonlinear_field(tau: float, y: np.ndarray, p: Mapping[str, float]) -> list[float]:
    """The paper's (1) and (5) solved for the accelerations; ``p`` with ``cos_beta`` and ``sin2_beta``."""
    theta1, theta2, rate1, rate2 = y
    eta, eta_phi, _ = speed_ratio(tau + theta1, p["cos_beta"], p["sin2_beta"])
    s, d = 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"]
    torque = p["alpha"] * d * rate2 + p["mu"] * s * theta2
    acceleration = eta * torque - d * rate1 - s * theta1
    return [rate1, rate2, acceleration, -eta_phi * (1 + rate1) ** 2 - eta * acceleration - torque / p["gamma"]]


def linear_field(tau: float, y: np.ndarray, p: Mapping[str, float]) -> list[float]:
    """Right-hand side of theta'' + E theta' + P theta = (0, -eta')."""
    theta1, theta2, rate1, rate2 = y
    ((e11, e12), (e21, e22)), ((k11, k12), (k21, k22)) = damping_and_stiffness(tau, p)
    forcing = -speed_ratio(tau, p["cos_beta"], p["sin2_beta"])[1]
    return [
        rate1,
        rate2,
        -(k11 * theta1 + k12 * theta2 + e11 * rate1 + e12 * rate2),
        forcing - (k21 * theta1 + k22 * theta2 + e21 * rate1 + e22 * rate2),
    ]


def linear_response(p: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Periodic state at tau = 0 and amplitude (max |theta1|, max |theta2| over the period) of the linear system."""
    point = geometry(p)
    r = _flow(linear_field, np.zeros(4), point)
    # The field is affine: differences from the response to the forcing alone are the monodromy matrix.
    z = np.stack([_flow(linear_field, column, point) - r for column in np.eye(4)], axis=1)
    start = np.linalg.solve(np.eye(4) - z, r)
    return start, _amplitude(linear_field, start, point)


def nonlinear_orbit(p: Mapping[str, float], guess: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, float]:
    """State at tau = 0, amplitude and spectral radius of the nonlinear periodic orbit next to ``guess``.

    The default of ``guess`` is the linear response.

    Newton on the return map with its Jacobian by fourth-order differences (error of the multipliers about 1e-9).
    """
    point = geometry(p)
    y = linear_response(p)[0] if guess is None else guess
    for _ in range(12):
        jacobian = _jacobian(y, point)
        step = np.linalg.solve(jacobian - np.eye(4), _flow(nonlinear_field, y, point) - y)
        y = y - step
        if np.abs(step).max() < 1e-11:
            break
    return y, _amplitude(nonlinear_field, y, point), float(np.abs(np.linalg.eigvals(_jacobian(y, point))).max())


def _flow(field, y: np.ndarray, point: Mapping[str, float]) -> np.ndarray:
    return solve_ivp(field, (0.0, PERIOD), y, args=(point,), **_TOLERANCES).y[:, -1]


def _amplitude(field, y: np.ndarray, point: Mapping[str, float]) -> np.ndarray:
    solution = solve_ivp(field, (0.0, PERIOD), y, args=(point,), t_eval=np.linspace(0, PERIOD, 4001), **_TOLERANCES)
    return np.abs(solution.y[:2]).max(axis=1)


def _jacobian(y: np.ndarray, point: Mapping[str, float], h: float = 1e-3) -> np.ndarray:
    columns = []
    for unit in np.eye(4):
        one, two = (
            _flow(nonlinear_field, y + k * h * unit, point) - _flow(nonlinear_field, y - k * h * unit, point)
            for k in (1, 2)
        )
        columns.append((8 * one - two) / (12 * h))
    return np.stack(columns, axis=1)
