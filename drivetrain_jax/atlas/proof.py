"""Proved bounds of the error of an atlas of the cardan shaft, and the verdicts that follow from them.

The proof is that of docs/theory/atlas.md. It takes nothing from the construction of a panel but the polynomial p itself:
propagators with bounds of their errors (:func:`propagators`) at the nodes of a finer grid show how far p is from T Phi S
there, and the growth of Phi in complex coordinates how far both may differ elsewhere (:func:`proved_error`). Assumed are
binary64 rounded to nearest, sums in any order, and library functions within 4 units in the last place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal, localcontext
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from drivetrain_jax.atlas.charts import in_threads
from drivetrain_jax.atlas.floquet import floquet_domain, middle_of, polynomials_needed
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.systems import System, get_system

STABLE, UNSTABLE, UNDECIDED = 0, 1, 2
THEOREM = (
    "The stored binary64 parameters count as exact. Where `proved` is true, all Floquet multipliers lie inside the unit "
    "circle (without damping: on it and apart from each other) if the verdict is stable, and at least one lies outside if "
    "it is unstable. Assumed: IEEE 754 binary64 rounded to nearest, sums in any order, library functions within 4 units in "
    "the last place. Not covered: the model, faults of compiler and hardware, errors of the program."
)
# Unit of rounding; half a unit in the last place.
_U = 2.0**-53
# Coordinates that may vary: the truncation bound is proved for these.
_VARYING = {"beta", "Omega"}
# Target of the truncation error, nodes per polynomial, relative enlargement of the box, lines and points computed together,
# and the largest number of polynomials, which take ten seconds of CPU time.
_TRUNCATED, _FINER, _BEYOND, _LINES, _POINTS, _MOST_NODES = 1e-12, 1.5, 1e-9, 16, 2048, 10_000


def _gamma(n: float) -> float:
    """Bound of the relative error of n roundings."""
    return n * _U / (1 - n * _U)


def _norm(a: np.ndarray) -> np.ndarray:
    """Frobenius norms of matrices ``(..., 4, 4)``."""
    return np.sqrt((a * a).sum((-1, -2)))


# Propagators y' = s w B(eta) y with y = (q, p), eq. (10), over the clock u = tan(chi/2) from 0 to 1:
#
#     w = dtau/du = 2 sqrt(c) (1 + u^2)/D1,   eta = D1/D2,   D1 = 4u^2 + c (1 - u^2)^2,   D2 = (1 - u^2)^2 + 4c u^2.
#
# These are rational functions with positive terms. The zeros of D1 are +-ip and +-i/p, p = sqrt(c)/(1 + sqrt(1 - c)), those
# of D2 are +-sqrt(1 - c) +-i sqrt(c). Over a part m + d t, -1 <= t <= 1, of the clock the propagator is the power series
# sum_k s^k D_k, D_k' = w B D_(k-1), whose terms are integrated as polynomials through Chebyshev nodes.


# Nodes of a part and terms of its series. Largest truncation error of a part, and largest norm of its exponent.
_NODES, _TERMS, _SMALL, _SHORT, _MOST_PARTS = 16, 18, 3e-15, 0.75, 300
# Largest relative size of terms of second order in the errors of the parts.
_SECOND = 1e-2
# Ellipses about a part on which its matrix is bounded: sums of the half axes.
_ELLIPSES = (1.3, 1.5, 1.75, 2, 2.3, 2.7, 3.2, 3.8, 4.6, 5.6, 7, 9, 12, 16, 24, 40)
# Roundings of an entry of d s w B (105), of the fixed parameters in it (16; 36 more for a fixed angle), of t and of Q.
_ENTRY, _FIXED, _FIXED_ANGLE, _TABLES = 105, 16, 36, 2


@lru_cache(maxsize=1)
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes t ``(P,)``; Q ``(P + 1, P)``: integrals from -1 to each node and to 1 of the polynomial through values at the
    nodes; and the largest row sum of every power of abs(Q), ``(K + 1,)``."""
    count = range(_NODES)
    with localcontext() as context:
        context.prec = 40
        cosine = [Decimal(1), Decimal(0)]
        for _ in range(_NODES.bit_length() - 1):
            cosine[1] = ((1 + cosine[1]) / 2).sqrt()
        for _ in range(4 * _NODES - 2):
            cosine.append(2 * cosine[1] * cosine[-1] - cosine[-2])

        def integral(k: int, turn: int) -> Decimal:
            """The integral of T_k from -1 to the cosine of ``turn``."""

            def primitive(turn: int) -> Decimal:
                t = [cosine[j * turn % (4 * _NODES)] for j in (abs(k - 1), k + 1)]
                return t[1] / 4 if k == 1 else t[1] if k == 0 else (t[1] / (k + 1) - t[0] / (k - 1)) / 2

            return primitive(turn) - primitive(2 * _NODES)

        q = [
            [
                sum(integral(k, i) * cosine[k * j % (4 * _NODES)] * (2 if k else 1) for k in count) / _NODES
                for j in range(1, 2 * _NODES, 2)
            ]
            for i in (*range(1, 2 * _NODES, 2), 0)
        ]
        nodes = np.array([float(cosine[j]) for j in range(1, 2 * _NODES, 2)])
        weights = np.array([[float(x) for x in row] for row in q])
    sums = [np.ones(_NODES + 1)]
    for _ in range(_TERMS):
        sums.append(np.abs(weights) @ sums[-1][:_NODES])
    return nodes, weights, np.max(sums, axis=1) * (1 + 1e-10)


class _Lines:
    """Lines of nodes along s: ``c`` = cos(beta) ``(J,)``, the other parameters numbers, cut into ``count`` parts."""

    def __init__(self, c: np.ndarray, values: Mapping[str, float], largest: float, count: int) -> None:
        self.c, self.largest = c, largest
        self.zeta, self.alpha, self.mu = (np.float64(values[name]) for name in ("zeta", "alpha", "mu"))
        self.g = np.float64(values["gamma"]) ** -0.5
        r = (1 - c) / (1 + c)
        # Equal parts of the clock psi, eq. (12).
        psi = np.linspace(0, math.pi / 2, count + 1)[:, None]
        edges = np.tan(np.arctan2(np.sqrt(1 - r * r) * np.sin(2 * psi), np.cos(2 * psi)) / 4)
        edges[0], edges[-1] = 0, 1
        self.middle, self.half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
        eta = self.clock(self.middle)[1]
        self.scales = (1 + self.mu * eta**2) ** 0.25, np.full_like(eta, (self.mu**0.5 * self.g) ** 0.5)

    def clock(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """w and eta."""
        square = ((1 - u) * (1 + u)) ** 2
        first, second = 4 * u * u + self.c * square, square + 4 * self.c * u * u
        return 2 * np.sqrt(self.c) * (1 + u * u) / first, first / second

    def matrix(self, u: np.ndarray) -> np.ndarray:
        """w B(eta), ``(..., J, 4, 4)``."""
        w, eta = self.clock(u)
        zeta, alpha, mu, g, o = self.zeta, self.alpha, self.mu, self.g, np.zeros_like(w)
        f11, f21, f22 = zeta * (1 + alpha * eta**2), -2 * zeta * alpha * g * eta, zeta * alpha * g * g + o
        k11, k22 = f11**2 + f21**2 - (1 + mu * eta**2), f22**2 - mu * g * g
        k12 = f21 * f22 + mu * g * eta
        rows = [[-f11, o, 1 + o, o], [-f21, -f22, o, 1 + o], [k11, k12, -f11, -f21], [k12, k22, o, -f22]]
        return np.moveaxis(w * np.array(rows), (0, 1), (-2, -1))

    def _distances(self, x: Any, y: Any, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest distance of the pole x + iy from an ellipse about each part; 0 if it is too near to be sure."""
        a, b = (self.half * (radius + sign / radius) / 2 for sign in (1, -1))
        near = np.hypot(np.maximum(np.abs(x - self.middle) - a, 0), np.maximum(y - b, 0))
        return np.where(near > 1e-4, near, 0), np.hypot(np.abs(x - self.middle) + a, y + b)

    def rates(self, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """On ellipses about the parts: a bound of the norm of w B in balanced coordinates, with the moduli of all its terms,
        and one of the derivative of the logarithm of any of these terms, both ``(parts, J)``."""
        root, turn = np.sqrt(self.c), np.sqrt(1 - self.c)
        p = root / (1 + turn)
        low, high = self._distances(0, p, radius), self._distances(0, 1 / p, radius)
        left, right = self._distances(-turn, root, radius), self._distances(turn, root, radius)
        zeta, alpha, mu, g, (k1, k2) = self.zeta, self.alpha, self.mu, self.g, self.scales
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            d2 = (left[0] * right[0]) ** 2
            top = (
                2 * root * (1 + np.hypot(self.middle + self.half * (radius + 1 / radius) / 2, self.half * radius) ** 2)
            )
            w, turned = top / (self.c * (low[0] * high[0]) ** 2), top / d2
            eta = self.c * (low[1] * high[1]) ** 2 / d2
            square = turned * eta
            f11, f21, f22 = w + alpha * square, 2 * alpha * g * turned, alpha * g * g * w
            u11 = w + mu * square + zeta**2 * (f11 * (1 + alpha * eta**2) + f21 * 2 * alpha * g * eta)
            u12 = mu * g * turned + zeta**2 * f21 * alpha * g * g
            u22 = mu * g * g * w + zeta**2 * f22 * alpha * g * g
            stiff = np.maximum(u11 / k1**2, u22 / k2**2) + u12 / (k1 * k2)
            norm = zeta * np.sqrt(f11**2 + (f21 * k2 / k1) ** 2 + f22**2)
            norm = (norm + np.maximum(np.maximum(w * k1**2, w * k2**2), stiff)) * (1 + 1e-10)
            steep = 1 + 6 / low[0] + 6 / high[0] + 8 / left[0] + 8 / right[0]
        return np.where(np.isfinite(norm), norm, np.inf), steep

    def errors(self, roundings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Truncation errors of the parts, their rounding errors, both as Frobenius norms in balanced coordinates, and
        bounds of the norms of their exponents."""
        sums = _tables()[2]
        norm, steep = self.rates()
        x = self.largest * self.half * norm
        powers = [sums[k] * x**k for k in range(_TERMS + 1)]
        left_out = np.full_like(x, np.inf)
        for radius in _ELLIPSES:
            # Each term is integrated with an error of at most 8 M radius^(1-P)/(radius-1), M its bound on the ellipse.
            across = self.largest * self.half * self.rates(radius)[0]
            found = 16 * across * radius ** (1.0 - _NODES) / (radius - 1)
            found = found * np.exp(np.minimum((1 + (radius + 1 / radius) / 2) * across, 600)) * sum(powers)
            left_out = np.fmin(left_out, found)
        tail = 2 * np.exp(np.minimum(2 * x, 600)) * (2 * x) ** (_TERMS + 1) / math.factorial(_TERMS + 1)
        moved = 4 * _U * (self.middle + self.half) * steep
        step = _gamma(_NODES + 4 + _TABLES + _ENTRY + roundings) + moved
        rounded = 2 * step * sum(k * power for k, power in enumerate(powers)) + 2 * _gamma(4 * _TERMS + 4) * sum(powers)
        return left_out + tail, rounded, x


# Infinite bounds lead to NaN, which decides nothing.
_quiet = np.errstate(divide="ignore", over="ignore", invalid="ignore")


@_quiet
def propagators(
    c: np.ndarray, s: np.ndarray, values: Mapping[str, float], middle: Mapping[str, float], roundings: int = _FIXED
) -> tuple[np.ndarray, np.ndarray]:
    """``T Phi S`` at all pairs of c = cos(beta) ``(J,)`` and s = 1/Omega > 0 ``(I,)``, and bounds of the errors' norms.

    Args:
        c: numbers that count as exact.
        s: likewise.
        values: zeta, alpha, mu and gamma.
        middle: the mu and gamma that determine T and S, eq. (15).
        roundings: units of rounding by which the fixed parameters may be wrong in an entry of the matrix.

    Returns: matrices ``(I, J, 4, 4)`` and bounds ``(I, J)``, infinite where the errors are too large to be bounded.
    """
    largest, count = float(s.max()), 8
    while True:
        lines = _Lines(c, values, largest, count)
        left_out, rounded, x = lines.errors(roundings)
        if left_out.max() < _SMALL and x.max() < _SHORT:
            break
        if count > _MOST_PARTS:
            shape = len(s), len(c)
            return np.zeros((*shape, 4, 4)), np.full(shape, np.inf)
        count = math.ceil(count * 1.2)
    nodes, weights, _ = _tables()
    ratio = (s / largest)[:, None, None, None]
    k1, k2 = lines.scales
    balance = np.stack([k1, k2, 1 / k1, 1 / k2], axis=-1)[:, :, :, None]
    first, k = (1 + middle["mu"]) ** 0.25, (middle["mu"] / middle["gamma"]) ** 0.25
    start = np.diag([1 / first, 1 / k, first, k])
    t = max(middle["mu"], 1.0) ** 0.25 / np.sqrt(c)
    end = np.stack([t, np.full_like(t, k), 1 / t, np.full_like(t, 1 / k)], axis=-1)[:, :, None]
    parts, left = [], [np.broadcast_to(start, (len(s), len(c), 4, 4))]
    for m, d in zip(lines.middle, lines.half, strict=True):
        f = lines.matrix(m + d * nodes[:, None]) * (d * largest)[:, None, None]
        term, terms = np.broadcast_to(np.eye(4), f.shape), []
        for _ in range(_TERMS):
            whole = np.tensordot(weights, f @ term, axes=1)
            term = whole[:-1]
            terms.append(whole[-1])
        part = terms[-1] * ratio
        for term in terms[-2::-1]:
            part = (part + term) * ratio
        parts.append(part + np.eye(4))
        left.append(parts[-1] @ left[-1])
    right, before, behind, own = np.broadcast_to(end * np.eye(4), left[0].shape), [], [], []
    for i in reversed(range(len(parts))):
        scale, inverse = balance[i], 1 / np.swapaxes(balance[i], -1, -2)
        before.append(_two_norm(scale * left[i]))
        behind.append(_two_norm(right * inverse))
        own.append(left_out[i] + rounded[i] + _gamma(8) * _norm(scale * parts[i] * inverse))
        right = right @ parts[i]
    # Terms of second order: the product A_j A_i^-1 of consecutive parts is at most |A_j| |A_i|^3/det A_i, and det A_i falls.
    # The factor 8 covers the different scales of neighbours.
    most, last, total = np.max(before, axis=0), np.max(behind, axis=0), np.sum(own, axis=0)
    second = 8 * most**4 * total * np.exp(-_log_determinant(c, s[:, None], values) / 2)
    error = sum((a + second * most) * (b + second * last) * e for a, b, e in zip(before, behind, own, strict=True))
    phi = end * left[-1]
    return phi, np.where(second < _SECOND, error * (1 + 1e-9) + _gamma(20) * _norm(phi), np.inf)


def _two_norm(a: np.ndarray) -> np.ndarray:
    """Bounds of the 2-norms of matrices: the eighth root of tr (A^T A)^4."""
    square = np.swapaxes(a, -1, -2) @ a
    return _norm(square @ square) ** 0.25 * (1 + 1e-12)


# A panel against T Phi S.


# Least log det Z: below it the terms of second order in :func:`propagators` are too large.
_STRONG = -44.0

# Ratio of a stored bound to the computed one, for other processors that round differently.
_ROOM = 1.01


def with_proofs(atlas: Atlas, system: type[System]) -> Atlas:
    """``atlas`` with proved bounds for its panels, where :func:`proved_error` gives any."""
    bounds = [_ROOM * proved_error(atlas, panel, system) for panel in atlas.panels]
    panels = (replace(panel, proved_error=bound) for panel, bound in zip(atlas.panels, bounds, strict=True))
    return replace(atlas, panels=tuple(panels))


def is_proved(atlas: Atlas) -> bool:
    """True if every panel has a proved bound, and there is no gap."""
    return not atlas.gaps and bool(np.isfinite([panel.proved_error for panel in atlas.panels]).all())


def proved_error(atlas: Atlas, panel: Panel, system: type[System]) -> float:
    """A proved bound of the Frobenius norm of the error of ``panel`` anywhere in its box; infinite if there is none.

    Bounds exist for atlases of the cardan shaft over the joint angle, the speed, or both.
    """
    if system is not get_system("cardan") or not _VARYING.issuperset(atlas.parameters):
        return math.inf
    ranges = dict(zip(atlas.parameters, zip(atlas.lower, atlas.upper, strict=True), strict=True))
    domain = floquet_domain(system, ranges, atlas.fixed)
    middle = middle_of(domain)
    margin = _BEYOND * (panel.upper - panel.lower)
    # ln sec(beta) is never negative.
    lower, upper = np.maximum(panel.lower - margin, 0.0), panel.upper + margin
    needed, truncated = polynomials_needed(system, domain, _TRUNCATED, lower, upper)
    if not np.isfinite(truncated) or math.prod(needed) > _MOST_NODES:
        return math.inf
    counts, factor, grid = [], 1.0, {}
    for k, name in enumerate(atlas.parameters):
        # A polynomial of degree n is at most 1/cos(n pi/2N) times its largest value at N nodes.
        degree = max(needed[k], panel.degrees[k]) - 1
        counts.append(math.ceil(_FINER * (degree + 1)) + 1)
        t = np.cos(np.pi * (np.arange(counts[-1]) + 0.5) / counts[-1])
        grid[name] = (lower[k] * (1 - t) + upper[k] * (1 + t)) / 2
        moved = 2 * counts[-1] * _U * (16 + 32 * (1 + upper[k]) / (upper[k] - lower[k]))
        angle = degree * (np.pi / (2 * counts[-1]) + moved)
        factor *= 1 / math.cos(angle) if angle < 1.5 else math.inf
    c = np.exp(-grid["beta"]) if "beta" in grid else np.cos(np.array([atlas.fixed["beta"]], float))
    s = grid["Omega"] if "Omega" in grid else 1 / np.array([atlas.fixed["Omega"]], float)
    if not (s > 0).all() or not np.isfinite(factor):
        return math.inf
    if _log_determinant(c.min(), s.max(), atlas.fixed) < _STRONG:
        return math.inf
    roundings = _FIXED + (0 if "beta" in grid else _FIXED_ANGLE)

    def apart(lines: np.ndarray) -> float:
        """The largest distance between p and T Phi S at the nodes of some lines."""
        phi, error = propagators(lines, s, atlas.fixed, middle, roundings)
        x = {"beta": np.broadcast_to(-np.log(lines), error.shape), "Omega": np.broadcast_to(s[:, None], error.shape)}
        points = np.stack([x[name].ravel() for name in atlas.parameters], axis=-1)
        found, rounded = _evaluated(panel, points, 8 * _U * np.abs(points))
        return float((_norm(found - phi.reshape(-1, 4, 4)) + error.ravel() + rounded).max())

    largest = max(distance for _, distance in in_threads(np.array_split(c, -(-len(c) // _LINES)), apart))
    return (factor * (largest + truncated) + truncated) * (1 + 1e-9)


def _evaluated(panel: Panel, x: np.ndarray, wrong: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The polynomial of a panel at coordinates ``(N, d)`` that are ``wrong`` by at most this, ``(N, 4, 4)``, and bounds of
    the norm of its error there."""
    sizes = np.linalg.norm(panel.coefficients, axis=-1)
    width = panel.upper - panel.lower
    t = ((x - panel.lower) - (panel.upper - x)) / width
    error = np.where((np.abs(t) <= 1 + 3 * _BEYOND).all(axis=1), _gamma(sum(panel.degrees) + 8) * sizes.sum(), np.inf)
    for k, n in enumerate(panel.degrees):
        # The recurrence of T_j has an error of at most 2 u j^2, and its derivative is at most j^2.
        steepest = (np.moveaxis(sizes, k, 0).reshape(n, -1).sum(axis=1) * np.arange(n) ** 2).sum()
        moved = 2 * wrong[:, k] / width[k] + 4 * _U * (1 + np.abs(panel.lower[k]) / width[k])
        error = error + steepest * (2 * _U + moved)
    values = np.empty((len(x), 16))
    for start in range(0, len(x), _POINTS):
        at = t[start : start + _POINTS]
        rest = chebvander(at[:, 0], panel.degrees[0] - 1) @ panel.coefficients.reshape(panel.degrees[0], -1)
        for k, n in enumerate(panel.degrees[1:], start=1):
            rest = np.einsum("pn,pnr->pr", chebvander(at[:, k], n - 1), rest.reshape(len(at), n, -1))
        values[start : start + _POINTS] = rest
    return values.reshape(-1, 4, 4), error * 1.001


# Verdicts by the conditions of Schur and Cohn for p(sigma) = sigma^4 - e1 sigma^3 + e2 sigma^2 - e3 sigma + d.


# Roundings of e_k in units of 2 u |Phi|^2 |Z|^(k-1); relative error of log d and of d in units of 2 u.
_ROUNDINGS, _LOG = 128, 24
_SWAP = np.roll(np.eye(4), 2, axis=0)


def verdicts(atlas: Atlas, points: np.ndarray) -> np.ndarray:
    """The proved verdicts at ``points`` ``(N, d)`` in the order of ``atlas.parameters``: 0 stable, 1 unstable, 2 undecided.

    The stored binary64 parameters count as exact. Stable: all multipliers lie inside the unit circle or, without damping,
    on it and apart from each other. Unstable: at least one lies outside.
    """
    found = np.full(len(points), UNDECIDED, np.int8)
    if not any(np.isfinite(panel.proved_error) for panel in atlas.panels):
        return found
    x, number = _coordinates(atlas, points), atlas.find(atlas.to_coordinates(points))

    def judged(mine: np.ndarray) -> np.ndarray:
        panel = atlas.panels[number[mine[0]]]
        phi, error = _evaluated(panel, *(part[mine] for part in x))
        values = {**atlas.fixed, **dict(zip(atlas.parameters, points[mine].T, strict=True))}
        return _verdict(phi, panel.proved_error + error, values)

    covered = [np.flatnonzero(number == k) for k, panel in enumerate(atlas.panels) if np.isfinite(panel.proved_error)]
    blocks = (mine[i : i + _POINTS] for mine in covered for i in range(0, len(mine), _POINTS))
    for mine, codes in in_threads(blocks, judged):
        found[mine] = codes
    return found


def verdict_at(system: type[System], values: Mapping[str, float]) -> int:
    """The proved verdict at one point, without an atlas; undecided for other systems than the cardan shaft."""
    if system is not get_system("cardan"):
        return UNDECIDED
    c, s = np.cos(np.array([values["beta"]], float)), 1 / np.array([values["Omega"]], float)
    phi, error = propagators(c, s, values, values, _FIXED + _FIXED_ANGLE)
    return int(_verdict(phi[0], error[0], values)[0])


def _coordinates(atlas: Atlas, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of points ``(N, d)``, and bounds of their errors."""
    x, wrong = np.empty(points.shape), np.empty(points.shape)
    for k, (name, column) in enumerate(zip(atlas.parameters, points.T, strict=True)):
        x[:, k] = -np.log(np.cos(column)) if name == "beta" else 1 / column
        wrong[:, k] = 9 * _U * (np.abs(x[:, k]) + (name == "beta"))
    return x, wrong


@_quiet
def _verdict(phi: np.ndarray, error: np.ndarray, values: Mapping[str, Any]) -> np.ndarray:
    """Verdicts of ``phi`` ``(N, 4, 4)``, whose errors have at most the norms ``error`` ``(N,)``."""
    eps, one = 2 * _U, np.eye(4)
    z = _SWAP @ np.swapaxes(phi, -1, -2) @ _SWAP @ phi

    def traced(a: np.ndarray) -> np.ndarray:
        return np.trace(a, axis1=-2, axis2=-1)

    # Faddeev and Le Verrier: G_1 = I, G_2 = e1 I - Z, G_3 = e2 I - G_2 Z, e_k = tr(G_k Z)/k.
    e1 = traced(z)
    g2 = e1[:, None, None] * one - z
    product = g2 @ z
    e2 = traced(product) / 2
    g3 = e2[:, None, None] * one - product
    e3 = traced(g3 @ z) / 3
    slopes = phi, phi @ g2, phi @ g3
    size, norm = _norm(phi), _norm(z)
    error = error * (1 + 1e-9)
    changed = (2 * size + error) * error
    rest = np.array([error**2, 4 * changed**2, 10 * (norm + changed) * changed**2])
    rest = rest + _ROUNDINGS * eps * size**2 * np.array([np.ones_like(norm), norm, norm**2])

    def bound(*weights: Any) -> np.ndarray:
        """Bound of the error of the sum of the e_k times these ``weights``."""
        weights = np.broadcast_arrays(*weights, size)[:3]
        slope = np.sum([weight[:, None, None] * a for weight, a in zip(weights, slopes, strict=True)], axis=0)
        higher = sum(np.abs(weight) * each for weight, each in zip(weights, rest, strict=True))
        return 2 * _norm(slope) * error * (1 + 1e-9) + 1e-13 * size * (1 + norm) ** 2 * error + higher

    log_d = _log_determinant(np.cos(values["beta"]), 1 / np.asarray(values["Omega"]), values)
    d, missing = np.exp(log_d), -np.expm1(log_d)
    of_d = _LOG * eps * (1 + np.abs(log_d)) * d
    undamped = np.equal(values["zeta"], 0)
    w = np.where(undamped, 0.0, (e1 + e1 * d - 2 * e3) / missing)
    of_w = bound(1 + d, 0, -2.0) + np.abs(e1) * of_d + 8 * eps * (np.abs(e1) * (1 + d) + 2 * np.abs(e3))
    of_w = np.where(undamped, 0.0, of_w / missing + 2 * _LOG * eps * np.abs(w)) * (1 + 1e-9)
    rounding = 8 * eps * (1 + np.abs(e1) + np.abs(e2) + np.abs(e3) + d + e1**2 + w**2) + of_d
    plus, minus = 1 - e1 + e2 - e3 + d, 1 + e1 + e2 + e3 + d
    of_plus, of_minus = bound(-1.0, 1.0, -1.0) + rounding, bound(1.0, 1.0, 1.0) + rounding
    pair = 1 + d - e2 + e1**2 / 4 - w**2 / 4
    first = changed + rest[0]
    of_pair = bound(e1 / 2, -1.0, 0) + first**2 / 4 + (2 * np.abs(w) + of_w) * of_w / 4 + rounding
    # (e3 - e1 d)/(1 - d).
    last, of_last = np.abs(e1 - w) / 2, (first + of_w) / 2 + rounding
    unstable = (plus < -of_plus) | (minus < -of_minus) | (pair < -of_pair)
    stable = (plus > of_plus) & (minus > of_minus) & (pair > of_pair) & (last + of_last < 1 + d)
    decided = np.isfinite(of_plus + of_minus + of_pair) & (d > 0)
    return np.where(decided & stable, STABLE, np.where(decided & unstable, UNSTABLE, UNDECIDED)).astype(np.int8)


def _log_determinant(c: np.ndarray, s: np.ndarray, values: Mapping[str, Any]) -> np.ndarray:
    """log det Z, eq. (13) of docs/theory/cardan.md, a sum of terms of one sign."""
    mean = 1 + values["alpha"] / np.asarray(values["gamma"]) + values["alpha"] * (1 + c * c) / (2 * c)
    return -2 * math.pi * values["zeta"] * s * mean
