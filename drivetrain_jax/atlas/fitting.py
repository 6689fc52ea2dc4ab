"""The tensor of one box: solve, check, grow or split."""

from __future__ import annotations

import numpy as np

from drivetrain_jax.atlas import decay
from drivetrain_jax.atlas.box import Exploration, Parts, Progress, Sample
from drivetrain_jax.atlas.interpolation import coefficients, evaluate, slabs, tensor_nodes
from drivetrain_jax.atlas.panels import Panel

_HELD_OUT, _MAX_CHECKS = 64, 512
# Bounds are this many times the largest error at held-out points.
_SAFETY = 8.0
# Coefficients below this part of the tolerance are left out: they take up most of the space of a large tensor.
_NEGLIGIBLE = 1e-3
_MAX_GROWTHS = 2
_MAX_TENSOR = 300_000


def fit(progress: Progress, degrees: list[int]) -> Exploration:
    """A panel of about ``degrees`` nodes, or what becomes of the box instead."""
    d = len(degrees)
    for growth in range(_MAX_GROWTHS + 1):
        if np.prod(degrees, dtype=float) > _MAX_TENSOR:
            return progress.split(int(np.argmax(degrees)), f"more than {_MAX_TENSOR} nodes would be needed")
        t = tensor_nodes(degrees)
        checks = _checks(progress)
        extra = scattered(_HELD_OUT, d) if growth == 0 else np.empty((0, d))
        values = yield from progress.ask(np.concatenate([t, extra]))
        if not np.isfinite(values).all():
            return progress.failed(values)
        fresh = Sample(progress.box.place(extra), values[len(t) :])
        checks = Sample(np.concatenate([checks.x, fresh.x]), np.concatenate([checks.values, fresh.values]))
        tensor = coefficients(values[: len(t)], degrees)
        panel, tails, limit = _judge(progress, tensor, values[: len(t)], checks)
        if panel is not None:
            return (panel,)
        if any(decay.is_noise(slabs(tensor, k)) for k in range(d) if tails[k] > 1 and degrees[k] > 24):
            return progress.give_up("the direct solves scatter more than the tolerance allows")
        degrees = _grown(tensor, tails, limit)
    return _unresolved(progress, tails)


def scattered(count: int, d: int) -> np.ndarray:
    """Held-out points in [-1, 1]^d: an additive recurrence, denser towards the faces, where errors are largest."""
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (d + 1))
    fractions = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1, d + 1))) % 1
    return np.cos(np.pi * fractions)


def _checks(progress: Progress) -> Sample:
    """Solves that are no nodes of the next tensor, evenly thinned out."""
    d = len(progress.box.lower)
    samples = [*progress.box.known, *progress.solved]
    x = np.concatenate([s.x for s in samples]).reshape(-1, d)
    values = np.concatenate([s.values for s in samples])
    chosen = np.linspace(0, len(x) - 1, min(len(x), _MAX_CHECKS)).astype(int)
    return Sample(x[chosen], values[chosen])


def _judge(
    progress: Progress, tensor: np.ndarray, values: np.ndarray, checks: Sample
) -> tuple[Panel | None, np.ndarray, float]:
    """The panel if it is good enough; what each coordinate leaves out over its limit; that limit."""
    quantity, tolerance = progress.settings.quantity, progress.settings.tolerance
    t = progress.box.position(checks.x)
    scale = quantity.scale(np.concatenate([values, checks.values]))
    limit = tolerance * scale.min()
    tails = np.array([decay.remainder(slabs(tensor, k)) for k in range(tensor.ndim - 1)]) / (limit / 2)
    tensor = np.where(np.max(np.abs(tensor), axis=-1, keepdims=True) > _NEGLIGIBLE * limit, tensor, 0.0)
    fitted = evaluate(tensor, t)
    errors = _distance(fitted, checks.values)
    if np.max(errors / scale[len(values) :]) > tolerance / 2 or tails.max() > 1:
        return None, tails, limit / 2
    derived = np.abs(quantity.derived(fitted) - quantity.derived(checks.values))
    bounds = float(_SAFETY * errors.max()), _SAFETY * derived.max(axis=0, initial=0.0)
    return Panel(progress.box.lower, progress.box.upper, tensor, *bounds), tails, limit / 2


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum((a - b) ** 2, axis=1))


def _grown(tensor: np.ndarray, tails: np.ndarray, limit: float) -> list[int]:
    """More nodes where the tail is too large; a few everywhere if only the held-out points are missed."""
    degrees = list(tensor.shape[:-1])
    if tails.max() <= 1:
        return [n + max(2, n // 10) for n in degrees]
    sizes = [slabs(tensor, k) for k in range(len(degrees))]
    return [decay.extrapolated(s, limit) if tail > 1 else n for n, s, tail in zip(degrees, sizes, tails, strict=True)]


def _unresolved(progress: Progress, tails: np.ndarray) -> Parts:
    axis = int(np.argmax(tails)) if tails.max() > 1 else None
    return progress.trouble("not resolved where its edges are: not smooth", axis)
