"""Resolve a scene into a job: decide once how it is computed."""

from __future__ import annotations

from drivetrain_jax.runs.atlas_choice import choose_atlas
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.scene import Scene
from drivetrain_jax.runs.work import DIRECT, Route


def resolve(scene: Scene) -> Job:
    """The job of ``scene``. Raises :class:`InputError` if its method does not suit it."""
    return Job(scene, _route(scene))


def _route(scene: Scene) -> Route:
    # Local imports: scenes without an atlas do without its modules.
    if scene.analysis.continuous:
        from drivetrain_jax.runs.atlas_file import AtlasRoute

        return AtlasRoute()
    if choice := choose_atlas(scene):
        from drivetrain_jax.runs.through_atlas import ThroughAtlas

        return ThroughAtlas(*choice)
    return DIRECT
