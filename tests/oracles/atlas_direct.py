"""Direct solves of the cardan shaft's propagator, an atlas from them, and spectral radii for comparison.

The solves are jitted once for all tolerances and parameter sets, as a short form of the engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivetrain_jax.analysis import Request, Solver
from drivetrain_jax.analysis.atlas import SOLVES
from drivetrain_jax.analysis.numerics.kernels import compiler_options
from drivetrain_jax.atlas import StabilityAtlas, floquet_atlas, solve_rtol, stability_atlas
from drivetrain_jax.systems import get_system

CARDAN = get_system("cardan")
BASE = dict(CARDAN.presets["base"])
NAMES = CARDAN.models["floquet"].parameters
OUTPUTS = SOLVES.default_outputs
_SIZE = 512


def direct_solver(rtol: float) -> Solver:
    """The solver of the method ``direct`` for the propagator."""
    (solver,) = SOLVES.solvers(CARDAN, Request(OUTPUTS, "direct", {"rtol": rtol}))
    return solver


# Optimised: thousands of solves take longer than their compilation.
@partial(jax.jit, compiler_options=compiler_options(_SIZE, march=True, short_loops=True))
def _batch(values: Mapping[str, Any], effort: Any, rtol: Any) -> jax.Array:
    found = direct_solver(rtol).solve(values, effort)
    return jnp.concatenate([found[name] for name in OUTPUTS])


def propagators(columns: Mapping[str, Any], rtol: float = 1e-13) -> np.ndarray:
    """Propagators ``(N, 16)`` for arrays of parameters."""
    return solves(columns, rtol)[:, :16]


def solves(columns: Mapping[str, Any], rtol: float) -> np.ndarray:
    """Propagators followed by their errors, ``(N, 32)``; points of similar effort are solved together."""
    given = np.broadcast_arrays(*(np.atleast_1d(np.asarray(columns[name], float)) for name in NAMES))
    points = dict(zip(NAMES, given, strict=True))
    efforts = np.asarray(direct_solver(rtol).effort(points), float)
    out, order = np.empty((efforts.size, 32)), np.argsort(efforts, kind="stable")
    for part in (order[i : i + _SIZE] for i in range(0, order.size, _SIZE)):
        padded = {name: np.pad(x[part], (0, _SIZE - part.size), mode="edge") for name, x in points.items()}
        out[part] = np.asarray(_batch(padded, np.int64(efforts[part].max()), rtol)).T[: part.size]
    return out


def cardan_atlas(
    ranges: Mapping[str, tuple[float, float]], tolerance: float, fixed: Mapping[str, float] = BASE, rtol: float = 1e-10
) -> StabilityAtlas:
    """An atlas of the cardan shaft."""
    fixed = {name: value for name, value in fixed.items() if name not in ranges}
    names = tuple(ranges)

    def solve(points: np.ndarray) -> np.ndarray:
        return solves({**fixed, **dict(zip(names, points.T, strict=True))}, solve_rtol(tolerance))

    return stability_atlas(floquet_atlas(CARDAN, ranges, fixed, tolerance, solve), CARDAN, rtol)


def monodromy(phi: np.ndarray) -> np.ndarray:
    """``Z = X Phi^T X Phi``, ``(N, 4, 4)``, from propagators ``(N, 16)``."""
    x = CARDAN.models["floquet"].build({**BASE, "beta": 0.3, "Omega": 1.0}).reduced.reversor
    matrix = phi.reshape(-1, 4, 4)
    return x @ np.swapaxes(matrix, 1, 2) @ x @ matrix


def direct_radius(atlas: StabilityAtlas, points: np.ndarray, rtol: float = 1e-14) -> tuple[np.ndarray, np.ndarray]:
    """Spectral radius at ``points`` of a StabilityAtlas by direct solves, and Z."""
    columns = {**atlas.atlas.fixed, **dict(zip(atlas.atlas.parameters, points.T, strict=True))}
    z = monodromy(propagators(columns, rtol))
    return np.abs(np.linalg.eigvals(z)).max(axis=1), z


def random_points(atlas: StabilityAtlas, count: int, seed: int = 0) -> np.ndarray:
    """Random points within the ranges of the atlas."""
    lower, upper = atlas.atlas.lower, atlas.atlas.upper
    return lower + (upper - lower) * np.random.default_rng(seed).random((count, len(lower)))
