"""The double-tripod driveshaft in plain NumPy and SciPy: the oracle of the tests and the baseline of the benchmarks.

    phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = (M/I)(1 + chi ripple)(1 - 3 A sin 3 phi)/(1 + chi_n cos 2 phi),
    g = (1 + c1 x)/((1 + c2 x)(1 + chi_n x)),  x = cos 2 phi in (25), (26), cos Theta in (29), (30), Theta' = 2 pi f.

The code is independent of drivetrain_jax. The state is ``(phi, V)`` in rad and rad/s, the time is in seconds, and the phase
Theta is computed from the time. ``k_t/I`` comes from the moments of area and not from the paper's coefficients c1..c4,
except for a given chi_n, from which the coefficients follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq, minimize_scalar

RHO, G, LENGTH = 7850.0, 77.3e9, 0.940
NINE_DEGREES = math.radians(9)
# By element: L_B, L_A, R, d_A, d_C, S_B, mean and nonuniformity of the bell's moments; torque and its nonuniformity.
TABLES = {
    "input": (0.190, 0.130, 0.070, 0.054, 0.098, 0.0076, 1.4645e-5, 0.22, 2550.0, 0.05),
    "output": (0.209, 0.143, 0.077, 0.059, 0.108, 0.0092, 2.1442e-5, 0.24, -2100.0, 0.15),
}
EQUATIONS = {"25": "input", "29": "input", "26": "output", "30": "output"}


@dataclass(frozen=True)
class Shaft:
    """One element: inertia, coefficients of g, natural angular frequency, joint amplitude, torque over inertia."""

    inertia: float
    chi_n: float
    c1: float
    c2: float
    omega: float
    joint: float
    acceleration: float
    ripple: float


def bell_and_axle(element: str, beta: float, phi: float) -> tuple[float, float]:
    """J_B and J_A at the twist ``phi``, appendix A."""
    l_b, l_a, _, d_a, d_c, s_b, mean, chi_b, _, _ = TABLES[element]
    c2, s2 = math.cos(beta) ** 2, math.sin(beta) ** 2
    bell = mean * (1 + c2 + chi_b * math.cos(2 * phi) * s2) + s_b * d_c**2
    axle = math.pi * d_a**4 / 64 * (1 + c2) + math.pi * d_a**2 / 4 * (l_b + 0.5 * l_a) ** 2
    return bell, axle


def inertia(element: str, beta: float, phi: float) -> float:
    """I = rho (J_B L_B + J_A L_A)."""
    bell, axle = bell_and_axle(element, beta, phi)
    return RHO * (bell * TABLES[element][0] + axle * TABLES[element][1])


def stiffness(element: str, beta: float, phi: float) -> float:
    """k_t = G J_A J_B/(J_A L_B + J_B L_A), (1)."""
    bell, axle = bell_and_axle(element, beta, phi)
    return G * axle * bell / (axle * TABLES[element][0] + bell * TABLES[element][1])


def shaft(element: str, beta: float = NINE_DEGREES, chi_n: float | None = None) -> Shaft:
    """The constants of an element. cos 2 phi = 0 at phi = pi/4, where inertia and stiffness have their means."""
    mean = inertia(element, beta, math.pi / 4)
    omega = math.sqrt(stiffness(element, beta, math.pi / 4) / mean)
    l_b, l_a, radius, *_, torque, ripple = TABLES[element]
    bell, axle = bell_and_axle(element, beta, math.pi / 4)
    chi = inertia(element, beta, 0.0) / mean - 1 if chi_n is None else chi_n
    bell_share = RHO * bell * l_b / mean
    compliance_share = bell * l_a / (axle * l_b + bell * l_a)
    joint = 0.5 * radius / LENGTH * math.tan(beta) * math.tan(beta / 2) ** 2
    c1 = chi / bell_share
    return Shaft(mean, chi, c1, c1 * compliance_share, omega, joint, torque / mean, ripple)


def ratio(s: Shaft, x: Any) -> Any:
    """g(x): k_t/I over its mean, by the coefficients."""
    return (1 + s.c1 * np.cos(x)) / ((1 + s.c2 * np.cos(x)) * (1 + s.chi_n * np.cos(x)))


def acceleration(
    s: Shaft, equation: str, zeta: float, frequency: float, motor: float, t: float, y: Sequence, ahead: float = 0.0
) -> float:
    """phi'' of the equation; Theta has the ``frequency`` [Hz] and the offset ``ahead`` [rad], ``motor`` is in rad/s."""
    phi, rate = y
    g = ratio(s, 2 * math.pi * frequency * t + ahead if equation in ("29", "30") else 2 * phi)
    if equation in ("25", "29"):
        ripple = sum(math.cos(2**i * motor * t) / 2 ** (i + 1) for i in range(6))
    else:
        ripple = sum(math.cos(2 ** (j - 1) * phi) / 2**j for j in range(1, 8))
    torque = s.acceleration * (1 + s.ripple * ripple) * (1 - 3 * s.joint * math.sin(3 * phi))
    drive = torque / (1 + s.chi_n * math.cos(2 * phi))
    return drive - 2 * zeta * s.omega * math.sqrt(g) * rate - s.omega**2 * g * phi


def history(
    equation: str,
    times: Sequence[float],
    zeta: float,
    chi_n: float | None = None,
    frequency: float | None = None,
    start: tuple[float, float] = (0.0, 0.0),
    motor_order: float = 6.0,
    rtol: float = 1e-13,
    atol: float = 1e-16,
) -> np.ndarray:
    """phi and V at ``times``, shape ``(2, len(times))``, by DOP853."""
    s = shaft(EQUATIONS[equation], chi_n=chi_n)
    frequency = s.omega / math.pi if frequency is None else frequency
    motor = 100 * math.pi * motor_order

    def field(t: float, y: Sequence) -> tuple[float, float]:
        return y[1], acceleration(s, equation, zeta, frequency, motor, t, y)

    # The rate is larger than the twist by the factor Omega, and so is its tolerance.
    tolerance = np.array([atol, atol * s.omega])
    return solve_ivp(field, (0, max(times)), start, "DOP853", t_eval=times, rtol=rtol, atol=tolerance).y


def monodromy(element: str, zeta: float, frequency: float, chi_n: float | None = None) -> np.ndarray:
    """Monodromy matrix (2, 2) of the linear parametric part over 1/frequency, by DOP853, state (phi, V/Omega)."""
    s = shaft(element, chi_n=chi_n)

    def field(t: float, y: np.ndarray) -> np.ndarray:
        g = ratio(s, 2 * math.pi * frequency * t)
        phi, rate = y[:2], y[2:]
        return s.omega * np.concatenate([rate, -2 * zeta * math.sqrt(g) * rate - g * phi])

    end = 1 / frequency
    y = solve_ivp(field, (0, end), np.eye(2).reshape(-1), "DOP853", rtol=1e-13, atol=1e-15, t_eval=(end,)).y[:, -1]
    return y.reshape(2, 2)


def spectral_radius(element: str, zeta: float, frequency: float, chi_n: float | None = None) -> float:
    """Largest modulus of the Floquet multipliers."""
    return float(np.abs(np.linalg.eigvals(monodromy(element, zeta, frequency, chi_n))).max())


def determinant(element: str, zeta: float, frequency: float, chi_n: float | None = None) -> float:
    """det Z by Liouville's formula, the integral by adaptive quadrature."""
    s = shaft(element, chi_n=chi_n)
    mean = quad(lambda x: math.sqrt(ratio(s, x)), 0, math.pi, epsabs=1e-13, epsrel=1e-13)[0] / math.pi
    return math.exp(-2 * zeta * s.omega / frequency * mean)


def critical_nonuniformity(element: str, zeta: float) -> tuple[float, float]:
    """Smallest chi_n on the edge of the principal tongue and its frequency [Hz], by brentq within a bounded search."""
    s = shaft(element)
    guess = 4 * zeta / ((s.c1 - s.c2 - s.chi_n) / s.chi_n)
    centre = s.omega / math.pi

    def edge(frequency: float) -> float:
        def distance(chi: float) -> float:
            z = monodromy(element, zeta, frequency, chi)
            return 1 + np.trace(z) + np.linalg.det(z)

        return brentq(distance, 0.7 * guess, 1.4 * guess, xtol=1e-15, rtol=1e-14)

    found = minimize_scalar(
        edge, bounds=(centre * (1 - zeta), centre * (1 + 0.2 * zeta)), method="bounded", options={"xatol": 1e-3}
    )
    return float(found.fun), float(found.x)


def paper_estimator(equation: str, zeta: float, chi_n: float, frequency: float, strobes: int) -> np.ndarray:
    """The estimator (31)-(36) for (29) or (30) from rest, of twist, rate of twist and Theta [1/s].

    On every interval between strobes the second solution starts from the first solution times 1 + 1e-5, Theta included.
    """
    s, share, motor = shaft(EQUATIONS[equation], chi_n=chi_n), 1e-5, 600 * math.pi

    def after(start: np.ndarray, strobe: int, ahead: float) -> np.ndarray:
        def field(t: float, y: np.ndarray) -> tuple[float, float]:
            return y[1], acceleration(s, equation, zeta, frequency, motor, t, y, ahead)

        span = (strobe / frequency, (strobe + 1) / frequency)
        return solve_ivp(field, span, start, "DOP853", rtol=3e-14, atol=1e-17 * np.array([1.0, s.omega])).y[:, -1]

    state, apart = np.zeros(2), []
    for strobe in range(strobes):
        ahead = share * 2 * math.pi * strobe
        end = after(state, strobe, 0.0)
        apart.append([*(after(state * (1 + share), strobe, ahead) - end), ahead])
        state = end
    # The perturbation of the first interval is zero.
    delta = np.abs(apart[1:])
    return np.sum(np.log10(delta / np.linalg.norm(delta[-1])), axis=0) * frequency / strobes
