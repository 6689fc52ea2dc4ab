"""The computations of a report: answers and chart of an atlas, and the forced motion at the points of a stability result."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from drivetrain_jax.runs.atlas_answers import least_damping, speed_windows, widest_angle
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.atlas_file import StoredAtlas, open_atlas
from drivetrain_jax.runs.forced_limit import Limit
from drivetrain_jax.runs.physical import in_parameters
from drivetrain_jax.runs.run import run
from drivetrain_jax.runs.scene import find_system
from drivetrain_jax.view.units import unit_of


def atlas_answers(
    path: Path, cells: tuple[int, int], convert: Callable[[xr.Dataset], xr.Dataset], amplitude: Any
) -> tuple[list[str], xr.Dataset, bool]:
    """Sentences of the design question that needs no further values, the chart of the atlas at ``path``, and a flag.

    The chart has the first number of ``cells`` for one parameter, the second for more. ``convert`` puts a chart into the
    units of the sentences. The flag is true if they compare the forced motion with the limit ``amplitude``.
    """
    atlas = open_atlas(path)
    drawn = chart(path, {}, cells[len(atlas.ranges) > 1])
    asked = {"amplitude": amplitude, "show": partial(_shown, atlas, convert(drawn))}
    speed, angle, damping = (atlas.scene.system.roles.get(name) for name in ("speed", "angle", "damping"))
    questions = {
        frozenset({speed}): (speed_windows, {}),
        frozenset({speed, damping}): (least_damping, {speed: atlas.ranges.get(str(speed))}),
        frozenset({speed, angle}): (widest_angle, {speed: atlas.ranges.get(str(speed))}),
    }
    question, given = questions.get(frozenset(atlas.ranges), (None, {}))
    if question is None:
        return [], drawn, False
    reply = question(atlas, given, **asked)
    return reply.sentences(), drawn, bool(reply.data.get("forced"))


def _shown(atlas: StoredAtlas, drawn: xr.Dataset, name: str, value: float) -> tuple[str, float, str]:
    """A value of a parameter in the units of the report, as physical data where the atlas has these."""
    data = in_parameters(atlas.scene.system, {}, atlas.scene.data)[0]
    quantity = data.quantity(name, value) if data else None
    name, value, units = quantity or (name, value, atlas.scene.system.parameter(name).units)
    size, units = unit_of(drawn, name, units)
    return name, value * size, units


def limit_of(result: xr.Dataset, given: Any) -> Limit | None:
    """The checked limit of the amplitude; None if the system of ``result`` has no forced response."""
    system = find_system(str(result.attrs.get("system")))
    return Limit.of(system, given) if "forced" in system.models and system.displacements is not None else None


def forced_motion(stability: xr.Dataset) -> xr.Dataset:
    """The forced amplitudes at the points of a ``floquet`` result, without a value where it is not stable."""
    scene = tomllib.loads(str(stability.attrs["scene"]))
    found = run({**scene, "analysis": "forced", "outputs": ["amplitude"], "options": {}})
    multipliers = abs(stability.get("floquet_multiplier", xr.DataArray(0.0)))
    radius = stability.get("spectral_radius", multipliers.max([d for d in multipliers.dims if d == "multiplier"]))
    grows = stability["verdict"] == 1 if "verdict" in stability else radius > 1
    amplitude = found["amplitude"].where(~grows)
    name = f"{amplitude.attrs['long_name']}, where stable"
    return found.assign(amplitude=amplitude.assign_attrs(long_name=name))
