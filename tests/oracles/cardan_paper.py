"""Tables and equations as printed in the cardan paper (Soltan Rezaee & Ghazavi 2014), by NumPy and SciPy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tests.oracles.cardan_reference import (
    BASE_CASE,
    Matrices,
    Pair,
    damping_and_stiffness,
    speed_ratio,
    stacked_monodromy,
)

PRINTED_FREQUENCIES = (0.072, 1.422)
# Tables 1 and 2 as printed. The column of Table 2 headed Omega^C holds the difference combinations C-.
PRINTED_SPEEDS = {
    "S11": 0.072, "S12": 0.024, "S21": 1.422, "S22": 0.474,
    "H11": 0.035, "H12": 0.018, "H21": 0.712, "H22": 0.356,
    "C+1": 0.747, "C+2": 0.373, "C-1": 0.675, "C-2": 0.338,
}  # fmt: skip


def natural_frequencies(mu: float = 1.0, gamma: float = 100.0) -> np.ndarray:
    """The paper's eq. (25) from the mass and stiffness matrices in absolute coordinates, not from its closed form."""
    g = np.array([-1.0, 1 / math.sqrt(gamma)])
    return np.sqrt(np.linalg.eigvalsh(np.diag([1.0, 0.0]) + mu * np.outer(g, g)))


def predicted_speeds(frequencies: Sequence[float]) -> dict[str, float]:
    """Speeds of the harmonic, subharmonic and combination resonances, eqs (23)-(24), for k = 1, 2."""
    one, two = frequencies
    speeds = {}
    for k in (1, 2):
        speeds |= {
            f"S1{k}": one / (2 * k - 1),
            f"S2{k}": two / (2 * k - 1),
            f"H1{k}": one / (2 * k),
            f"H2{k}": two / (2 * k),
        }
        speeds |= {f"C+{k}": (two + one) / (2 * k), f"C-{k}": (two - one) / (2 * k)}
    return speeds


def printed_matrices(eta_term: float) -> Matrices:
    """The paper's (15) with P21 = ``eta_term`` eta/Omega^2: +1 as printed, -1 with only this sign corrected."""

    def matrices(tau: float, p: Mapping[str, Any]) -> tuple[Pair, Pair]:
        (row1, (_, e22)), (k1, (_, k22)) = damping_and_stiffness(tau, p)
        eta, d1, _ = speed_ratio(tau, p["cos_beta"], p["sin2_beta"])
        return (row1, (d1 - 2 * p["zeta"] / p["Omega"] * eta, e22)), (k1, (eta_term * eta / p["Omega"] ** 2, k22))

    return matrices


def base_chart(stride: int) -> dict[str, np.ndarray]:
    """Every ``stride``-th beta and speed of the chart 151 x 200 (beta 0..1.5, Omega 0.01..2), as columns."""
    omega = np.linspace(0.01, 2.0, 200)
    beta, omega = np.meshgrid(np.linspace(0.0, 1.5, 151)[::stride], omega[stride // 2 :: stride], indexing="ij")
    return {"beta": beta.ravel(), "Omega": omega.ravel(), **BASE_CASE}


def unstable_fraction(matrices: Matrices, stride: int) -> tuple[float, float]:
    """Fraction of unstable cells by SciPy, and the fraction of these cells that count as stable by "or Re(sigma) <= 0"."""
    multipliers = np.linalg.eigvals(stacked_monodromy(base_chart(stride), 1e-8, 1e-8, batch=256, matrices=matrices))
    outside = np.abs(multipliers) > 1 + 1e-7
    unstable = outside.any(axis=1)
    kept = (outside & (multipliers.real > 0)).any(axis=1)
    return float(unstable.mean()), float(1 - kept.sum() / unstable.sum()) if unstable.any() else math.nan
