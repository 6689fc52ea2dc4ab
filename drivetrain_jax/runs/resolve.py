"""Resolve a scene into a job: decide once if it is solved directly or evaluated from an atlas, and from how many solves."""

from __future__ import annotations

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.atlas import ANALYSIS
from drivetrain_jax.runs.axes import MAX_RANGES, Grid, entry_of
from drivetrain_jax.runs.job import Job, mean_cost
from drivetrain_jax.runs.scene import Ranges, Scene, atlas_ranges
from drivetrain_jax.runs.work import DIRECT

# Points below which "auto" solves directly: two more kernels would take longer to compile.
_WORTHWHILE = 100_000
# Share of the effort of direct solves that "auto" may spend on an atlas; the rest is then solved directly.
_SHARE = 1 / 8
# Direct solves of the cheapest atlas with one, two, ... parameters.
_FEWEST = (100, 500, 2_000, 8_000)
# Number of random points from whose effort the effort of all points is estimated.
_SAMPLE = 4096
# Target relative error below which rounding prevents panels from being accepted.
_FINEST = 1e-12


def resolve(scene: Scene) -> Job:
    """The job of ``scene``. Raises :class:`InputError` if its method does not suit it."""
    route = DIRECT
    # Local imports: scenes without an atlas do without its modules.
    if scene.analysis.continuous:
        from drivetrain_jax.runs.atlas_file import AtlasRoute

        route = AtlasRoute()
    elif choice := choose_atlas(scene):
        from drivetrain_jax.runs.through_atlas import ThroughAtlas

        route = ThroughAtlas(*choice)
    return Job(scene, route)


def choose_atlas(scene: Scene) -> tuple[Ranges, int | None] | None:
    """Ranges of the atlas that ``scene`` is evaluated from, and the largest number of its solves (None: its own limit).

    None if the scene does not request an atlas and ``auto`` predicts no lower cost with one. Raises :class:`InputError` if
    a scene that requests an atlas varies too many parameters.
    """
    requested = scene.request.method == "atlas"
    if scene.analysis.name != "floquet" or not (requested or scene.request.method == "auto"):
        return None
    ranges, refused = atlas_ranges(scene), ""
    if several := None if scene.zipped else next((axis for axis in scene.axes if axis.also), None):
        names = ", ".join(part.name for part in several.together)
        refused = f"axes.{several.shown.name} changes {names} together; expected auto and direct"
    elif whole := next((name for name in ranges if scene.system.parameter(entry_of(name)[0]).integer), ""):
        refused = f"{whole} is an integer; expected auto and direct"
    elif listed := next((name for name in ranges if entry_of(name)[1] is not None), ""):
        refused = f"{listed} is an entry of a list; expected auto and direct"
    elif len(ranges) > MAX_RANGES:
        refused = f"the scene varies {len(ranges)} parameters; expected at most {MAX_RANGES}"
    if refused and requested:
        raise InputError(f"options.method = 'atlas': {refused}")
    if refused or not ranges or requested:
        return (ranges, None) if ranges and not refused else None
    model, grid = scene.system.models.get(ANALYSIS.name), Grid.of(scene)
    if model is None or model.smooth is None or grid.size < _WORTHWHILE or scene.request.options["rtol"] < _FINEST:
        return None
    solves = _affordable_solves(scene, grid, ranges)
    return (ranges, solves) if solves >= _FEWEST[len(ranges) - 1] else None


def _affordable_solves(scene: Scene, grid: Grid, ranges: Ranges) -> int:
    """Number of direct solves of an atlas that cost ``_SHARE`` of the direct solves of all points.

    A node costs more than a point: its tolerance is tighter, and nodes are even in the coordinates of the atlas, such as
    1/Omega, so more nodes than points lie where solves are expensive.
    """
    from drivetrain_jax.runs.through_atlas import node_job

    chosen = np.random.default_rng(0).integers(0, grid.size, _SAMPLE)
    point = mean_cost(scene.analysis.solvers(scene.system, scene.request), grid, chosen)
    nodes = node_job(scene, ranges, _SAMPLE)
    node = mean_cost(nodes.solvers, nodes.grid, np.arange(_SAMPLE))
    # Nodes of cost 0 are nodes that no solver can compute.
    return int(grid.size * _SHARE * point / node) if node else 0
