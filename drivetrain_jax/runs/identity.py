"""Digests of everything that affects the bits of a result, and the differences between stored work and a scene in words.

Only work with the same digest may be resumed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import clipped, counted
from drivetrain_jax.analysis import Solver
from drivetrain_jax.analysis.atlas.analysis import ANALYSIS
from drivetrain_jax.runs.scene import Problem, Scene, is_of_function, restore_scene
from drivetrain_jax.store.files import digest

if TYPE_CHECKING:
    from drivetrain_jax.runs.job import Job


def scene_content(scene: Problem) -> dict[str, Any]:
    """The content of a scene without its title."""
    request = scene.request
    return {
        "system": scene.system.name,
        "analysis": scene.analysis.name,
        "outputs": request.outputs,
        "method": request.method,
        "options": dict(request.options),
        "axes": [
            [part.name, part.parameter.units, part.values]
            for axis in scene.axes
            for part in (*axis.given, *axis.together)
        ],
        "zipped": scene.zipped,
        "fixed": dict(scene.fixed),
    }


def scene_digest(scene: Problem, solvers: Sequence[Solver], numerics: str) -> str:
    """Digest of scene (without title), chunk sizes, package version and numerics."""
    return digest(
        scene_content(scene)
        | {
            "solvers": [[solver.name, solver.chunk, solver.unit_cost] for solver in solvers],
            "version": drivetrain_jax.__version__,
            "numerics": numerics,
        }
    )


def differences(stored: Mapping[str, Any], job: Job) -> list[str]:
    """Differences of stored work from that of ``job``, as text.

    ``stored`` holds the scene (TOML), the package version, ``numerics`` and ``numerics_detail``.
    """
    text = stored.get("scene")
    if is_of_function(text) and not job.scene.is_named:
        same = "the values of over or the outputs differ"
        own = same if text == job.scene.text else "the function, an option or a fixed value differs"
        return list(_of_code(stored, job)) or [own]
    try:
        scene = restore_scene(text)
    except InputError as error:
        return [not_valid(error)]
    return differences_of(scene, stored, job)


def not_valid(error: InputError) -> str:
    """The text that the scene of stored work is not valid."""
    return f"its scene is not valid now ({' '.join(str(error).split())})"


def differences_of(scene: Scene, stored: Mapping[str, Any], job: Job, *, points: bool = True) -> list[str]:
    """Like :func:`differences`, for work of ``scene``.

    Without ``points``, axes and fixed values may differ, and the work may have more results than requested.
    """
    return [*_of_scenes(scene, job.scene, points), *_of_code(stored, job)]


def _of_code(stored: Mapping[str, Any], job: Job) -> Iterator[str]:
    """Differences of the code, its packages and the machine."""
    if stored.get("drivetrain_jax_version") != drivetrain_jax.__version__:
        yield f"drivetrain_jax is {drivetrain_jax.__version__}, was {stored.get('drivetrain_jax_version')}"
    if stored.get("numerics") != job.numerics:
        yield from _of_numerics(stored.get("numerics_detail"), job.numerics_detail)


def _of_scenes(theirs: Scene, ours: Scene, points: bool) -> Iterator[str]:
    old, new = scene_content(theirs), scene_content(ours)
    for key in ("system", "analysis", "method"):
        if old[key] != new[key]:
            yield f"{key} is {new[key]}, was {old[key]}"
    yield from _of_tables("options", old["options"], new["options"])
    if points:
        if old["outputs"] != new["outputs"]:
            yield f"outputs are {', '.join(new['outputs'])}, were {', '.join(old['outputs'])}"
        yield from _of_tables("fixed", old["fixed"], new["fixed"])
        yield from _of_axes(theirs, ours)
    elif missing := [name for name in new["outputs"] if name not in old["outputs"]]:
        yield f"lacks {', '.join(missing)}"


def _of_tables(table: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted({*old, *new}):
        if old.get(name) != new.get(name):
            yield f"{table}.{name} is {_text(new.get(name))}, was {_text(old.get(name))}"


def _of_axes(theirs: Scene, ours: Scene) -> Iterator[str]:
    old, new = ({axis.shown.name: axis.shown.values for axis in scene.axes} for scene in (theirs, ours))
    if list(old) != list(new) or theirs.zipped != ours.zipped:
        kinds = ["points" if scene.zipped else "axes" for scene in (ours, theirs)]
        yield f"{kinds[0]} are {', '.join(new) or 'none'}, {kinds[1]} were {', '.join(old) or 'none'}"
        return
    for name, values in new.items():
        if not np.array_equal(values, old[name]):
            now, before = (_range(each, ours) for each in (values, old[name]))
            yield f"{'points' if ours.zipped else 'axes'}.{name} has {now}, had {before}"


def _range(values: np.ndarray, scene: Scene) -> str:
    if scene.analysis.name == ANALYSIS.name:
        return f"the range from {values[0]:.10g} to {values[-1]:.10g}"
    ends = f"at {values[0]:.10g}" if len(values) == 1 else f"from {values[0]:.10g} to {values[-1]:.10g}"
    return f"{counted(len(values), 'value', 'values')} {ends}"


def _of_numerics(stored: str | None, present: Mapping[str, Any]) -> list[str]:
    """Differences of versions, sources and machine, as far as they were recorded."""
    try:
        old = json.loads(stored or "")
    except ValueError:
        return ["the code, a version or the machine differs"]
    found = []
    for key, value in present.items():
        before = old.get(key)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            changed = [name for name in sorted({*value, *before}) if value.get(name) != before.get(name)]
            if key == "versions":
                found += [f"{name} is {value.get(name)}, was {before.get(name)}" for name in changed]
            elif changed:
                found.append(f"the code has changed in {', '.join(changed[:3])}{', ...' if len(changed) > 3 else ''}")
        elif value != before:
            found.append(f"{key} is {_text(value)}, was {_text(before)}")
    return found or ["the code, a version or the machine differs"]


def _text(value: Any) -> str:
    return "not given" if value is None else clipped(str(list(value) if isinstance(value, tuple) else value))
