"""The usual methods for a stepped shaft, Hermite finite elements and the dynamic stiffness matrix, by NumPy and SciPy.

Both methods take the parameters ``length``, ``EI``, ``rhoA``, ``k_A``, ``k_D`` of the system by name. The code is
independent of the package.

Finite elements: cubic deflection on every element, ``K u = p^2 M u`` with (f, theta) at the nodes. Dynamic stiffness: the
exact relation between (f, theta) and (F, -M) at the ends of a segment of phase ``z = length (p^2 rhoA/EI)^(1/4)``,

    K11 = a z^3 (sin ch + cos sh), K12 = a z^2 l sin sh, K13 = -a z^3 (sin + sh), K14 = a z^2 l (ch - cos),
    K22 = a z l^2 (sin ch - cos sh), K24 = a z l^2 (sh - sin),           a = EI/(l^3 (1 - cos ch)),

and the count of Wittrick and Williams (1971), ``N(p) = sum J0 + negative eigenvalues of K(p)``, which is bisected.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import eigsh

# Number of unknowns up to which dense LAPACK is faster, and share of all modes from which it is faster.
_DENSE, _SHARE = 60, 0.2
_HERMITE_STIFFNESS = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], float)
_HERMITE_MASS = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420


def hermite_matrices(p: Mapping[str, Any], elements: int) -> tuple[csc_array, csc_array]:
    """Stiffness and mass with ``elements`` equal elements in every segment; unknowns f, theta node by node."""
    length, EI, rhoA = (np.repeat(np.asarray(p[name], float), elements) for name in ("length", "EI", "rhoA"))
    h, count = length / elements, 2 * length.size + 2
    scale = np.stack([np.ones_like(h), h, np.ones_like(h), h])
    scale = scale[:, None] * scale
    stiffness = (EI / h**3)[:, None, None] * np.moveaxis(_HERMITE_STIFFNESS[..., None] * scale, -1, 0)
    mass = (rhoA * h)[:, None, None] * np.moveaxis(_HERMITE_MASS[..., None] * scale, -1, 0)
    index = 2 * np.arange(h.size)[:, None] + np.arange(4)
    rows, columns = np.repeat(index, 4, axis=1).ravel(), np.tile(index, 4).ravel()
    springs = ([0, count - 2], [0, count - 2], [p["k_A"], p["k_D"]])
    k = coo_array(
        (np.r_[stiffness.ravel(), springs[2]], (np.r_[rows, springs[0]], np.r_[columns, springs[1]])),
        shape=(count, count),
    )
    return k.tocsc(), coo_array((mass.ravel(), (rows, columns)), shape=(count, count)).tocsc()


def hermite_frequencies(p: Mapping[str, Any], modes: int, elements: int) -> np.ndarray:
    """The first ``modes`` angular frequencies; NaN for modes that the elements do not have."""
    k, m = hermite_matrices(p, elements)
    size = k.shape[0]
    found = min(modes, size)
    if size <= _DENSE or found > _SHARE * size:
        values = eigh(k.toarray(), m.toarray(), eigvals_only=True, subset_by_index=[0, found - 1])
    else:
        # Shift below all values, because K alone is singular for a free shaft.
        shift = (np.pi / np.sum(p["length"])) ** 4 * np.min(p["EI"]) / np.max(p["rhoA"])
        values = np.sort(eigsh(k, found, m, sigma=-shift, return_eigenvectors=False))
    return np.r_[np.sqrt(np.maximum(values, 0.0)), np.full(modes - found, np.nan)]


def dynamic_stiffness(p: Mapping[str, Any], q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrix ``(..., 2n + 2, 2n + 2)`` at ``q = sqrt(p)`` and the number of clamped frequencies below, ``(...)``.

    Lists and springs may have further axes that broadcast with ``q``: many shafts at once.
    """
    n = len(p["length"])
    matrix = np.zeros((*q.shape, 2 * n + 2, 2 * n + 2))
    clamped = np.zeros(q.shape)
    for i, (length, EI, rhoA) in enumerate(zip(p["length"], p["EI"], p["rhoA"], strict=True)):
        z = q * length * (rhoA / EI) ** 0.25
        # Hyperbolic functions divided by exp(z), a factor that cancels.
        s, c, e = np.sin(z), np.cos(z), np.exp(-z)
        ch, sh = (1 + e * e) / 2, (1 - e * e) / 2
        delta = e - c * ch
        a = EI / length**3 / delta
        force, turn, moment = a * z**3 * (s * ch + c * sh), a * z**2 * length * s * sh, a * z * length**2
        far, slope = -a * z**3 * (s * e + sh), a * z**2 * length * (ch - c * e)
        own, other = moment * (s * ch - c * sh), moment * (sh - s * e)
        rows = (
            (force, turn, far, slope),
            (turn, own, -slope, other),
            (far, -slope, force, -turn),
            (slope, other, -turn, own),
        )
        for row in range(4):
            for column in range(4):
                matrix[..., 2 * i + row, 2 * i + column] += rows[row][column]
        half_waves = np.floor(z / np.pi)
        clamped += half_waves - (1 - (1 - 2 * (half_waves % 2)) * np.sign(delta)) / 2
    matrix[..., 0, 0] += p["k_A"]
    matrix[..., -2, -2] += p["k_D"]
    return matrix, clamped


def count_below(p: Mapping[str, Any], q: np.ndarray) -> np.ndarray:
    """The number of natural frequencies below ``q^2`` [rad/s]."""
    matrix, clamped = dynamic_stiffness(p, q)
    # Scale to a unit diagonal, which keeps the signs and does not lose small entries next to large ones.
    size = np.sqrt(np.abs(np.diagonal(matrix, axis1=-2, axis2=-1)))
    values = np.linalg.eigvalsh(matrix / (size[..., None] * size[..., None, :]))
    return clamped + np.sum(values < 0, axis=-1)


def dynamic_stiffness_frequencies(p: Mapping[str, Any], modes: int, rtol: float) -> np.ndarray:
    """The first ``modes`` angular frequencies ``(modes, ...)`` of all shafts, bisected together.

    A frequency below ``1e-6`` of the first clamped frequency counts as 0.
    """
    total = sum(length * (r / e) ** 0.25 for length, e, r in zip(p["length"], p["EI"], p["rhoA"], strict=True))
    index = np.arange(1, modes + 1).reshape(modes, *(1,) * np.ndim(total))
    high = np.pi * (index + 1.6 * len(p["length"])) / total
    low = np.broadcast_to(1e-3 * np.pi / total, high.shape)
    zero = count_below(p, low) >= index
    for _ in range(int(np.ceil(np.log2(4 * high.max() / low.min() / rtol)))):
        middle = (low + high) / 2
        above = count_below(p, middle) >= index
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.where(zero, 0.0, ((low + high) / 2) ** 2)
