"""Answers and chart of an atlas for a report."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from drivetrain_jax.runs import atlas_answers as answers
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.atlas_file import StoredAtlas, open_atlas


def atlas_answers(path: Path, cells: int) -> tuple[list[str], xr.Dataset]:
    """Sentences of the design questions that need no further values, and the chart of the atlas at ``path``."""
    atlas = open_atlas(path)
    return _design(atlas), chart(path, {}, cells)


def _design(atlas: StoredAtlas) -> list[str]:
    roles, free = dict(atlas.scene.system.roles), set(atlas.ranges)
    speed, angle, damping = (roles.get(name) for name in ("speed", "angle", "damping"))
    if free == {speed}:
        found = answers.speed_windows(atlas, {})
    elif speed in free and free == {speed, angle}:
        found = answers.widest_angle(atlas, {speed: atlas.ranges[speed]})
    elif speed in free and free == {speed, damping}:
        found = answers.least_damping(atlas, {speed: atlas.ranges[speed]})
    else:
        return []
    return [line.strip() for line in str(found).splitlines()]
