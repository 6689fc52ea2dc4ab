"""Proved bounds for the cardan shaft: growth of its propagator in complex coordinates, and enclosures of propagators.

Equation numbers are those of docs/theory/atlas.md. Assumed are binary64 rounded to nearest, sums in any order, and library
functions within 4 units in the last place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal, localcontext
from functools import lru_cache
from typing import Any

import numpy as np

from drivetrain_jax.systems._smoothness import UNIT, Columns, Enclosure, frobenius, rounding
from drivetrain_jax.systems.cardan_balls import propagator

# Growth and scales of T Phi S, eqs (15)-(16).


def _typical(middle: Columns) -> tuple[float, float]:
    """sqrt(mu) and 1/sqrt(gamma) of a domain."""
    return middle["mu"] ** 0.5, middle["gamma"] ** -0.5


def balance(values: Columns, middle: Columns) -> tuple[np.ndarray, np.ndarray]:
    """T, which depends on the angle alone, and S: near them (T Phi S) is orthogonal without damping."""
    root_mu, g = _typical(middle)
    one = np.ones_like(np.asarray(values["beta"], float))
    t, k, s = max(root_mu, 1.0) ** 0.5 / np.sqrt(np.cos(values["beta"])), (root_mu * g) ** 0.5, (1 + root_mu**2) ** 0.25
    return np.stack([t, k * one, 1 / t, one / k]), np.stack([one / s, one / k, s * one, k * one])


def _growth(x: Columns, middle: Columns) -> np.ndarray:
    """ln of a bound of |T Phi S| for coordinates x, of which one is complex: eq. (16)."""
    mu, alpha, zeta = x["mu"], np.abs(x["alpha"]), np.abs(x["zeta"])
    s, root_mu, g, half = np.abs(x["Omega"]), np.sqrt(np.abs(mu)), np.abs(x["gamma"]), math.pi / 2
    c, turn = np.exp(-np.real(x["beta"])), np.abs(np.imag(x["beta"]))
    cosine, tangent = np.cos(turn / 2), np.tan(turn / 2)
    # |Im w| over the w of |cos(beta)|, and the integrals of |eta'|, of |eta eta'|, and of w eta^2.
    aside = np.where(turn <= half, np.sin(turn / 2), 1 / (2 * cosine))
    bend = np.sqrt(1 + c**4 - 2 * c**2 * np.cos(2 * turn)) / (c * cosine**2)
    steep, square = bend * (1 + c**2) / (2 * c * cosine), half * (1 + c**2) / (2 * c)

    def negative(name: str) -> np.ndarray:
        return np.maximum(-np.real(x[name]), 0.0)

    rotation = half * (np.maximum(1, root_mu * g) + root_mu) * (np.abs(np.imag(x["Omega"])) / cosine + s * aside)
    rotation += half * s * root_mu * (np.abs(np.sin(np.angle(mu) / 2)) * (1 + g) + np.abs(np.imag(x["gamma"])))
    driven = square / cosine**3 + g**2 * half / cosine
    damped = 2 * (zeta * negative("Omega") + s * negative("zeta")) * (half / cosine + alpha * driven)
    damped += 2 * zeta * s * (negative("alpha") * driven + alpha * np.imag(x["gamma"]) ** 2 * half)
    damped += 8 * zeta * alpha * s * tangent * (tangent * square / cosine + aside * (square / cosine + g * half))
    coupled = zeta * alpha * (steep + g * bend) + root_mu * bend / 2
    # From the balanced states at the start, and to them at the end.
    typical_root, typical_g = _typical(middle)
    t, k, first = (
        max(typical_root, 1.0) ** 0.5 / np.sqrt(c),
        (typical_root * typical_g) ** 0.5,
        (1 + typical_root**2) ** 0.25,
    )
    end = t**2 + (k / (g * c)) ** 2 + (k / (root_mu * g)) ** 2 + (1 + zeta**2 * (1 + alpha / c**2) ** 2) / t**2
    end += (1 + (zeta * alpha * g) ** 2 * (1 / c**2 + 1 / root_mu**2)) / k**2
    start = (1 + (root_mu * c) ** 2 + zeta**2 * ((1 + alpha * c**2) ** 2 + (2 * alpha * g * c) ** 2)) / first**2
    start += first**2 + k**2 + ((root_mu * g) ** 2 + (zeta * alpha * g**2) ** 2) / k**2
    # The path around the poles of eta ends where cos(beta) is negative.
    return np.where(turn < 3.1, rotation + damped + coupled + np.log(end * start) / 2, np.inf)


# Enclosures of propagators y' = s w B(eta) y with y = (q, p), eq. (10), over the clock u = tan(chi/2) from 0 to 1:
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

    def errors(self, roundings: int) -> tuple[np.ndarray, np.ndarray]:
        """Truncation errors of the parts and their rounding errors, both as Frobenius norms in balanced coordinates;
        infinite if the norm of an exponent is not below ``_SHORT``."""
        sums = _tables()[2]
        norm, steep = self.rates()
        x = self.largest * self.half * norm
        if x.max() >= _SHORT:
            return np.full_like(x, np.inf), x
        powers = [sums[k] * x**k for k in range(_TERMS + 1)]
        left_out = np.full_like(x, np.inf)
        for radius in _ELLIPSES:
            # Each term is integrated with an error of at most 8 M radius^(1-P)/(radius-1), M its bound on the ellipse.
            across = self.largest * self.half * self.rates(radius)[0]
            bound = 16 * across * radius ** (1.0 - _NODES) / (radius - 1)
            bound = bound * np.exp(np.minimum((1 + (radius + 1 / radius) / 2) * across, 600)) * sum(powers)
            left_out = np.fmin(left_out, bound)
        tail = 2 * np.exp(np.minimum(2 * x, 600)) * (2 * x) ** (_TERMS + 1) / math.factorial(_TERMS + 1)
        moved = 4 * UNIT * (self.middle + self.half) * steep
        step = rounding(_NODES + 4 + _TABLES + _ENTRY + roundings) + moved
        rounded = 2 * step * sum(k * power for k, power in enumerate(powers)) + 2 * rounding(4 * _TERMS + 4) * sum(
            powers
        )
        return left_out + tail, rounded


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
        left_out, rounded = lines.errors(roundings)
        if left_out.max() < _SMALL:
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
    right, before, behind, errors = np.broadcast_to(end * np.eye(4), left[0].shape), [], [], []
    for i in reversed(range(len(parts))):
        scale, inverse = balance[i], 1 / np.swapaxes(balance[i], -1, -2)
        before.append(_two_norm(scale * left[i]))
        behind.append(_two_norm(right * inverse))
        errors.append(left_out[i] + rounded[i] + rounding(8) * frobenius(scale * parts[i] * inverse))
        right = right @ parts[i]
    # Terms of second order: the product A_j A_i^-1 of consecutive parts is at most |A_j| |A_i|^3/det A_i, and det A_i falls.
    # The factor 8 covers the different scales of neighbours.
    most, last, total = np.max(before, axis=0), np.max(behind, axis=0), np.sum(errors, axis=0)
    second = 8 * most**4 * total * np.exp(-_log_determinant(c, s[:, None], values) / 2)
    error = sum((a + second * most) * (b + second * last) * e for a, b, e in zip(before, behind, errors, strict=True))
    phi = end * left[-1]
    return phi, np.where(second < _SECOND, error * (1 + 1e-9) + rounding(20) * frobenius(phi), np.inf)


def _two_norm(a: np.ndarray) -> np.ndarray:
    """Bounds of the 2-norms of matrices: the eighth root of tr (A^T A)^4."""
    square = np.swapaxes(a, -1, -2) @ a
    return frobenius(square @ square) ** 0.25 * (1 + 1e-12)


# Largest relative error of a coordinate that is computed from its parameter, and of a parameter from its coordinate.
_FORWARD, _BACKWARD = 9 * UNIT, 8 * UNIT


def _enclosed(
    axes: Mapping[str, np.ndarray], fixed: Mapping[str, float], middle: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """See :class:`~drivetrain_jax.systems.Enclosure`; cos(beta) and 1/Omega of the axes count as exact."""
    c = np.exp(-axes["beta"]) if "beta" in axes else np.cos(np.array([fixed["beta"]], float))
    s = axes["Omega"] if "Omega" in axes else 1 / np.array([fixed["Omega"]], float)
    phi, error = propagators(c, s, fixed, middle, _FIXED + (0 if "beta" in axes else _FIXED_ANGLE))
    grid: dict[str, np.ndarray] = dict(zip(("Omega", "beta"), np.meshgrid(s, -np.log(c), indexing="ij"), strict=True))
    x = np.stack([grid[name].ravel() for name in axes], axis=-1) if axes else np.empty((1, 0))
    return x, _BACKWARD * np.abs(x), phi.reshape(-1, 4, 4), np.where((s > 0)[:, None], error, np.inf).ravel()


def _coordinate(name: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The coordinate of a parameter, and bounds of its error."""
    x = -np.log(np.cos(values)) if name == "beta" else 1 / values
    return x, _FORWARD * (np.abs(x) + (name == "beta"))


def _log_determinant(c: Any, s: Any, values: Mapping[str, Any]) -> np.ndarray:
    """log det Z, eq. (13) of docs/theory/cardan.md, a sum of terms of one sign."""
    mean = 1 + values["alpha"] / np.asarray(values["gamma"]) + values["alpha"] * (1 + c * c) / (2 * c)
    return -2 * math.pi * values["zeta"] * s * mean


def _log_determinant_at(values: Columns) -> np.ndarray:
    logarithm = _log_determinant(np.cos(values["beta"]), 1 / np.asarray(values["Omega"]), values)
    # The smallest damping must not count as none by underflow.
    return np.where(np.equal(values["zeta"], 0), 0.0, np.minimum(logarithm, -np.finfo(float).tiny))


ENCLOSURE = Enclosure(("beta", "Omega"), _enclosed, _coordinate, _log_determinant_at, _growth, propagator)
