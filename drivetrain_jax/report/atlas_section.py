"""Answers and chart of an atlas for a report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
        return _windows(answers.speed_windows(atlas, {}).data, str(speed), atlas)
    for other, question, phrase in (
        (angle, answers.widest_angle, "up to"),
        (damping, answers.least_damping, "from"),
    ):
        if speed in free and free == {speed, other}:
            found = question(atlas, {str(speed): atlas.ranges[str(speed)]}).data
            return _limit(found, phrase, atlas)
    return []


def _windows(found: Mapping[str, Any], speed: str, atlas: StoredAtlas) -> list[str]:
    """A sentence for each stable range of speed."""
    said = []
    for window in found["windows"]:
        low, high = _written(window["physical"], speed, window["safe"], atlas)
        kinds = [answers.BEYOND[end["kind"]] for end in window["ends"]]
        said.append(f"Stable from {low}{kinds[0]} to {high}{kinds[1]}; {_confirmed(window['check'])}.")
    return said or ["No speed within the atlas is stable."]


def _limit(found: Mapping[str, Any], phrase: str, atlas: StoredAtlas) -> list[str]:
    """The answer of a question for one limit that holds over all speeds of the atlas."""
    name = found["parameter"]
    if found["value"] is None:
        return [f"No {name} of the atlas makes all of its speeds stable."]
    (value,) = _written(found["physical"], name, [found["value"]], atlas)
    confirmed = f"; {_confirmed(found['check'])}" if found["check"] else ""
    return [f"Stable at all speeds of the atlas {phrase} {value}{confirmed}."]


def _written(physical: Mapping[str, Any], name: str, values: list[float], atlas: StoredAtlas) -> list[str]:
    """Values of a parameter, in physical units where the atlas has physical data."""
    if physical:
        quantity, found = next(iter(physical.items()))
        numbers = found["value"] if isinstance(found["value"], list) else [found["value"]]
        return [f"{quantity} = {number:.6g} {found['units']}" for number in numbers]
    units = atlas.scene.system.parameter(name).units
    return [f"{name} = {value:.6g}{'' if units == '1' else f' {units}'}" for value in values]


def _confirmed(check: Mapping[str, Any]) -> str:
    return f"{check['solves']} direct solves {'confirm' if check['agrees'] else 'CONTRADICT'} it"
