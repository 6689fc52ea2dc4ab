"""The tensor of one box: solve, check, grow or split."""

from __future__ import annotations

import numpy as np

from drivetrain_jax.atlas import decay
from drivetrain_jax.atlas.box import BoxRefinement, Parts, Refinement, Sample
from drivetrain_jax.atlas.interpolation import coefficients, evaluate, slabs, tensor_nodes
from drivetrain_jax.atlas.panels import Panel
from drivetrain_jax.atlas.quantity import distance

HELD_OUT, _MAX_CHECKS = 64, 512
# Number of nodes from which the scale is estimated.
_SCALES = 128
# Ratio of a bound to the largest error at held-out points.
_SAFETY = 8.0
# Coefficients below this fraction of the tolerance are dropped, because they take most of the space of a large tensor.
_NEGLIGIBLE = 1e-3
_MAX_GROWTHS = 2
# Most nodes of a tensor, and most numbers at all nodes.
_MAX_TENSOR, MAX_NUMBERS = 300_000, 30_000_000


def fit(refinement: BoxRefinement, degrees: list[int]) -> Refinement:
    """A panel of about ``degrees`` nodes, or the halves or gap of the box instead."""
    d = len(degrees)
    most = min(_MAX_TENSOR, MAX_NUMBERS // refinement.settings.quantity.size)
    for growth in range(_MAX_GROWTHS + 1):
        if np.prod(degrees, dtype=float) > most:
            return refinement.split(int(np.argmax(degrees)), f"more than {most} nodes would be needed")
        checks = known_checks(refinement)
        extra = scattered(HELD_OUT, d) if growth == 0 else np.empty((0, d))
        values = yield from refinement.solve(np.concatenate([tensor_nodes(degrees), extra]))
        if not np.isfinite(values).all():
            return refinement.failed(values)
        values, fresh = np.split(values, [len(values) - len(extra)])
        x = np.concatenate([checks.x, refinement.box.place(extra)])
        checks = Sample(x, np.concatenate([checks.values, fresh]))
        tensor = coefficients(values, degrees)
        panel, tails, limit = accept_panel(refinement, tensor, values, checks)
        if panel is not None:
            return (panel,)
        if any(decay.is_noise(slabs(tensor, k)) for k in range(d) if tails[k] > 1 and degrees[k] > 24):
            return refinement.give_up("the direct solves scatter more than the tolerance allows")
        degrees = grown(tensor, tails, limit)
    return unresolved(refinement, tails)


def scattered(count: int, d: int) -> np.ndarray:
    """Held-out points in [-1, 1]^d: an additive recurrence, denser near the faces, where errors are largest."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (d + 1))
    fractions = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1, d + 1))) % 1
    return np.cos(np.pi * fractions)


def known_checks(refinement: BoxRefinement) -> Sample:
    """Solves that are not nodes of the next tensor, thinned evenly."""
    d = len(refinement.box.lower)
    none = Sample(np.empty((0, d)), np.empty((0, refinement.settings.quantity.size)))
    samples = [none, *refinement.box.known, *refinement.solved]
    x = np.concatenate([s.x for s in samples])
    values = np.concatenate([s.values for s in samples])
    chosen = np.linspace(0, len(x) - 1, min(len(x), _MAX_CHECKS)).astype(int)
    return Sample(x[chosen], values[chosen])


def accept_panel(
    refinement: BoxRefinement, tensor: np.ndarray, values: np.ndarray, checks: Sample, spare: float = 0.5
) -> tuple[Panel | None, np.ndarray, float]:
    """The panel (None if inaccurate), the truncation error of each coordinate relative to its limit, and this limit.

    The limit is half the allowed error of the values. Errors at the held-out points may use the fraction ``spare`` of the
    tolerance.
    """
    quantity, tolerance = refinement.settings.quantity, refinement.settings.tolerance
    t = refinement.box.position(checks.x)
    few = values[:: -(-len(values) // _SCALES)]
    scale = quantity.scale(np.concatenate([few, checks.values]))
    limit = tolerance * scale.min()
    tails = np.array([decay.remainder(slabs(tensor, k), limit) for k in range(tensor.ndim - 1)]) / (limit / 2)
    tensor = _without(tensor, _NEGLIGIBLE * limit)
    fitted = evaluate(tensor, t)
    errors = distance(fitted, checks.values)
    if (errors / scale[len(few) :]).max() > spare * tolerance or tails.max() > 1:
        return None, tails, limit / 2
    derived = np.abs(quantity.derived(fitted) - quantity.derived(checks.values))
    bounds = float(_SAFETY * errors.max()), _SAFETY * derived.max(axis=0, initial=0.0)
    return Panel(refinement.box.lower, refinement.box.upper, tensor, *bounds), tails, limit / 2


def _without(tensor: np.ndarray, negligible: float) -> np.ndarray:
    """``tensor`` without the coefficients below ``negligible``, as small as possible."""
    large = np.max(np.abs(tensor), axis=-1) > negligible
    kept = tuple(
        slice(int(np.max(np.flatnonzero(large.any(axis=tuple(set(range(large.ndim)) - {k}))), initial=0)) + 1)
        for k in range(large.ndim)
    )
    return np.where(large[..., None], tensor, 0.0)[kept]


def grown(tensor: np.ndarray, tails: np.ndarray, limit: float) -> list[int]:
    """Numbers of nodes, larger where the tail is too large; all a little larger if only held-out points exceed the limit."""
    degrees = list(tensor.shape[:-1])
    if tails.max() <= 1:
        return [n + max(2, n // 10) for n in degrees]
    sizes = [slabs(tensor, k) for k in range(len(degrees))]
    return [decay.extrapolated(s, limit) if tail > 1 else n for n, s, tail in zip(degrees, sizes, tails, strict=True)]


def unresolved(refinement: BoxRefinement, tails: np.ndarray) -> Parts:
    """The halves or gap of a box whose tensor has grown often enough."""
    axis = int(np.argmax(tails)) if tails.max() > 1 else None
    return refinement.trouble("not resolved where its edges are: not smooth", axis)
