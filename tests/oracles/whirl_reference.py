"""Whirl of a stepped shaft by finite elements of high degree in NumPy, independent of the package.

Stiffness and mass of either plane are those of ``bicardan_reference``; polar inertias take the place of rotary ones in a
mass matrix without masses. With K = L L^T, M = R R^T and the polar inertias G, ``(K - omega^2 M + omega speed G) z = 0``
has the symmetric linearisation ``[[-speed L^-1 G L^-T, L^-1 R], [R^T L^-T, 0]]`` with the eigenvalues 1/omega.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import eigh, solve_triangular

from tests.oracles.bicardan_reference import matrices

_ENDS = ("A", "joint", "D")


def whirl(parameters: Mapping[str, Any], modes: int, bubbles: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """The lowest ``modes`` |omega| [rad/s] and their directions ``2 X.MY/(X.MX + Y.MY)``.

    Supports that are rigid are so in both planes, and no motion is free.
    """
    known = {name: value for name, value in parameters.items() if not name.startswith(("Ip_", "rhoIp", "speed"))}
    first = {name: value for name, value in known.items() if not name.endswith("_y")}
    second = first | {f"k_{end}": known[f"k_{end}_y"] for end in _ENDS if f"k_{end}_y" in known}
    zero = np.zeros(len(parameters["length"]))
    polar = first | {f"m_{end}": 0.0 for end in _ENDS} | {"rhoA": zero, "rhoI": parameters.get("rhoIp", zero)}
    polar |= {f"I_{end}": parameters.get(f"Ip_{end}", 0.0) for end in _ENDS}
    (K, M), (K_y, _), (_, G) = (matrices(values, bubbles) for values in (first, second, polar))
    size, none = len(K), np.zeros_like(K)
    whole, mass = np.block([[K, none], [none, K_y]]), np.block([[M, none], [none, M]])
    scale = 1 / np.sqrt(np.diag(whole))
    lower = np.linalg.cholesky(scale[:, None] * whole * scale)

    def between(matrix: np.ndarray) -> np.ndarray:
        """``L^-1 matrix L^-T``."""
        left = solve_triangular(lower, scale[:, None] * matrix * scale, lower=True)
        return solve_triangular(lower, left.T, lower=True).T

    values, vectors = eigh(between(mass))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    turned = parameters.get("speed", 0.0) * between(np.block([[none, G], [G, none]]))
    reciprocal, states = eigh(np.block([[-turned, root], [root.T, np.zeros_like(turned)]]))
    # The spectrum is symmetric: omega > 0 holds every mode once.
    states = states[:, np.argsort(-reciprocal)[:modes]]
    reciprocal = np.sort(reciprocal)[::-1][:modes]
    z = scale[:, None] * solve_triangular(lower.T, states[: 2 * size])
    x, y = z[:size], z[size:]
    return 1 / reciprocal, 2 * np.sum(x * (M @ y), 0) / (np.sum(x * (M @ x), 0) + np.sum(y * (M @ y), 0))
