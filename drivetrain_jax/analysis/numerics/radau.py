"""Radau IIA collocation schemes."""

from functools import lru_cache

import numpy as np


@lru_cache
def radau_iia(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients ``(A, c)`` of the Radau IIA collocation scheme of order ``2 stages - 1``.

    The nodes are the zeros of P_s - P_(s-1) shifted to [0, 1]; A[i, j] = int_0^c_i l_j, by Gauss quadrature of the
    Lagrange polynomials in product form (Hairer & Wanner, Solving ODEs II, IV.5).
    """
    basis = np.polynomial.legendre.Legendre.basis
    polynomial = basis(stages) - basis(stages - 1)
    x = np.sort(polynomial.roots().real)
    for _ in range(3):
        x = x - polynomial(x) / polynomial.deriv()(x)
    c = (x + 1) / 2
    c[-1] = 1.0
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    points = c[:, None] * (nodes + 1) / 2
    lagrange = np.ones((stages, *points.shape))
    for j in range(stages):
        for k in set(range(stages)) - {j}:
            lagrange[j] *= (points - c[k]) / (c[j] - c[k])
    return np.einsum("jiq,q->ij", lagrange, weights / 2) * c[:, None], c
