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
from functools import lru_cache
from itertools import combinations

import jax
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.atlas import interpolation
from drivetrain_jax.atlas.panels import Atlas, Panel, derivative, position
from drivetrain_jax.systems import System

PLUS, MINUS, PAIR = "+1", "-1", "pair"
# A zero bounds the stable region only if no multiplier grows. A growth rate above this value counts as real.
LIMITING = 1e-6
_STATES = 4
# Points per call of the determinant: few sizes, so few compilations.
_BLOCKS = (64, 512, 4096)


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
            raise InputError(f"file: the atlas has no panel ({reason}); allowed is one whose solves converged")
        if not has_boundaries(self.atlas, self.system):
            raise InputError(
                f"system = {self.system.name!r}: has no boundary functions; allowed for boundaries "
                "and design answers is one of four states with a half-period propagator and log_determinant"
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
        found = self.atlas.find(x)
        values = np.full((_STATES**2, len(x)), np.nan)
        for number in np.unique(found[found >= 0]):
            mine = found == number
            panel = self.atlas.panels[number]
            values[:, mine] = interpolation.evaluate(derivative(panel, order), position(panel, x[mine])).T
        return values

    def log_determinant(self, x: np.ndarray) -> np.ndarray:
        """log det Z, ``(N, d) -> (N,)``, exact if the system gives it."""
        values = self._values(x)
        size = next((n for n in _BLOCKS if n >= len(x)), _BLOCKS[-1])
        parts = []
        for start in range(0, len(x), size):
            block = {name: column[start : start + size] for name, column in values.items()}
            count = len(x[start : start + size])
            padded = {name: np.pad(column, (0, size - count), mode="edge") for name, column in block.items()}
            parts.append(np.asarray(_determinant(self.system.models["floquet"].build)(padded))[:count])
        return np.concatenate(parts) if parts else np.empty(0)

    def values(self, x: np.ndarray) -> np.ndarray:
        """The functions at points, ``(N, d) -> (k, N)``."""
        return self.derive(self.propagator(x), self.log_determinant(x))

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
        a, _, c = invariants(z)
        rounding = 4 * np.finfo(float).eps * (1 + np.sqrt((z**2).sum(axis=(0, 1))))
        da, db, dc = (error + rounding for error in panel.derived_error)
        if self.conservative:
            minors = 2 * np.sqrt((phi**2).sum(axis=0)) * panel.value_error + rounding
            first = np.stack([*(minors,) * 4, np.abs(a) / 2 * da + db])
            return first, np.zeros_like(first)
        d, missing = np.exp(log_determinant), -np.expm1(log_determinant)
        with np.errstate(all="ignore"):
            w, dw = (a + a * d - 2 * c) / missing, np.max(((1 + d) * da + 2 * dc) / missing)
            pair = db + np.abs(a) / 2 * da + dw**2 / 4
        first = np.stack([da + db + dc, da + db + dc, np.where(missing == 0, np.inf, pair)])
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

    def _values(self, x: np.ndarray) -> dict[str, np.ndarray]:
        columns = dict(zip(self.atlas.parameters, parameters_at(self.atlas, x).T, strict=True))
        names = self.system.models["floquet"].parameters
        given = {name: columns.get(name, self.atlas.fixed.get(name)) for name in names}
        return {name: np.broadcast_to(np.asarray(v, float), len(x)) for name, v in given.items() if v is not None}


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


@lru_cache
def _determinant(build: Callable) -> Callable:
    """Compiled log det Z of a model, cached for all its atlases."""

    def exact(values: Mapping[str, jax.Array]) -> jax.Array:
        return build(values).reduced.log_determinant()

    return jax.jit(exact)
