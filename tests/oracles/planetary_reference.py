"""The planetary gear independently of the package: oracle of the tests and rival of the benchmark.

Forces are assembled entry by entry with NumPy; eigenvalues are from SciPy or, to any number of digits, from mpmath.

    M q'' + K q = 0,  K = sum over springs of k d d^T,  f = sqrt(lambda(K, M))/(2 pi),

with d the extension of a spring per unit of the coordinates q = [x, y, u] of carrier, ring, sun, [xi, eta, u] of planets.
The stiffness matrix comes from the equations of motion, body by body, whereas the package uses the extensions of the
springs; both agree only if both are right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import eigh

# Table 2 of the paper; inertias are I/r^2 in kg, the pressure angle in rad.
TABLE_2 = {
    **{"m_s": 0.4, "m_r": 2.35, "m_c": 5.43, "m_p": 0.66, "I_s": 0.39, "I_r": 3.0, "I_c": 6.29, "I_p": 0.61},
    **{"k_sp": 5e8, "k_rp": 5e8, "k_p": 1e8, "k_s": 1e8, "k_r": 1e8, "k_c": 1e8, "k_su": 0.0, "k_ru": 1e9, "k_cu": 0.0},
    "pressure_angle": math.radians(24.6),
}
# Names in tests/reference/planetary.json, and names in this module.
_SHORT = {"ms": "m_s", "mr": "m_r", "mc": "m_c", "mp": "m_p", "Is": "I_s", "Ir": "I_r", "Ic": "I_c", "Ip": "I_p"}
_SHORT |= {"ksp": "k_sp", "krp": "k_rp", "kp": "k_p", "ks": "k_s", "kr": "k_r", "kc": "k_c"}
_SHORT |= {"ksu": "k_su", "kru": "k_ru", "kcu": "k_cu"}


def case_parameters(case: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of the package, in rad, from a case of tests/reference/planetary.json."""
    given = {_SHORT[name]: value for name, value in case["params"].items() if name != "alpha"}
    angles = tuple(math.radians(angle) for angle in case["psi_deg"])
    return {"planet_angle": angles, "pressure_angle": math.radians(case["params"]["alpha"]), **given}


def _per_planet(value: float | Sequence[float], count: int) -> list[float]:
    return [value] * count if np.ndim(value) == 0 else list(value)


def matrices(p: Mapping[str, Any], functions: Any = math) -> tuple[list[float], list[list[Any]]]:
    """Diagonal of the mass matrix and the stiffness matrix, dofs [x, y, u] of c, r, s, then [xi, eta, u] of each
    planet.

    Written from the equations of motion (1)-(12) of the paper with their signs corrected: one row per force balance.
    ``functions`` offers ``sin`` and ``cos``: ``math`` or ``mpmath``.
    """
    sin, cos, angles = functions.sin, functions.cos, p["planet_angle"]
    n = len(angles)
    size = 9 + 3 * n
    stiffness = [[0 * sin(angles[0]) for _ in range(size)] for _ in range(size)]
    mass = [p[f"{kind}_{body}"] for body in "crs" for kind in ("m", "m", "I")]
    for i, (m, inertia) in enumerate(zip(_per_planet(p["m_p"], n), _per_planet(p["I_p"], n), strict=True)):
        mass += [m, m, inertia]
        _add_planet(stiffness, p, i, sin, cos)
    for body, first in zip("crs", (0, 3, 6), strict=True):
        for offset, axis in enumerate("xyu"):
            stiffness[first + offset][first + offset] += p.get(f"k_{body}{axis}", p.get(f"k_{body}"))
    return mass, stiffness


def _add_planet(stiffness: list[list[Any]], p: Mapping[str, Any], i: int, sin: Any, cos: Any) -> None:
    """The bearing and the two meshes of planet ``i``: the force of each times its direction on every body."""
    angle, at, n = p["planet_angle"][i], 9 + 3 * i, len(p["planet_angle"])
    r, s = (p.get(f"pressure_angle_{body}", p["pressure_angle"]) for body in "rs")
    ring, sun = angle + r, angle - s
    meshes = (
        ("k_p", {0: cos(angle), 1: sin(angle), at: -1}),
        ("k_p", {0: -sin(angle), 1: cos(angle), 2: 1, at + 1: -1}),
        ("k_rp", {3: -sin(ring), 4: cos(ring), 5: 1, at: sin(r), at + 1: -cos(r), at + 2: -1}),
        ("k_sp", {6: -sin(sun), 7: cos(sun), 8: 1, at: -sin(s), at + 1: -cos(s), at + 2: 1}),
    )
    for name, direction in meshes:
        k = _per_planet(p[name], n)[i]
        for row, force in direction.items():
            for column, motion in direction.items():
                stiffness[row][column] += k * force * motion


def natural_frequencies(p: Mapping[str, Any]) -> np.ndarray:
    """Natural frequencies in Hz, rising, by LAPACK from mass and stiffness matrices, with errors of about eps f_max^2/f."""
    mass, stiffness = matrices(p)
    values = eigh(np.array(stiffness, float), np.diag(mass), eigvals_only=True)
    return np.sqrt(np.maximum(values, 0)) / (2 * math.pi)


def exact_frequencies(p: Mapping[str, Any], digits: int = 50) -> list[float]:
    """Natural frequencies in Hz, rising, in ``digits`` decimal digits, rounded once at the end."""
    from mpmath import mp

    with mp.workdps(digits):
        values = mp.eigsy(_scaled(p), eigvals_only=True)
        return [float(mp.sqrt(max(value, mp.mpf(0))) / (2 * mp.pi)) for value in values]


def exact_shapes(p: Mapping[str, Any], digits: int = 50) -> np.ndarray:
    """Orthonormal eigenvectors of ``M^(-1/2) K M^(-1/2)``, one a row, by rising frequency, rounded once at the end."""
    from mpmath import mp

    with mp.workdps(digits):
        return np.array(mp.eigsy(_scaled(p))[1].T.tolist(), float)


def _scaled(p: Mapping[str, Any]) -> Any:
    """``M^(-1/2) K M^(-1/2)`` in the working precision of mpmath."""
    from mpmath import mp

    lifted = {
        name: [mp.mpf(entry) for entry in value] if np.ndim(value) else mp.mpf(value) for name, value in p.items()
    }
    mass, stiffness = matrices(lifted, mp)
    size = len(mass)
    return mp.matrix(
        [[stiffness[row][column] / mp.sqrt(mass[row] * mass[column]) for column in range(size)] for row in range(size)]
    )


def extension_matrix(p: Mapping[str, Any]) -> np.ndarray:
    """``diag(sqrt k) B M^(-1/2)``, shape (..., 4N + 9, 3N + 9), whose singular values over 2 pi are the frequencies.

    These are the matrices that the package decomposes, for LAPACK. Parameters may be arrays of one common shape ``(...)``
    (and ``planet_angle`` a list of such arrays).
    """
    angles = np.moveaxis(np.stack(np.broadcast_arrays(*p["planet_angle"])), 0, -1)
    a, n = np.asarray(p["pressure_angle"])[..., None], angles.shape[-1]
    names = [name for name in p if name not in ("planet_angle", "pressure_angle")]
    shape = np.broadcast_shapes(angles.shape[:-1], *(np.shape(p[name]) for name in names), a.shape[:-1])
    g, i = np.zeros((*shape, 4 * n + 9, 3 * n + 9)), np.arange(n)
    c, s, at = np.cos, np.sin, 9 + 3 * i
    directions = (
        {0: c(angles), 1: s(angles), "xi": -1.0},
        {0: -s(angles), 1: c(angles), 2: 1.0, "eta": -1.0},
        {3: -s(angles + a), 4: c(angles + a), 5: 1.0, "xi": s(a), "eta": -c(a), "u": -1.0},
        {6: -s(angles - a), 7: c(angles - a), 8: 1.0, "xi": -s(a), "eta": -c(a), "u": 1.0},
    )
    own = {"xi": at, "eta": at + 1, "u": at + 2}
    for spring, (name, direction) in enumerate(zip(("k_p", "k_p", "k_rp", "k_sp"), directions, strict=True)):
        for column, value in direction.items():
            g[..., 4 * i + spring, own.get(column, column)] = value * np.sqrt(np.asarray(p[name])[..., None])
    bearings = [f"k_{body}{kind}" for body in "crs" for kind in ("", "", "u")]
    masses = [f"{kind}_{body}" for body in "crs" for kind in ("m", "m", "I")] + ["m_p", "m_p", "I_p"] * n
    for row, name in enumerate(bearings):
        g[..., 4 * n + row, row] = np.sqrt(p[name])
    for column, name in enumerate(masses):
        g[..., column] /= np.sqrt(np.asarray(p[name])[..., None])
    return g
