"""Predicted effort of the two direct solvers of a periodic system, from its parameters alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System

# Below this many explicit steps the implicit scheme is never the cheaper one.
_STIFF = 600
# Beyond these a scheme does not start: the point is left to the other one, or ends as STEP_LIMIT.
_MAX_EXPLICIT, _MAX_PANELS = 300_000, 20_000
# Seconds of one implicit panel over those of one explicit step, per point. Full batches would have 150; but few points share
# a chunk whatever they need, and steps that a point does not need cost it exactness, too.
PANEL_COST = 50.0
# Nodes of the quadrature, and points that are evaluated together.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_TOGETHER = 2048


def explicit_effort(system: System, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    """Steps of the explicit scheme, ``(N,)``; inf where there would be too many."""
    return _up_to(_MAX_EXPLICIT, _explicit_steps(system, columns, rtol))


def implicit_effort(system: System, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    """Panels of the implicit scheme, ``(N,)``: it must resolve what oscillates, whereas decay costs it nothing."""
    explicit = _explicit_steps(system, columns, rtol)
    effort = np.full(explicit.shape, np.inf)
    stiff = np.flatnonzero(explicit > _STIFF)
    if stiff.size:
        chosen = {
            name: column if np.ndim(column) == 0 else np.broadcast_to(column, explicit.shape)[stiff]
            for name, column in columns.items()
        }
        phase = _frequency_phase(system, chosen, stiff.size)
        decaying = (12 + 2 * np.sqrt(phase)) * (1e-9 / rtol) ** (1 / 13)
        oscillating = (8 + phase / 5) * (1e-10 / rtol) ** (1 / 16)
        effort[stiff] = 2 * np.ceil(np.maximum(decaying, oscillating) / 2)
    return _up_to(_MAX_PANELS, effort)


def _explicit_steps(system: System, columns: Mapping[str, np.ndarray], rtol: float) -> np.ndarray:
    model: FloquetModel = system.models["floquet"].build(columns)
    size = max(np.size(column) for column in columns.values())
    steps = model.explicit_steps(rtol) if model.explicit_steps else _generic_steps(model.reduced, rtol)
    return np.broadcast_to(2 * np.ceil(steps / 2), size)


def _frequency_phase(system: System, columns: Mapping[str, Any], size: int) -> np.ndarray:
    """int max |Im lambda(A(t))| dt over the span for ``size`` points, by Gauss quadrature with 8 nodes."""
    varying = {name: column for name, column in columns.items() if np.ndim(column)}
    fixed = tuple((name, column) for name, column in columns.items() if name not in varying)
    matrix = _matrix(system.models["floquet"].build, fixed)
    phase = np.empty(size)
    for start in range(0, size, _TOGETHER):
        part = slice(start, min(start + _TOGETHER, size))
        count = part.stop - start
        padded = {n: np.pad(c[part], (0, _TOGETHER - count), mode="edge") for n, c in varying.items()}
        a = np.stack([np.moveaxis(np.asarray(matrix(padded, x)), -1, 0)[:count] for x in _NODES])
        finite = np.isfinite(a).all(axis=(2, 3))
        frequency = np.abs(np.linalg.eigvals(np.where(finite[..., None, None], a, 0.0)).imag).max(-1)
        phase[part] = np.tensordot(_WEIGHTS, np.where(finite, frequency, np.inf), 1)
    return phase * system.models["floquet"].build(columns).reduced.span / 2


@lru_cache(maxsize=8)
def _matrix(build: Callable[..., FloquetModel], fixed: tuple[tuple[str, Any], ...]) -> Callable[..., Array]:
    """``A``, ``(n, n, N)``, at a node in [-1, 1]: compiled for one N, not operation by operation for each."""

    def at_node(varying: Mapping[str, Array], x: Array) -> Array:
        form = build({**dict(fixed), **varying}).reduced
        a = form.matrix((x + 1) * form.span / 2)
        return jnp.broadcast_to(a.reshape(*a.shape[:2], -1), (*a.shape[:2], _TOGETHER))

    return jax.jit(at_node)


def _generic_steps(form: LinearPeriodic, rtol: float) -> np.ndarray:
    """Steps of the explicit scheme from the size of A^2 at 16 instants, for systems that predict none."""
    samples = [np.asarray(form.matrix((k + 0.5) * form.span / 16)) for k in range(16)]
    rates = [np.sqrt(np.linalg.norm(np.einsum("ij...,jk...->ik...", a, a), axis=(0, 1))) for a in samples]
    phase = form.span * np.maximum(np.mean(rates, axis=0), np.max(rates, axis=0) / 2)
    return (4 + 2.5 * phase**1.1) * (1e-9 / rtol) ** (1 / 9)


def _up_to(limit: int, effort: np.ndarray) -> np.ndarray:
    return np.where(effort <= limit, effort, np.inf)
