"""Independent references for the stepped shaft: finite elements of high degree, and the paper's determinant.

    (EI f'')'' = p^2 rhoA f in each segment, springs k_A, k_D (k_joint), rotational springs, masses and rotary inertias at
    its ends; with shear and rotary inertia (kGA (f' - theta))' = -p^2 rhoA f, (EI theta')' + kGA (f' - theta) = -p^2 rhoI
    theta. rhoA may be 0.

``finite_elements`` is independent of the package: Galerkin's method with one element of high degree per segment, matrices
by Gauss quadrature, eigenvalues by LAPACK. ``determinant_roots`` is the plain implementation of the paper with NumPy and
SciPy: the product of 4x4 transfer matrices, a scan for changes of sign, Brent's method. Both take the parameters of the
system by name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh
from scipy.optimize import brentq

_LISTS = ("length", "EI", "rhoA", "k_joint", "m_joint", "k_hinge", "kGA", "rhoI", "I_joint")
Element = tuple[np.ndarray, np.ndarray]
_OF_WHIRL = re.compile(r"Ip_.*|rhoIp|.*_y|speed")


def complete(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """All parameters, with missing ones set to no effect and lists as arrays."""
    n = len(parameters["length"])
    defaults = {"k_joint": 0.0, "m_joint": 0.0, "k_hinge": np.inf, "kGA": np.inf, "rhoI": 0.0, "m_A": 0.0, "m_D": 0.0}
    defaults |= {"k_rot_A": 0.0, "k_rot_D": 0.0, "I_A": 0.0, "I_joint": 0.0, "I_D": 0.0}
    # Polar inertias and a second plane have no effect on bending in one plane at rest.
    values = {n: x for n, x in {**defaults, **parameters}.items() if not _OF_WHIRL.fullmatch(n)}
    sizes = dict.fromkeys(("k_joint", "m_joint", "k_hinge", "I_joint"), n - 1)
    return {
        name: np.broadcast_to(np.asarray(value, float), sizes.get(name, n)) if name in _LISTS else float(value)
        for name, value in values.items()
    }


def _bubbles(power: int, count: int, x: np.ndarray, derivative: int) -> np.ndarray:
    """Derivatives of the functions whose derivative of the order ``power`` is ``P_k``, k = power, power + 1, ...

    The functions vanish at both ends with ``power - 1`` derivatives, and their bending (stretching) is orthogonal. After
    scaling by its diagonal the stiffness matrix is well conditioned, and the low frequencies keep their digits.
    """
    series = [legendre.legint(row, power - derivative, lbnd=-1) for row in np.eye(count + power)[power:]]
    return np.array([legendre.legval(x, c) for c in series]).reshape(count, -1)


def _euler_element(length: float, EI: float, rhoA: float, bubbles: int) -> Element:
    """Stiffness and mass of a slender element for the unknowns f, theta in front, f, theta behind, bubbles."""
    x, weight = legendre.leggauss(bubbles + 6)
    half = length / 2
    hermite = np.array(
        [[0.5, -0.75, 0, 0.25], [0.25, -0.25, -0.25, 0.25], [0.5, 0.75, 0, -0.25], [-0.25, -0.25, 0.25, 0.25]]
    )
    hermite[[1, 3]] *= half

    def shapes(derivative: int) -> np.ndarray:
        ends = [np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyder(c, derivative)) for c in hermite]
        return np.vstack([ends, _bubbles(2, bubbles, x, derivative)])

    bent, moved = shapes(2) / half**2, shapes(0)
    return EI * half * (bent * weight) @ bent.T, rhoA * half * (moved * weight) @ moved.T


def _timoshenko_element(length: float, EI: float, rhoA: float, kGA: float, rhoI: float, bubbles: int) -> Element:
    """Stiffness and mass of a Timoshenko element; unknowns f, theta in front, f, theta behind, bubbles of f, of theta."""
    x, weight = legendre.leggauss(bubbles + 4)
    half = length / 2
    linear = [np.array([(1 - x) / 2, (1 + x) / 2]), np.array([-0.5 + 0 * x, 0.5 + 0 * x])]
    value, slope = (np.vstack([linear[d], _bubbles(1, bubbles, x, d)]) for d in (0, 1))
    size = bubbles + 2
    f = np.r_[0, 2, 4 : 4 + bubbles]
    theta = np.r_[1, 3, 4 + bubbles : 4 + 2 * bubbles]
    K, M = np.zeros((2 * size, 2 * size)), np.zeros((2 * size, 2 * size))
    shear = np.zeros((2 * size, x.size))
    shear[f], shear[theta] = slope / half, -value
    bent = np.zeros_like(shear)
    bent[theta] = slope / half
    moved, turned = np.zeros_like(shear), np.zeros_like(shear)
    moved[f], turned[theta] = value, value
    K += half * (EI * (bent * weight) @ bent.T + kGA * (shear * weight) @ shear.T)
    M += half * (rhoA * (moved * weight) @ moved.T + rhoI * (turned * weight) @ turned.T)
    return K, M


def matrices(parameters: Mapping[str, Any], bubbles: int) -> Element:
    """Stiffness and mass of the whole shaft.

    Shear or rotary inertia in any segment make all of them Timoshenko elements; ``kGA`` must then be finite. Unknowns that a
    rigid support or a clamped end holds are left out.
    """
    v = complete(parameters)
    n = len(v["length"])
    timoshenko = np.any(np.isfinite(v["kGA"])) or np.any(v["rhoI"] > 0)
    free = np.isfinite(v["k_hinge"])
    own = 2 * bubbles if timoshenko else bubbles
    # Unknowns: f at the nodes, then theta in front of and behind every node (one if the joint is rigid), then bubbles.
    theta_before, theta_behind, count = np.zeros(n + 1, int), np.zeros(n + 1, int), n + 1
    for node in range(n + 1):
        theta_before[node] = theta_behind[node] = count
        count += 1
        if 0 < node < n and free[node - 1]:
            theta_behind[node] = count
            count += 1
    K, M = np.zeros((count + n * own, count + n * own)), np.zeros((count + n * own, count + n * own))
    for i in range(n):
        if timoshenko:
            k, m = _timoshenko_element(*(v[x][i] for x in ("length", "EI", "rhoA", "kGA", "rhoI")), bubbles)
        else:
            k, m = _euler_element(*(v[x][i] for x in ("length", "EI", "rhoA")), bubbles)
        index = np.r_[i, theta_behind[i], i + 1, theta_before[i + 1], count + i * own + np.arange(own)]
        K[np.ix_(index, index)] += k
        M[np.ix_(index, index)] += m
    springs, loads = np.zeros(len(K)), np.zeros(len(K))
    springs[: n + 1] = np.r_[v["k_A"], v["k_joint"], v["k_D"]]
    springs[[theta_behind[0], theta_before[n]]] = v["k_rot_A"], v["k_rot_D"]
    loads[: n + 1] = np.r_[v["m_A"], v["m_joint"], v["m_D"]]
    loads[[theta_behind[0], theta_before[n]]] = v["I_A"], v["I_D"]
    for j, inertia in enumerate(v["I_joint"]):
        loads[theta_before[j + 1]] += inertia / 2
        loads[theta_behind[j + 1]] += inertia / 2
    K += np.diag(np.where(np.isinf(springs), 0.0, springs))
    M += np.diag(loads)
    for j in np.flatnonzero(free):
        pair = [theta_before[j + 1], theta_behind[j + 1]]
        K[np.ix_(pair, pair)] += v["k_hinge"][j] * np.array([[1, -1], [-1, 1]])
    kept = np.isfinite(springs)
    return K[np.ix_(kept, kept)], M[np.ix_(kept, kept)]


def finite_elements(parameters: Mapping[str, Any], modes: int, bubbles: int = 14) -> np.ndarray:
    """The first ``modes`` natural angular frequencies [rad/s]; zero modes are small numbers instead of 0."""
    K, M = matrices(parameters, bubbles)
    v = complete(parameters)
    mass = max(np.max(v["rhoA"]), np.max(np.r_[v["m_A"], v["m_joint"], v["m_D"]]) / np.sum(v["length"]))
    shift = (np.pi / np.sum(v["length"])) ** 4 * np.min(v["EI"]) / mass
    values = _lowest(K, M, shift, modes)
    # The smallest value that is no zero mode is the best shift: values far below the shift are lost in rounding.
    elastic = values[values > 1e-9 * values[-1]]
    values = _lowest(K, M, elastic[0], modes)
    return np.sqrt(np.maximum(values, 0.0))


def _lowest(K: np.ndarray, M: np.ndarray, shift: float, modes: int) -> np.ndarray:
    """Smallest eigenvalues of ``K - lambda M``, from the largest eigenvalues of ``M - mu (K + shift M)``."""
    stiff = K + shift * M
    scale = 1 / np.sqrt(np.diag(stiff))
    size = len(K)
    inverse = eigh(
        scale[:, None] * M * scale,
        scale[:, None] * stiff * scale,
        eigvals_only=True,
        subset_by_index=[size - modes, size - 1],
    )
    return 1 / inverse[::-1] - shift


def transfer_determinant(p: float, parameters: Mapping[str, Any]) -> float:
    """Psi(p) of the paper, (25), from plain transfer matrices, also for k_A = 0; parameters are Python floats."""
    k_A, k_D = parameters["k_A"], parameters["k_D"]
    # The two free columns at the left end, entry by entry: small NumPy arrays take several times as long.
    columns = ((0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, k_A))
    for length, EI, rhoA in zip(parameters["length"], parameters["EI"], parameters["rhoA"], strict=True):
        alpha = (p * p * rhoA / EI) ** 0.25
        z = alpha * length
        c, s, ch, sh = math.cos(z), math.sin(z), math.cosh(z), math.sinh(z)
        f0, f1, f2, f3 = 0.5 * (ch + c), 0.5 * (sh + s), 0.5 * (ch - c), 0.5 * (sh - s)
        moment = alpha * alpha * EI
        force = alpha * moment
        moved = []
        for deflection, slope, bent, sheared in columns:
            x, y, u, w = deflection, slope / alpha, -bent / moment, -sheared / force
            moved.append(
                (
                    f0 * x + f1 * y + f2 * u + f3 * w,
                    (f3 * x + f0 * y + f1 * u + f2 * w) * alpha,
                    -(f2 * x + f3 * y + f0 * u + f1 * w) * moment,
                    -(f1 * x + f2 * y + f3 * u + f0 * w) * force,
                )
            )
        columns = tuple(moved)
    (r11, _, r31, r41), (r12, _, r32, r42) = columns
    return (r31 * r42 - r32 * r41) - k_D * (r11 * r32 - r12 * r31)


def determinant_roots(parameters: Mapping[str, Any], modes: int, points_per_mode: int = 12) -> np.ndarray:
    """The first ``modes`` natural angular frequencies by a scan of the determinant and Brent's method."""
    lists = {name: [float(value) for value in parameters[name]] for name in ("length", "EI", "rhoA")}
    shaft = lists | {name: float(parameters[name]) for name in ("k_A", "k_D")}
    beta = sum(
        length * (rhoA / EI) ** 0.25
        for length, EI, rhoA in zip(shaft["length"], shaft["EI"], shaft["rhoA"], strict=True)
    )
    step = math.pi / beta / points_per_mode
    roots: list[float] = []
    q = 1e-3 * step
    before = transfer_determinant(q * q, shaft)
    while len(roots) < modes:
        after = transfer_determinant((q + step) ** 2, shaft)
        if before * after < 0:
            roots.append(brentq(transfer_determinant, q * q, (q + step) ** 2, args=(shaft,), xtol=1e-12, rtol=1e-13))
        q, before = q + step, after
    return np.array(roots)
