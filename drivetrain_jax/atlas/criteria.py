"""Analytic functions whose zeros are the stability boundaries of a linear periodic system of four states.

With p(sigma) = sigma^4 - a sigma^3 + b sigma^2 - c sigma + d = det(sigma I - Z), d = det Z known exactly (Liouville):

    multiplier +1:   p(+1) = 1 - a + b - c + d
    multiplier -1:   p(-1) = 1 + a + b + c + d
    a pair e^(+-iw): g = 1 + d - b + P Q,   P = (a - c)/(1 - d),   Q = (c - a d)/(1 - d)

because p = (sigma^2 - P sigma + 1)(sigma^2 - Q sigma + d) if and only if g = 0. Unlike the spectral radius they are
analytic across the boundary; all three are positive where the system is stable. g is the product of all
1 - sigma_i sigma_j (i < j) over (1 - d)^2.

Without dissipation d = 1 and a = c. The function of the pair is then the discriminant a^2/4 - b + 2. This is not the limit
of g for vanishing dissipation, which may give another boundary. p(-1) and p(+1) then factor: with Phi = [[A, B], [C, D]]
the edges are the zeros of det A and det D (multiplier -1), det B and det C (+1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.atlas import interpolation
from drivetrain_jax.atlas.panels import Atlas, Panel, derivative, position
from drivetrain_jax.systems import System

PLUS, MINUS, PAIR = "+1", "-1", "pair"
# A zero bounds the stable region only if no multiplier grows. A growth rate above this value counts as real.
LIMITING = 1e-6
_STATES = 4


def has_boundaries(atlas: Atlas, system: type[System]) -> bool:
    """True if ``atlas`` has panels, and the system four states, a reversor of their halves and ``log_determinant``."""
    if not atlas.panels:
        return False
    corner = {**atlas.fixed, **dict(zip(atlas.parameters, atlas.lower, strict=True))}
    form = system.models["floquet"].build(corner).reduced
    return form.exchanges_halves and form.log_determinant is not None


@dataclass(frozen=True)
class Criteria:
    """The boundary functions of ``atlas``, whose values are the propagator ``Phi`` of the reduced form of ``system``.

    Points are in the coordinates of the atlas, ``(N, d)``. ``conservative`` selects the functions without dissipation.
    Raises :class:`InputError` for a system without boundary functions (:func:`has_boundaries`).
    """

    atlas: Atlas
    system: type[System]
    conservative: bool = False

    def __post_init__(self) -> None:
        if not self.atlas.panels:
            reason = self.atlas.gaps[0].reason if self.atlas.gaps else "it covers nothing"
            raise InputError(f"file: the atlas has no panel ({reason}); expected one whose solves converged")
        if not has_boundaries(self.atlas, self.system):
            raise InputError(
                f"system = {self.system.name!r}: has no boundary functions; expected for boundaries and "
                "design answers a system of four states with a half-period propagator and log_determinant"
            )

    @classmethod
    def of(cls, atlas: Atlas, system: type[System]) -> Criteria:
        """The criteria for ``atlas``: those without dissipation if det Z = 1 everywhere in it."""
        criteria = cls(atlas, system)
        corners = atlas.to_coordinates(np.stack([atlas.lower, (atlas.lower + atlas.upper) / 2, atlas.upper]))
        return cls(atlas, system, conservative=bool((criteria.log_determinant(corners) == 0).all()))

    @property
    def multipliers(self) -> tuple[str, ...]:
        """For each function the multiplier that crosses the unit circle at its zeros."""
        return (MINUS, MINUS, PLUS, PLUS, PAIR) if self.conservative else (PLUS, MINUS, PAIR)

    def propagator(self, x: np.ndarray, order: tuple[int, ...] = ()) -> np.ndarray:
        """``Phi`` or its derivative of ``order`` per coordinate, ``(N, d) -> (16, N)``, NaN outside the panels."""
        panel_of = self.atlas.find(x)
        values = np.full((_STATES**2, len(x)), np.nan)
        for number in np.unique(panel_of[panel_of >= 0]):
            mine = panel_of == number
            panel = self.atlas.panels[number]
            values[:, mine] = interpolation.evaluate(derivative(panel, order), position(panel, x[mine])).T
        return values

    def log_determinant(self, x: np.ndarray) -> np.ndarray:
        """log det Z, ``(N, d) -> (N,)``, exact if the system gives it."""
        if not len(x):
            return np.empty(0)
        columns = dict(zip(self.atlas.parameters, parameters_at(self.atlas, x).T, strict=True))
        return predicted(_log_determinant, (self.system.models["floquet"].build,), {**self.atlas.fixed, **columns})

    def derive(self, phi: np.ndarray, log_determinant: np.ndarray) -> np.ndarray:
        """The functions from ``Phi`` ``(16, ...)`` and log det Z ``(...)``, ``(k, ...)``."""
        if self.conservative:
            a, b, _ = invariants(monodromy(phi))
            return np.stack([*_block_determinants(phi), a**2 / 4 - b + 2])
        a, b, c = invariants(monodromy(phi))
        d, missing = np.exp(log_determinant), -np.expm1(log_determinant)
        with np.errstate(all="ignore"):
            product = np.where(missing == 0, a**2 / 4, (a - c) / missing * ((c - a * d) / missing))
        return np.stack([1 - a + b - c + d, 1 + a + b + c + d, 1 + d - b + product])

    def errors(self, panel: Panel, phi: np.ndarray, log_determinant: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Error bounds of the functions in two parts, ``(k, ...)`` each: |error| <= first + |second|.

        They follow from the (statistical) errors of ``panel`` and from rounding. The second part is smooth, and 0 except
        for the pair, g = 1 + d - b + a^2/4 - W^2/4, W = P - Q. It is W times half the error of W: this error is large, but W
        vanishes where two pairs meet.
        """
        z = monodromy(phi)
        a, b, c = invariants(z)
        unit = np.eye(_STATES).reshape(_STATES, _STATES, *(1,) * (z.ndim - 2))
        # Derivatives of b and c by the entries of Z, transposed; that of a is the unit.
        of_b = a * unit - z
        of_c = b * unit - sum(z[:, j, None] * of_b[j] for j in range(_STATES))
        size, norm = (np.sqrt((x**2).sum(axis=tuple(range(x.ndim - z.ndim + 2)))) for x in (phi, z))
        rounding = 16 * np.finfo(float).eps * (1 + norm)

        matrix = phi.reshape(z.shape)
        changed = (2 * size + panel.value_error) * panel.value_error

        def error(slope: np.ndarray) -> np.ndarray:
            """The error of a combination of a, b, c with this derivative by Z, terms of higher order included."""
            by_phi = sum(matrix[:, j, None] * slope[j] for j in range(_STATES))
            first = 2 * np.sqrt((by_phi**2).sum(axis=(0, 1))) * panel.value_error  # pyright: ignore[reportAttributeAccessIssue]
            return first + 15 * (1 + norm + changed) * changed**2 + rounding

        if self.conservative:
            minors = 2 * size * panel.value_error + rounding
            first = np.stack([*(minors,) * 4, error(a / 2 * unit - of_b)])
            return first, np.zeros_like(first)
        d, missing = np.exp(log_determinant), -np.expm1(log_determinant)
        with np.errstate(all="ignore"):
            w, dw = (a + a * d - 2 * c) / missing, np.max(error((1 + d) * unit - 2 * of_c) / missing)
            pair = error(a / 2 * unit - of_b) + dw**2 / 4
        first = np.stack([error(of_b - unit - of_c), error(of_b + unit + of_c), np.where(missing == 0, np.inf, pair)])
        return first, np.stack([0 * w, 0 * w, w * dw / 2])

    def eigenvalues(self, x: np.ndarray) -> np.ndarray:
        """Floquet multipliers at points by falling modulus, ``(N, d) -> (N, 4)``."""
        z = np.moveaxis(monodromy(self.propagator(x)), -1, 0)
        finite = np.isfinite(z).all(axis=(1, 2))
        sigma = np.linalg.eigvals(np.where(finite[:, None, None], z, 0.0)).astype(complex)  # pyright: ignore[reportIndexIssue]
        sigma = np.take_along_axis(sigma, np.argsort(-np.abs(sigma), axis=1), axis=1)
        return np.where(finite[:, None], sigma, np.nan)  # pyright: ignore[reportIndexIssue]

    def spectral_radius(self, x: np.ndarray) -> np.ndarray:
        """Largest modulus of the multipliers at points, ``(N, d) -> (N,)``."""
        return np.abs(self.eigenvalues(x)).max(axis=1, initial=0.0) if len(x) else np.empty(0)

    def stable(self, x: np.ndarray) -> np.ndarray:
        """Flags of stable points of the surrogate, ``(N, d) -> (N,)``, without regard to its error.

        All multipliers are inside the unit circle; without dissipation they are on it and distinct.
        """
        if not self.conservative:
            return self.spectral_radius(x) < 1
        phi = self.propagator(x)
        a, d, b, c = _block_determinants(phi)
        trace, second, _ = invariants(monodromy(phi))
        return (a * d > 0) & (b * c > 0) & (trace**2 / 4 - second + 2 > 0) & (np.abs(trace) < 4)


def parameters_at(atlas: Atlas, x: np.ndarray) -> np.ndarray:
    """Parameters of points in coordinates, ``(..., d)``, clipped to the domain against rounding; NaN stays NaN."""
    return np.clip(atlas.to_parameters(np.clip(x, *atlas.corners)), atlas.lower, atlas.upper)


def monodromy(phi: np.ndarray, transposed: np.ndarray | None = None) -> np.ndarray:
    """``Z = X Phi^T X Phi`` from ``Phi`` by rows, ``(16, ...) -> (4, 4, ...)``; X exchanges the halves of the state.

    ``transposed`` replaces the first of the two factors ``Phi``, as the product rule needs.
    """
    phi, other = (f.reshape(_STATES, _STATES, *f.shape[1:]) for f in (phi, phi if transposed is None else transposed))
    half = _STATES // 2
    swapped = np.roll(np.roll(np.swapaxes(other, 0, 1), half, axis=0), half, axis=1)
    return sum(swapped[:, j, None] * phi[j] for j in range(_STATES))  # pyright: ignore[reportReturnType]


def invariants(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums of the principal minors of order 1, 2, 3 of ``z``, ``(4, 4, ...)``: a, b, c of its characteristic polynomial."""
    size = range(_STATES)
    a = sum(z[i, i] for i in size)
    b = sum(z[i, i] * z[j, j] - z[i, j] * z[j, i] for i, j in combinations(size, 2))
    c = sum(_minor(z, rows) for rows in combinations(size, 3))
    return a, b, c  # pyright: ignore[reportReturnType]


def _minor(z: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    i, j, k = rows
    return (
        z[i, i] * (z[j, j] * z[k, k] - z[j, k] * z[k, j])
        - z[i, j] * (z[j, i] * z[k, k] - z[j, k] * z[k, i])
        + z[i, k] * (z[j, i] * z[k, j] - z[j, j] * z[k, i])
    )


def _block_determinants(phi: np.ndarray) -> list[np.ndarray]:
    """det A, det D, det B, det C of ``Phi = [[A, B], [C, D]]``."""
    phi = phi.reshape(_STATES, _STATES, *phi.shape[1:])
    corners = ((0, 0), (2, 2), (0, 2), (2, 0))
    return [phi[i, j] * phi[i + 1, j + 1] - phi[i, j + 1] * phi[i + 1, j] for i, j in corners]


def _log_determinant(build: Callable, values: Mapping[str, Any]) -> Array:
    return build(values).reduced.log_determinant()


# Growth rate ln|sigma| of one Floquet multiplier with its derivatives, from left and right eigenvectors.
#
# For a simple eigenvalue with Z x = sigma x, y^H Z = sigma y^H, y^H x = 1 and the other pairs (x_k, y_k), (k)
#
#     sigma_i  = y^H Z_i x
#     sigma_ij = y^H Z_ij x + sum_k [(y^H Z_i x_k)(y_k^H Z_j x) + (y^H Z_j x_k)(y_k^H Z_i x)] / (sigma - sigma_k)
#
# Near the tip of a tongue these lose far fewer digits than the coefficients of the characteristic polynomial, whose
# combination for a pair has a slope of only 1e-6 there; so points are found with the polynomial and polished here.


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


def limiting(criteria: Criteria, x: np.ndarray, multiplier: Growth) -> np.ndarray:
    """Flags ``(N,)`` of points ``x`` at which no other multiplier than ``multiplier`` grows.

    That one is on the unit circle up to its rate. With little damping growth rates within a tongue are small.
    """
    largest = growth(criteria, x, ["largest"] * len(x))
    with np.errstate(invalid="ignore"):
        bound = np.fmin(np.abs(multiplier.rate) + multiplier.error + largest.error, LIMITING)
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
    panel_of = criteria.atlas.find(x)
    errors = np.array([panel.value_error for panel in criteria.atlas.panels])
    error = np.where(panel_of >= 0, errors[np.maximum(panel_of, 0)], np.inf)
    size = np.sqrt((phi**2).sum(axis=0))
    return 2 * size * (error + 8 * np.finfo(float).eps * size)
