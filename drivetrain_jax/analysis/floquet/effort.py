"""Predicted effort of the two direct solvers of a periodic system, from its parameters alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.predictions import Words, count_of, predicted, split, taken
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.systems import FloquetModel

# Explicit steps up to which the implicit scheme is never cheaper.
_STIFF = 600
# Explicit steps beyond which a march is long: long marches have separate batches, because rounding grows with the steps.
# Least ratio of explicit steps to the steps of the oscillation at which a point with a long march counts as stiff.
LONG, _OSCILLATES = 10_000, 10.0
# Most explicit steps and most implicit panels: beyond, a point is left to the other scheme, or ends as STEP_LIMIT.
_MAX_EXPLICIT, MAX_PANELS = 1_000_000, 20_000
# Steps of a model that is NaN somewhere in its span: it is solved all the same, so that its outcome becomes NOT_FINITE.
_TO_FIND_NO_VALUE = 64
# Ratio of the time of one implicit panel to one explicit step, per point. It is 150 in full batches, but few points share a
# chunk, and more steps than necessary also cost accuracy.
PANEL_COST = 50.0
# Nodes and weights of a quadrature over [0, 1].
_NODES, _WEIGHTS = ((x + a) / 2 for x, a in zip(np.polynomial.legendre.leggauss(8), (1, 0), strict=True))
_PLACES = tuple(_NODES.tolist())

Build = Callable[..., "FloquetModel"]


class Efforts(NamedTuple):
    """Predicted efforts of N points, ``(N,)`` each: ``steps`` of the explicit scheme and ``panels`` of the implicit one, inf
    where there would be too many; ``damped`` where the explicit scheme uses the ``stiff`` form of the model too."""

    steps: np.ndarray
    damped: np.ndarray
    panels: np.ndarray


def efforts(system: type[System], columns: Mapping[str, Any], rtol: float) -> Efforts:
    """Predicted efforts of both schemes from one model."""
    build = system.models["floquet"].build
    facts = _facts(build, columns)
    model = build(columns) if facts else None
    steps = _explicit_steps(build, model if "explicit_steps" in facts else None, columns, rtol)
    damped = model.strongly_damped() if model is not None and "strongly_damped" in facts else False
    panels = _panels(system, steps, columns, rtol)
    return Efforts(_up_to(_MAX_EXPLICIT, steps), np.broadcast_to(damped, steps.shape), _up_to(MAX_PANELS, panels))


def explicit_effort(system: type[System], columns: Mapping[str, Any], rtol: float) -> np.ndarray:
    """Steps of the explicit scheme, ``(N,)``; inf where there would be too many."""
    build = system.models["floquet"].build
    model = build(columns) if "explicit_steps" in _facts(build, columns) else None
    return _up_to(_MAX_EXPLICIT, _explicit_steps(build, model, columns, rtol))


def traced_steps(build: Build, values: Mapping[str, Any], rtol: float) -> Array:
    """Steps of the explicit scheme for traced ``values``, numbers or lanes: as :func:`explicit_effort`, at least 2."""
    model = build(values)
    if model.explicit_steps is not None:
        steps = model.explicit_steps(rtol)
    else:
        arrays, rest = eqx.partition(dict(values), lambda x: isinstance(x, jax.Array) and x.ndim > 0)
        phase = lambda own: _phase(build, eqx.combine(own, rest))  # noqa: E731
        steps = _steps_of(jax.vmap(phase)(arrays) if jax.tree.leaves(arrays) else phase(arrays), rtol)
    even = 2 * jnp.ceil(jnp.where(jnp.isnan(steps), _TO_FIND_NO_VALUE, steps) / 2)
    return jnp.clip(even, 2, _MAX_EXPLICIT).astype(jnp.int64)


def _panels(system: type[System], explicit: np.ndarray, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    """Panels of the implicit scheme, which must resolve oscillations but not decay; ``explicit``: the explicit steps.

    Infinite where oscillation makes an explicit march long: the explicit march costs a twentieth and is as accurate.
    """
    effort = np.full(explicit.shape, np.inf)
    stiff = np.flatnonzero(explicit > _STIFF)
    if stiff.size:
        phase = _frequency_phase(system, taken(columns, stiff))
        decaying = (12 + 2 * np.sqrt(phase)) * (1e-9 / rtol) ** (1 / 13)
        oscillating = (8 + phase / 5) * (1e-10 / rtol) ** (1 / 16)
        panels = 2 * np.ceil(np.maximum(decaying, oscillating) / 2)
        steps = explicit[stiff]
        slow = (steps > LONG) & (steps <= _MAX_EXPLICIT) & (steps < _OSCILLATES * _steps_of(phase, rtol))
        effort[stiff] = np.where(slow, np.inf, panels)
    return effort


def _explicit_steps(
    build: Build, model: FloquetModel | None, columns: Mapping[str, np.ndarray], rtol: float
) -> np.ndarray:
    """Steps that the ``model`` predicts; without one they are estimated from the size of A^2."""
    if model is not None and model.explicit_steps is not None:
        steps = model.explicit_steps(rtol)
    else:
        steps = _steps_of(predicted(_phase, (build,), columns), rtol)
        steps = np.where(np.isnan(steps), _TO_FIND_NO_VALUE, steps)
    return np.broadcast_to(2 * np.ceil(steps / 2), count_of(columns))


def _steps_of(phase: np.ndarray | Array, rtol: float) -> np.ndarray:
    """Steps of the explicit scheme for an oscillation through the angle ``phase``."""
    with np.errstate(over="ignore"):
        return (4 + 2.5 * phase**1.1) * (1e-9 / rtol) ** (1 / 9)


def _facts(build: Build, columns: Mapping[str, Any]) -> frozenset[str]:
    """The optional attributes that the model has, found without computing their values."""
    words, numbers = split(columns)
    leaves, tree = jax.tree.flatten(numbers)
    return _known(build, words, tree, len(leaves))


@lru_cache(maxsize=32)
def _known(build: Build, words: Words, tree: Any, count: int) -> frozenset[str]:
    def model(leaves: list[Array]) -> None:
        built = build({**dict(words), **jax.tree.unflatten(tree, leaves)})
        known.extend(fact for fact in ("explicit_steps", "strongly_damped") if getattr(built, fact) is not None)

    known: list[str] = []
    jax.eval_shape(model, [jax.ShapeDtypeStruct((), float)] * count)
    return frozenset(known)


def _phase(build: Build, values: Mapping[str, Any]) -> Array:
    """Angle of the oscillation: the span times the mean of |A^2|^(1/2) at 16 instants, or times half of the largest."""
    a = _matrices(build, tuple((k + 0.5) / 16 for k in range(16)), values)
    rates = jnp.sqrt(jnp.linalg.norm(a @ a, axis=(1, 2)))
    return jnp.maximum(jnp.mean(rates), jnp.max(rates) / 2)


def _frequency_phase(system: type[System], columns: Mapping[str, Any]) -> np.ndarray:
    """int max |Im lambda(A(t))| dt over the span, ``(N,)``, by Gauss quadrature with 8 nodes."""
    a = np.moveaxis(predicted(_matrices, (system.models["floquet"].build, _PLACES), columns), -1, 1)
    finite = np.isfinite(a).all(axis=(2, 3))
    frequency = np.abs(np.linalg.eigvals(np.where(finite[..., None, None], a, 0.0)).imag).max(-1)  # pyright: ignore[reportIndexIssue]
    return np.tensordot(_WEIGHTS, np.where(finite, frequency, np.inf), 1)


def _matrices(build: Build, places: tuple[float, ...], values: Mapping[str, Any]) -> Array:
    """The span times ``A`` of one point at the fractions ``places`` of the span, ``(K, n, n)``."""
    form = build(values).reduced
    return form.span * jax.vmap(form.matrix)(form.span * jnp.array(places))


def _up_to(limit: int, effort: np.ndarray) -> np.ndarray:
    return np.where(effort <= limit, effort, np.inf)
