"""Predicted work for a periodic system, from its parameters alone: panels of Gauss collocation, steps of order 8."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.kernels import Words, count_of, predicted, split
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Most panels and most steps of a point; with more, it ends as STEP_LIMIT.
MAX_PANELS, MAX_STEPS = 400_000, 1_000_000
# Panels of a model that is NaN somewhere in its span: it is solved all the same, so that its outcome becomes NOT_FINITE.
_TO_FIND_NO_VALUE = 16
# Mean decay in a panel up to which Gauss collocation has its full order.
_FADING = 0.1
# Steps of order 8 as accurate as one panel, and the decay in a step with which explicit schemes are stable.
STEPS, _STABLE = 2.5, 6.0

Build = Callable[..., "FloquetModel"]


def panels_needed(system: type[System], columns: Mapping[str, Any], rtol: float) -> np.ndarray:
    """Panels of every point, ``(N,)``; inf where there would be too many."""
    build = system.models["floquet"].build
    if model := _model_with("panels", build, columns):
        panels = model.panels(rtol)  # pyright: ignore[reportOptionalCall]
    else:
        panels = _panels_of(_frequency_phase(build, columns), predicted(_decay, (build,), columns), rtol)
    panels = np.where(np.isnan(panels), _TO_FIND_NO_VALUE, panels)
    return np.broadcast_to(np.where(panels <= MAX_PANELS, np.ceil(panels), np.inf), count_of(columns))


def strongly_damped(system: type[System], columns: Mapping[str, Any]) -> np.ndarray | bool:
    """True for the points that use the ``damped`` form of the model."""
    model = _model_with("strongly_damped", system.models["floquet"].build, columns)
    return model.strongly_damped() if model else False  # pyright: ignore[reportOptionalCall]


def traced_panels(build: Build, values: Mapping[str, Any], rtol: float) -> Array:
    """Panels for traced ``values``, numbers or lanes: as :func:`panels_needed`, at least 2."""
    model = build(values)
    if model.panels is not None:
        panels = model.panels(rtol)
    else:
        arrays, rest = eqx.partition(dict(values), lambda x: isinstance(x, jax.Array) and x.ndim > 0)
        need = lambda point: _panels_of(*_estimate(build, eqx.combine(point, rest)), rtol)  # noqa: E731
        panels = jax.vmap(need)(arrays) if jax.tree.leaves(arrays) else need(arrays)
    panels = jnp.ceil(jnp.where(jnp.isnan(panels), _TO_FIND_NO_VALUE, panels))
    return jnp.clip(panels, 2, MAX_PANELS).astype(jnp.int64)


def steps_needed(system: type[System], columns: Mapping[str, Any], rtol: float) -> np.ndarray:
    """Steps of an explicit scheme of order 8, ``(N,)``; inf where there would be too many."""
    decay = predicted(_decay, (system.models["floquet"].build,), columns)
    steps = np.maximum(STEPS * panels_needed(system, columns, rtol), np.nan_to_num(decay) / _STABLE)
    return np.where(steps <= MAX_STEPS, steps, np.inf)


def stable_steps(system: LinearPeriodic) -> Array:
    """Steps with which an explicit scheme is stable: ``-tr A`` bounds the rates of decay."""
    return _decay_of(system) / _STABLE


def _decay(build: Build, values: Mapping[str, Any]) -> Array:
    return _decay_of(build(values).reduced)


def fades(system: LinearPeriodic, panels: Array) -> Array:
    """True if modes of any lane decay within panels so fast that the scheme has less than its order."""
    decay = _decays(system)
    mean = jnp.mean(decay, axis=0) if decay.ndim > 1 else decay
    return jnp.nanmax(mean, initial=0.0) > _FADING * panels


def _decay_of(system: LinearPeriodic) -> Array:
    """The span times the largest ``-tr A`` at 5 instants, of all lanes."""
    return jnp.nanmax(_decays(system), initial=0.0)


def _decays(system: LinearPeriodic) -> Array:
    # Only the diagonal is used: the compiler drops the other entries.
    entries = system.entries(*system.basis(jnp.arange(5)[:, None] * system.span / 4))
    rate = -sum((entry for (i, j), entry in entries.items() if i == j), jnp.zeros(()))
    return rate * system.span


def fastest_rate(system: LinearPeriodic) -> Array:
    """The span times the largest ``sqrt(sum |a_ij a_ji|)`` at 5 instants, of all lanes; no scaling of states changes it."""
    entries = system.entries(*system.basis(jnp.arange(5)[:, None] * system.span / 4))
    squares = sum((jnp.abs(x * entries.get((j, i), 0.0)) for (i, j), x in entries.items()), jnp.zeros(()))
    return jnp.nanmax(system.span * jnp.sqrt(squares), initial=0.0)


def _panels_of(phase: Any, decay: Any, rtol: float) -> Any:
    """Panels for an oscillation through the angle ``phase`` and a decay by ``exp(-decay)``."""
    with np.errstate(over="ignore"):
        return (2 + 1.2 * phase) * (1e-9 / rtol) ** (1 / 10) + abs(decay / 2) ** 0.5


def _model_with(fact: str, build: Build, columns: Mapping[str, Any]) -> FloquetModel | None:
    """The model of the columns if it has the optional attribute ``fact``, found without computing its values."""
    words, numbers = split(columns)
    leaves, tree = jax.tree.flatten(numbers)
    return build(columns) if fact in _facts(build, words, tree, len(leaves)) else None


@lru_cache(maxsize=32)
def _facts(build: Build, words: Words, tree: Any, count: int) -> frozenset[str]:
    def model(leaves: list[Array]) -> None:
        built = build({**dict(words), **jax.tree.unflatten(tree, leaves)})
        known.extend(fact for fact in ("panels", "strongly_damped") if getattr(built, fact) is not None)

    known: list[str] = []
    jax.eval_shape(model, [jax.ShapeDtypeStruct((), float)] * count)
    return frozenset(known)


def _frequency_phase(build: Build, columns: Mapping[str, Any]) -> np.ndarray:
    """Angle of the fastest oscillation, ``(N,)``: the mean of |Im lambda(A)| at 16 instants, or half of the largest."""
    a = np.moveaxis(predicted(_matrices, (build,), columns), -1, 1)
    finite = np.isfinite(a).all(axis=(2, 3))
    frequency = np.abs(np.linalg.eigvals(np.where(finite[..., None, None], a, 0.0)).imag).max(-1)  # pyright: ignore[reportIndexIssue]
    frequency = np.where(finite, frequency, np.nan)
    return np.maximum(np.mean(frequency, axis=0), np.max(frequency, axis=0) / 2)


def _estimate(build: Build, values: Mapping[str, Any]) -> tuple[Array, Array]:
    """Angle of the oscillation and decay without eigenvalues; exact for two states."""
    a = _matrices(build, values)
    trace = jnp.trace(a, axis1=1, axis2=2)
    square = trace**2 / 4 - jnp.sum(a * jnp.swapaxes(a, 1, 2), axis=(1, 2)) / 2
    rates = jnp.sqrt(jnp.maximum(square, 0.0))
    return jnp.maximum(jnp.mean(rates), jnp.max(rates) / 2), -jnp.mean(trace)


def _matrices(build: Build, values: Mapping[str, Any]) -> Array:
    """The span times ``A`` of one point at 16 instants, ``(16, n, n)``."""
    form = build(values).direct
    return form.span * jax.vmap(form.matrix)(form.span * (jnp.arange(16) + 0.5) / 16)
