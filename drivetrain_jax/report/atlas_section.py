"""Answers and chart of an atlas for a report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from drivetrain_jax.runs import atlas_answers as answers
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.atlas_file import StoredAtlas, open_atlas
from drivetrain_jax.runs.forced_limit import forced_over
from drivetrain_jax.runs.physical import in_parameters
from drivetrain_jax.view.units import unit_of

Writer = Callable[[str, float], str]
_UNDECIDED = "`drivetrain point` solves a value there directly, and a smaller rtol of the atlas narrows the range"


def atlas_answers(
    path: Path, cells: tuple[int, int], convert: Callable[[xr.Dataset], xr.Dataset], amplitude: Any
) -> tuple[list[str], xr.Dataset, bool]:
    """Sentences of the design questions that need no further values, the chart of the atlas at ``path``, and a flag.

    The chart has the first number of ``cells`` for one parameter, the second for more. ``convert`` puts a chart into the
    units of the sentences. The flag is true if they compare the forced motion with the limit ``amplitude``.
    """
    atlas = open_atlas(path)
    drawn = chart(path, {}, cells[len(atlas.ranges) > 1])
    said, compared = _design(atlas, partial(_written, atlas, convert(drawn)), amplitude)
    return said, drawn, compared


def _design(atlas: StoredAtlas, named: Writer, amplitude: Any) -> tuple[list[str], bool]:
    roles, free = dict(atlas.scene.system.roles), set(atlas.ranges)
    speed, angle, damping = (roles.get(name) for name in ("speed", "angle", "damping"))
    if free == {speed}:
        found = answers.speed_windows(atlas, {}).data
        forced = forced_over(atlas, amplitude, [w["safe"] for w in found["windows"]], {}, named)[0]
        return [*_windows(found, str(speed), named, forced), *_undecided(found, str(speed), named)], any(forced)
    for other, question, phrase in (
        (angle, answers.widest_angle, "up to"),
        (damping, answers.least_damping, "from"),
    ):
        if speed in free and free == {speed, other}:
            speeds = atlas.ranges[str(speed)]
            found = question(atlas, {str(speed): speeds}).data
            name, value = found["parameter"], found["value"]
            forced = [] if value is None else forced_over(atlas, amplitude, [speeds], {name: value}, named)[0]
            compared = [_sentence(text) for each in forced for text in each]
            return [*_limit(found, phrase, named), *compared, *_undecided(found, name, named)], bool(compared)
    return [], False


def _windows(found: Mapping[str, Any], speed: str, named: Writer, forced: list[list[str]]) -> list[str]:
    """A sentence for each stable range of speed."""
    said = []
    for window, compared in zip(found["windows"], forced, strict=True):
        low, high = (named(speed, value) for value in window["safe"])
        kinds = [answers.BEYOND[end["kind"]] for end in window["ends"]]
        said.append(f"Stable from {low}{kinds[0]} to {high}{kinds[1]}; {_confirmed(window['check'])}.")
        said += map(_sentence, compared)
    none = "No stable speed was found; whether there is one is undecided." if found["undecided"] else ""
    return said or [none or "No speed within the atlas is stable."]


def _limit(found: Mapping[str, Any], phrase: str, named: Writer) -> list[str]:
    """The answer of a question for one limit that holds over all speeds of the atlas."""
    name = found["parameter"]
    if found["value"] is None:
        doubt = "" if found["certain"] else " was found; whether there is one is undecided"
        return [f"No {name} of the atlas{doubt or ' makes all of its speeds stable'}."]
    confirmed = f"; {_confirmed(found['check'])}" if found["check"] else ""
    return [f"Stable at all speeds of the atlas {phrase} {named(name, found['value'])}{confirmed}."]


def _undecided(found: Mapping[str, Any], name: str, named: Writer) -> list[str]:
    ranges = [f"{named(name, low)} to {named(name, high)}" for low, high in found["undecided"]]
    return [f"Undecided from {', '.join(ranges)}: {_UNDECIDED}."] if ranges else []


def _written(atlas: StoredAtlas, shown: xr.Dataset, name: str, value: float) -> str:
    """A value of a parameter in the units of the report, as physical data where the atlas has these."""
    data = in_parameters(atlas.scene.system, {}, atlas.scene.data)[0]
    quantity = data.quantity(name, value) if data else None
    name, value, units = quantity or (name, value, atlas.scene.system.parameter(name).units)
    size, units = unit_of(shown, name, units)
    return f"{name} = {value * size:.6g}{'' if units == '1' else f' {units}'}"


def _confirmed(check: Mapping[str, Any]) -> str:
    return f"{check['solves']} direct solves {'confirm' if check['agrees'] else 'CONTRADICT'} it"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
