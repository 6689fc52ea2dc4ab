"""Proved bounds of the error of an atlas, and the verdicts that follow from them.

The proof is that of docs/theory/atlas.md, for systems that offer an :class:`~drivetrain_jax.systems.Enclosure`. It takes
nothing from the construction of a panel but the polynomial p itself: enclosures of propagators at the nodes of a finer grid
show how far p is from T Phi S there, and the growth of Phi in complex coordinates how far both may differ elsewhere
(:func:`proved_error`). Assumed are binary64 rounded to nearest, sums in any order, and library functions within 4 units in
the last place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from drivetrain_jax._machine import in_threads
from drivetrain_jax.atlas.construction import Domain
from drivetrain_jax.atlas.floquet import floquet_domain, middle_of, smoothness
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.systems import Enclosure, System
from drivetrain_jax.systems._smoothness import UNIT, frobenius, rounding

STABLE, UNSTABLE, UNDECIDED = 0, 1, 2
THEOREM = (
    "The stored binary64 parameters count as exact. Where `proved` is true, all Floquet multipliers lie inside the unit "
    "circle (without damping: on it and apart from each other) if the verdict is stable, and at least one lies outside if "
    "it is unstable. Assumed: IEEE 754 binary64 rounded to nearest, sums in any order, library functions within 4 units in "
    "the last place. Not covered: the model, faults of compiler and hardware, errors of the program."
)
# Target of the truncation error, nodes per polynomial, relative enlargement of the box, lines and points computed together,
# and the largest number of polynomials, which take ten seconds of CPU time.
_TRUNCATED, _FINER, _BEYOND, _LINES, _POINTS, _MOST_NODES = 1e-12, 1.5, 1e-9, 32, 2048, 10_000
# Least log det Z: below it the terms of second order of an enclosure are too large.
_STRONG = -44.0
# Ratio of a stored bound to the computed one, for other processors that round differently.
_ROOM = 1.01
# Infinite bounds lead to NaN, which decides nothing.
_quiet = np.errstate(divide="ignore", over="ignore", invalid="ignore")


def with_proofs(atlas: Atlas, system: type[System]) -> tuple[Atlas, str]:
    """``atlas`` with proved bounds for its panels where there are any, and the reason if a panel has none."""
    bounds = [proved_error(atlas, panel, system) for panel in atlas.panels]
    panels = tuple(replace(p, proved_error=_ROOM * bound) for p, (bound, _) in zip(atlas.panels, bounds, strict=True))
    return replace(atlas, panels=panels), next((reason for _, reason in bounds if reason), "")


def is_proved(atlas: Atlas) -> bool:
    """True if every panel has a proved bound, and there is no gap."""
    return not atlas.gaps and bool(np.isfinite([panel.proved_error for panel in atlas.panels]).all())


def summary(proved: np.ndarray, where: str) -> str:
    """The number of verdicts that are ``proved`` (flags), ``where`` being what they belong to, as a part of a sentence."""
    total, count = np.size(proved), int(np.sum(proved))
    if not count:
        return "verdicts hold by estimate, not by proof"
    return f"the verdicts of {'all' if count == total else f'{count:,} of'} {total:,} {where} are proved"


def proved_error(atlas: Atlas, panel: Panel, system: type[System]) -> tuple[float, str]:
    """A proved bound of the Frobenius norm of the error of ``panel`` anywhere in its box; infinite, with the reason, if
    there is none."""
    enclosure = smoothness(system).enclosure
    if enclosure is None:
        return math.inf, f"{system.name} has no enclosure of its propagators"
    if not set(enclosure.varying).issuperset(atlas.parameters):
        over, among = (", ".join(names) for names in (atlas.parameters, enclosure.varying))
        return math.inf, f"the atlas varies {over}; proofs exist over {among}"
    ranges = dict(zip(atlas.parameters, zip(atlas.lower, atlas.upper, strict=True), strict=True))
    domain = floquet_domain(system, ranges, atlas.fixed)
    margin = _BEYOND * (panel.upper - panel.lower)
    # A coordinate may have no negative values.
    lower = np.where(panel.lower < 0, panel.lower - margin, np.maximum(panel.lower - margin, 0.0))
    upper = panel.upper + margin
    needed, truncated = polynomials_needed(system, domain, _TRUNCATED, lower, upper)
    if not (np.isfinite(truncated) and math.prod(needed) <= _MOST_NODES):
        wanted = f"{math.prod(needed):,}" if np.isfinite(truncated) else "too many"
        return math.inf, f"a proof would need {wanted} polynomials, more than {_MOST_NODES:,}"
    corners = np.stack(np.meshgrid(*np.stack([atlas.lower, atlas.upper]).T), axis=-1).reshape(-1, len(needed))
    if _log_determinant(enclosure, atlas, corners).min() < _STRONG:
        return math.inf, "the damping is too strong for a proof"
    axes, factor = {}, 1.0
    for k, name in enumerate(atlas.parameters):
        # A polynomial of degree n is at most 1/cos(n pi/2N) times its largest value at N nodes.
        degree = max(needed[k], panel.degrees[k]) - 1
        count = math.ceil(_FINER * (degree + 1)) + 1
        t = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        axes[name] = (lower[k] * (1 - t) + upper[k] * (1 + t)) / 2
        moved = 2 * count * UNIT * (16 + 32 * (1 + upper[k]) / (upper[k] - lower[k]))
        angle = degree * (np.pi / (2 * count) + moved)
        factor *= 1 / math.cos(angle) if angle < 1.5 else math.inf

    def apart(piece: Mapping[str, np.ndarray]) -> float:
        """The largest distance between p and T Phi S at the nodes of some lines."""
        x, wrong, phi, error = enclosure.propagators(piece, atlas.fixed, middle_of(domain))
        values, rounded = _evaluated(panel, x, wrong)
        return float((frobenius(values - phi) + error + rounded).max())

    cut = enclosure.varying[0]
    cuts = np.array_split(axes[cut], -(-len(axes[cut]) // _LINES)) if cut in axes else ()
    parts = [{**axes, cut: part} for part in cuts] or [axes]
    largest = max(distance for _, distance in in_threads(parts, apart))
    bound = (factor * (largest + truncated) + truncated) * (1 + 1e-9)
    return (bound, "") if np.isfinite(bound) else (math.inf, "rounding is too large for a proof")


# Radii of the ellipses on which the growth is bounded, arcs of half an ellipse, and too many polynomials.
_RADII, _ARCS, _TOO_MANY = np.geomspace(1.03, 200, 120), 48, 10_000


def polynomials_needed(
    system: type[System], domain: Domain, target: float, lower: np.ndarray, upper: np.ndarray
) -> tuple[list[int], float]:
    """Numbers of polynomials with which each coordinate leaves out at most ``target`` on a box, and a bound of the sum.

    Interpolation at n Chebyshev nodes of a function bounded by M on the ellipse of radius r leaves out at most
    4 M r^(1-n)/(r-1). With several coordinates these errors add up, each times the Lebesgue constants of earlier ones.
    """
    smooth, d = smoothness(system), len(lower)
    corners = np.array(list(product(*zip(lower, upper, strict=True)))).T
    fixed = {name: smooth.coordinate(name).forward(value) for name, value in domain.fixed.items()}
    x = {**fixed, **dict(zip(domain.parameters, corners[..., None, None], strict=True))}
    counts, error, lebesgue = [], 0.0, 1.0
    for k, name in enumerate(domain.parameters):
        around = (upper[k] + lower[k]) / 2 + (upper[k] - lower[k]) / 2 * _ARCS_AROUND
        with np.errstate(all="ignore"):
            growth = smooth.enclosure.growth({**x, name: around}, middle_of(domain))  # pyright: ignore[reportOptionalMemberAccess]
        growth = np.broadcast_to(np.nan_to_num(growth, nan=np.inf), (2**d, *around.shape))
        largest = growth.max(axis=(0, 2)) + np.log(4 / (_RADII - 1))
        needed = 1 + (largest - math.log(target)) / np.log(_RADII)
        best = int(np.argmin(needed))
        if not needed[best] < _TOO_MANY:
            return [_TOO_MANY] * d, math.inf
        counts.append(max(math.ceil(needed[best]), 1))
        error += lebesgue * math.exp(largest[best] - (counts[-1] - 1) * math.log(_RADII[best]))
        lebesgue *= 1 + 2 / math.pi * math.log(counts[-1] + 1)
    return counts, error


def _ellipses() -> np.ndarray:
    """Corners of boxes around the arcs of ellipses with the foci -1 and 1, ``(radii, 4 arcs)``: the growth rises to one."""
    angles = np.linspace(0, math.pi, _ARCS + 1)
    real, imaginary = (np.outer(_RADII + sign / _RADII, part(angles)) / 2 for sign, part in ((1, np.cos), (-1, np.sin)))
    ends = slice(None, -1), slice(1, None)
    return np.concatenate([real[:, i] + 1j * imaginary[:, j] for i in ends for j in ends], axis=1)


_ARCS_AROUND = _ellipses()


def _log_determinant(enclosure: Enclosure, atlas: Atlas, points: np.ndarray) -> np.ndarray:
    """log det Z at points in parameters, ``(N, d) -> (N,)``."""
    return enclosure.log_determinant({**atlas.fixed, **dict(zip(atlas.parameters, points.T, strict=True))})


def _evaluated(panel: Panel, x: np.ndarray, wrong: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The polynomial of a panel at coordinates ``(N, d)`` that are ``wrong`` by at most this, ``(N, 4, 4)``, and bounds of
    the norm of its error there."""
    sizes = np.linalg.norm(panel.coefficients, axis=-1)
    width = panel.upper - panel.lower
    t = ((x - panel.lower) - (panel.upper - x)) / width
    error = np.where((np.abs(t) <= 1 + 3 * _BEYOND).all(axis=1), rounding(sum(panel.degrees) + 8) * sizes.sum(), np.inf)
    for k, n in enumerate(panel.degrees):
        # The recurrence of T_j has an error of at most 2 u j^2, and its derivative is at most j^2.
        steepest = (np.moveaxis(sizes, k, 0).reshape(n, -1).sum(axis=1) * np.arange(n) ** 2).sum()
        moved = 2 * wrong[:, k] / width[k] + 4 * UNIT * (1 + np.abs(panel.lower[k]) / width[k])
        error = error + steepest * (2 * UNIT + moved)
    values = np.empty((len(x), 16))
    for start in range(0, len(x), _POINTS):
        at = t[start : start + _POINTS]
        # Cells of a chart share lines.
        lines, line_of = np.unique(at[:, 0], return_inverse=True)
        rest = (chebvander(lines, panel.degrees[0] - 1) @ panel.coefficients.reshape(panel.degrees[0], -1))[line_of]
        for k, n in enumerate(panel.degrees[1:], start=1):
            rest = np.einsum("pn,pnr->pr", chebvander(at[:, k], n - 1), rest.reshape(len(at), n, -1))
        values[start : start + _POINTS] = rest
    return values.reshape(-1, 4, 4), error * 1.001


# Verdicts by the conditions of Schur and Cohn for p(sigma) = sigma^4 - e1 sigma^3 + e2 sigma^2 - e3 sigma + d.


# Roundings of e_k in units of 2 u |Phi|^2 |Z|^(k-1); relative error of log d and of d in units of 2 u.
_ROUNDINGS, _LOG = 128, 24
_SWAP = np.roll(np.eye(4), 2, axis=0)


def verdicts(atlas: Atlas, system: type[System], points: np.ndarray) -> np.ndarray:
    """The proved verdicts at ``points`` ``(N, d)`` in the order of ``atlas.parameters``: 0 stable, 1 unstable, 2 undecided.

    The stored binary64 parameters count as exact. Stable: all multipliers lie inside the unit circle or, without damping,
    on it and apart from each other. Unstable: at least one lies outside.
    """
    codes_of_all, enclosure = np.full(len(points), UNDECIDED, np.int8), smoothness(system).enclosure
    if enclosure is None or not any(np.isfinite(panel.proved_error) for panel in atlas.panels):
        return codes_of_all
    columns = [enclosure.coordinate(name, column) for name, column in zip(atlas.parameters, points.T, strict=True)]
    x, wrong = (np.stack(part, axis=-1) for part in zip(*columns, strict=True))
    number = atlas.find(atlas.to_coordinates(points))

    def judged(mine: np.ndarray) -> np.ndarray:
        panel = atlas.panels[number[mine[0]]]
        phi, error = _evaluated(panel, x[mine], wrong[mine])
        return _verdict(phi, panel.proved_error + error, _log_determinant(enclosure, atlas, points[mine]))

    covered = [np.flatnonzero(number == k) for k, panel in enumerate(atlas.panels) if np.isfinite(panel.proved_error)]
    blocks = (mine[i : i + _POINTS] for mine in covered for i in range(0, len(mine), _POINTS))
    for mine, codes in in_threads(blocks, judged):
        codes_of_all[mine] = codes
    return codes_of_all


def verdict_at(system: type[System], values: Mapping[str, float]) -> int:
    """The proved verdict at one point, without an atlas; undecided for a system without an enclosure."""
    enclosure = smoothness(system).enclosure
    if enclosure is None:
        return UNDECIDED
    *_, phi, error = enclosure.propagators({}, values, values)
    return int(_verdict(phi, error, np.atleast_1d(enclosure.log_determinant(values)))[0])


@_quiet
def _verdict(phi: np.ndarray, error: np.ndarray, log_d: np.ndarray) -> np.ndarray:
    """Verdicts of ``phi`` ``(N, 4, 4)``, whose errors have at most the norms ``error`` ``(N,)``; log det Z is ``log_d``."""
    eps, one = 2 * UNIT, np.eye(4)
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
    size, norm = frobenius(phi), frobenius(z)
    error = error * (1 + 1e-9)
    changed = (2 * size + error) * error
    rest = np.array([error**2, 4 * changed**2, 10 * (norm + changed) * changed**2])
    rest = rest + _ROUNDINGS * eps * size**2 * np.array([np.ones_like(norm), norm, norm**2])

    def bound(*weights: Any) -> np.ndarray:
        """Bound of the error of the sum of the e_k times these ``weights``."""
        weights = np.broadcast_arrays(*weights, size)[:3]
        slope = np.sum([weight[:, None, None] * a for weight, a in zip(weights, slopes, strict=True)], axis=0)
        higher = sum(np.abs(weight) * term for weight, term in zip(weights, rest, strict=True))
        return 2 * frobenius(slope) * error * (1 + 1e-9) + 1e-13 * size * (1 + norm) ** 2 * error + higher

    d, missing = np.exp(log_d), -np.expm1(log_d)
    of_d = _LOG * eps * (1 + np.abs(log_d)) * d
    undamped = log_d == 0
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
