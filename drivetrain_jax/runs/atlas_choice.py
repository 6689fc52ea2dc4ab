"""Decide if a scene is evaluated from an atlas, and over which ranges."""

from __future__ import annotations

from typing import cast

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.atlas import ANALYSIS
from drivetrain_jax.runs.axes import MAX_RANGES
from drivetrain_jax.runs.grid import Grid
from drivetrain_jax.runs.plan import mean_cost
from drivetrain_jax.runs.scene import Scene

# Points below which "auto" solves directly: two more kernels would take longer to compile.
_WORTHWHILE = 100_000
# Share of the effort of direct solves that "auto" may spend on an atlas; the rest is then solved directly.
_SHARE = 1 / 8
# Direct solves of the cheapest atlas with one, two, ... parameters.
_FEWEST = (100, 500, 2_000, 8_000)
# Sample of points whose effort estimates that of all.
_SAMPLE = 4096
# Target relative error below which rounding prevents panels from being accepted.
_FINEST = 1e-12


def atlas_ranges(scene: Scene) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of every parameter that varies, those with the fewest values first."""
    lengths = {axis.name: len(axis.values) for axis in scene.axes}
    varying = [axis for axis in scene.axes if axis.values.min() < axis.values.max()]
    return {
        axis.name: (float(axis.values.min()), float(axis.values.max()))
        for axis in sorted(varying, key=lambda axis: lengths[axis.name])
    }


def uses_atlas(scene: Scene) -> bool:
    """True if ``scene`` is evaluated from an atlas: on request, or if ``auto`` predicts a lower cost.

    Raises :class:`InputError` if the scene requests an atlas and varies too many parameters.
    """
    if scene.analysis.name != "floquet" or scene.request.method not in ("auto", "atlas"):
        return False
    count = len(atlas_ranges(scene))
    if scene.request.method == "atlas":
        if count > MAX_RANGES:
            allowed = f"allowed are at most {MAX_RANGES}"
            raise InputError(f"options.method = 'atlas': the scene varies {count} parameters; {allowed}")
        return count > 0
    model = scene.system.models.get(ANALYSIS.name)
    return (
        model is not None
        and model.smooth is not None
        and 0 < count <= MAX_RANGES
        and Grid.of(scene).size >= _WORTHWHILE
        and scene.request.options["rtol"] >= _FINEST
        and cast(int, solves_allowed(scene)) >= _FEWEST[count - 1]
    )


def solves_allowed(scene: Scene) -> int | None:
    """Largest number of direct solves for the atlas of ``scene``; None for its own limit.

    A node costs more than a point: its tolerance is tighter, and nodes are even in the coordinates of the atlas, such as
    1/Omega, where expensive points are rare.
    """
    if scene.request.method != "auto":
        return None
    from drivetrain_jax.runs.rounds import node_engine

    grid, random = Grid.of(scene), np.random.default_rng(0)
    chosen = random.integers(0, grid.size, _SAMPLE)
    point = mean_cost(scene.analysis.solvers(scene.system, scene.request), grid, chosen)
    nodes = node_engine(scene, atlas_ranges(scene), _SAMPLE)
    node = mean_cost(nodes.solvers, nodes.grid, np.arange(_SAMPLE))
    # Nodes of cost 0 are nodes that no solver can compute.
    return int(grid.size * _SHARE * point / node) if node else 0
