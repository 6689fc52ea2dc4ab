"""Frequencies of the stepped shaft to 30 digits and more, from the paper's determinant with enough additional digits.

``Psi(p)``, (25) of the paper, loses the factor ``exp(tau)`` in accuracy, where tau is the sum of all phases; mpmath works
with that many more digits. Number and position of the frequencies come from finite elements of high degree
(:func:`tests.oracles.bicardan_reference.finite_elements`), so that close frequencies are not missed. The two methods are
independent, and the result includes their difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mpmath
import numpy as np

from tests.oracles.bicardan_reference import finite_elements

DIGITS = 40
# Fraction of the highest frequency below which finite elements in double precision have no digits left to compare.
_COMPARED = 1e-4


def determinant(q: Any, p: Mapping[str, Any]) -> Any:
    """Psi at ``p = q^2`` over ``(1 + k_A)(1 + k_D)``, in the working precision of mpmath."""
    one = mpmath.mpf(1)
    k_A, k_D = mpmath.mpf(p["k_A"]), mpmath.mpf(p["k_D"])
    state = [[0, one / (1 + k_A)], [one, 0], [0, 0], [0, k_A / (1 + k_A)]]
    for length, EI, rhoA in zip(p["length"], p["EI"], p["rhoA"], strict=True):
        EI = mpmath.mpf(EI)
        alpha = q * mpmath.root(mpmath.mpf(rhoA) / EI, 4)
        z = alpha * mpmath.mpf(length)
        c, s, up = mpmath.cos(z), mpmath.sin(z), mpmath.exp(z)
        ch, sh = (up + 1 / up) / 2, (up - 1 / up) / 2
        f = ((ch + c) / 2, (sh + s) / 2, (ch - c) / 2, (sh - s) / 2)
        d = (one, 1 / alpha, -1 / (alpha**2 * EI), -1 / (alpha**3 * EI))
        state = [[sum(f[(j - i) % 4] * d[j] * state[j][k] for j in range(4)) / d[i] for k in (0, 1)] for i in range(4)]
    (r11, r12), _, (r31, r32), (r41, r42) = state
    return (r31 * r42 - r32 * r41) / (1 + k_D) - k_D / (1 + k_D) * (r11 * r32 - r12 * r31)


def precise_frequencies(
    p: Mapping[str, Any], modes: tuple[int, ...], bubbles: int = 30, digits: int = DIGITS
) -> tuple[list[Any], float]:
    """Angular frequencies of the elastic ``modes`` (numbered from 1) as mpmath numbers, and the largest relative difference
    from the finite elements (for frequencies above 1e-4 of the highest one)."""
    rough = finite_elements(p, max(modes), bubbles)
    tau = max(rough) ** 0.5 * sum(
        length * (rhoA / EI) ** 0.25 for length, EI, rhoA in zip(p["length"], p["EI"], p["rhoA"], strict=True)
    )
    found = []
    with mpmath.workdps(digits + int(2 * tau / np.log(10)) + 40):
        for mode in modes:
            q = mpmath.sqrt(mpmath.mpf(rough[mode - 1]))
            ends = (q * (1 - mpmath.mpf(10) ** -13), q * (1 + mpmath.mpf(10) ** -13))
            q = mpmath.findroot(lambda x: determinant(x, p), ends, tol=mpmath.mpf(10) ** (-2 * digits), verify=False)
            found.append(q * q)
    pairs = [(rough[mode - 1], value) for mode, value in zip(modes, found, strict=True)]
    return found, max(abs(float(r / value) - 1) for r, value in pairs if value > _COMPARED * found[-1])
