"""Growth rate ln|sigma| of one Floquet multiplier with its derivatives, from left and right eigenvectors.

For a simple eigenvalue with Z x = sigma x, y^H Z = sigma y^H, y^H x = 1 and the other pairs (x_k, y_k), (k)

    sigma_i  = y^H Z_i x
    sigma_ij = y^H Z_ij x + sum_k [(y^H Z_i x_k)(y_k^H Z_j x) + (y^H Z_j x_k)(y_k^H Z_i x)] / (sigma - sigma_k)

Near the tip of a tongue these lose far fewer digits than the coefficients of the characteristic polynomial, whose
combination for a pair has a slope of only 1e-6 there; so points are found with the polynomial and polished here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivetrain_jax.atlas.criteria import LIMITING, MINUS, PLUS, Criteria, monodromy


@dataclass(frozen=True)
class Growth:
    """At N points: ``rate`` ln|sigma| ``(N,)``, its ``gradient`` ``(N, d)`` and ``hessian`` ``(N, d, d)`` in coordinates.

    ``error`` ``(N,)`` is a bound of the rate's error to first order: the panel's
    (statistical) bound of Phi times the condition number of the eigenvalue.
    """

    rate: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    error: np.ndarray


def growth(criteria: Criteria, x: np.ndarray, kinds: list[str], *, second: bool = False) -> Growth:
    """The multiplier nearest to +1, to -1 or (pair) to the unit circle, as ``kinds`` says for each point ``(N, d)``.

    The kind ``"largest"`` is the largest in modulus. The hessian is computed only if ``second``; it is NaN otherwise.
    """
    n, d = x.shape
    phi = criteria.propagator(x)
    z = _matrices(phi, phi)
    first = _derivatives(criteria, x, 1)
    sigma, right, left = _eigen(z)
    chosen = _choose(sigma, kinds)
    rows = np.arange(n)
    s, xr, yl = sigma[rows, chosen], right[rows, :, chosen], left[rows, chosen]
    dz = [_matrices(a, phi) + _matrices(phi, a) for a in first]
    ds = np.stack([np.einsum("ni,nij,nj->n", yl, a, xr) for a in dz], axis=-1)
    hessian = np.full((n, d, d), np.nan)
    # Points outside the panels are NaN here and below.
    if second:
        with np.errstate(invalid="ignore"):
            hessian = _second(criteria, x, phi, first, dz, (sigma, right, left, chosen, ds))
    size = np.linalg.norm(xr, axis=1) * np.linalg.norm(yl, axis=1)
    error = monodromy_error(criteria, x, phi) * size / np.abs(s)
    with np.errstate(invalid="ignore"):
        return Growth(np.log(np.abs(s)), (ds / s[:, None]).real, hessian, error)


def limiting(criteria: Criteria, x: np.ndarray, own: Growth) -> np.ndarray:
    """Flags ``(N,)`` of points ``x`` at which no multiplier except ``own`` grows.

    The multipliers ``own`` are on the unit circle up to their rates. With little damping growth rates within a tongue are
    small.
    """
    largest = growth(criteria, x, ["largest"] * len(x))
    with np.errstate(invalid="ignore"):
        bound = np.fmin(np.abs(own.rate) + own.error + largest.error, LIMITING)
        return np.log(criteria.spectral_radius(x)) <= bound


def _second(criteria: Criteria, x: np.ndarray, phi: np.ndarray, first: Any, dz: list, eigen: tuple) -> np.ndarray:
    sigma, right, left, chosen, ds = eigen
    n, d = x.shape
    rows = np.arange(n)
    s, xr, yl = sigma[rows, chosen], right[rows, :, chosen], left[rows, chosen]
    gap = s[:, None] - sigma
    gap[rows, chosen] = np.inf
    into = [np.einsum("nki,nij,nj->nk", left, a, xr) for a in dz]
    out = [np.einsum("ni,nij,njk->nk", yl, a, right) for a in dz]
    hessian = np.empty((n, d, d))
    for (i, j), phi_ij in _derivatives(criteria, x, 2).items():
        z_ij = _matrices(phi_ij, phi) + _matrices(phi, phi_ij) + _matrices(first[i], first[j])
        z_ij = z_ij + _matrices(first[j], first[i])
        s_ij = np.einsum("ni,nij,nj->n", yl, z_ij, xr) + ((out[i] * into[j] + out[j] * into[i]) / gap).sum(axis=1)
        hessian[:, i, j] = hessian[:, j, i] = (s_ij / s - ds[:, i] * ds[:, j] / s**2).real
    return hessian


def _eigen(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues ``(N, 4)``, right ones as columns and left ones as rows with unit products; NaN where not finite."""
    finite = np.isfinite(z).all(axis=(1, 2))
    sigma, right = np.linalg.eig(np.where(finite[:, None, None], z, np.diag([1.0, 2.0, 3.0, 4.0])).astype(complex))  # pyright: ignore[reportIndexIssue]
    singular = np.linalg.svd(right, compute_uv=False)[:, -1] < np.finfo(float).eps
    left = np.linalg.inv(np.where(singular[:, None, None], np.eye(4), right))
    bad = ~finite | singular
    return (
        np.where(bad[:, None], np.nan, sigma),
        np.where(bad[:, None, None], np.nan, right),
        np.where(bad[:, None, None], np.nan, left),
    )


def _choose(sigma: np.ndarray, kinds: list[str]) -> np.ndarray:
    targets = {
        PLUS: np.abs(sigma - 1),
        MINUS: np.abs(sigma + 1),
        "largest": -np.abs(sigma),
        # Of a conjugate pair only the multiplier with positive imaginary part.
        "pair": np.abs(np.abs(sigma) - 1) + np.where(sigma.imag > 0, 0.0, 1e3),  # pyright: ignore[reportAttributeAccessIssue]
    }
    distance = np.stack([targets[kind][i] for i, kind in enumerate(kinds)]) if kinds else np.empty((0, 4))
    return np.argmin(np.nan_to_num(distance, nan=0.0), axis=1)


def _matrices(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """X L^T X R for propagators ``(16, N)``, ``(N, 4, 4)``."""
    return np.moveaxis(monodromy(right, left), -1, 0)


def _derivatives(criteria: Criteria, x: np.ndarray, order: int) -> Any:
    """First derivatives of Phi as a list, or the second ones by pairs of coordinates."""
    d = x.shape[1]
    if order == 1:
        return [criteria.propagator(x, tuple(int(k == i) for k in range(d))) for i in range(d)]
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    return {(i, j): criteria.propagator(x, tuple(int(k == i) + int(k == j) for k in range(d))) for i, j in pairs}


def monodromy_error(criteria: Criteria, x: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Bound of the norm of the error of Z at points where the propagator is ``phi``, ``(N,)``; inf outside the panels."""
    found = criteria.atlas.find(x)
    errors = np.array([panel.value_error for panel in criteria.atlas.panels])
    error = np.where(found >= 0, errors[np.maximum(found, 0)], np.inf)
    size = np.sqrt((phi**2).sum(axis=0))
    return 2 * size * (error + 8 * np.finfo(float).eps * size)
