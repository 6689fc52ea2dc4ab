"""Whether a scene is computed through an atlas, and over which ranges of its parameters."""

from __future__ import annotations

from drivetrain_jax._errors import InputError
from drivetrain_jax.sweep.axes import MAX_RANGES
from drivetrain_jax.sweep.grid import Grid
from drivetrain_jax.sweep.scene import Scene

# Points from which on "auto" tries an atlas: fewer are solved directly in the time that two more kernels take to compile.
_WORTHWHILE = 100_000
# What "auto" may spend on it: one solve for so many points of the scene. What is not covered by then is solved directly.
_POINTS_PER_SOLVE = 8
# Below this target relative error rounding keeps the panels of an atlas from being accepted.
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
    """Whether the points of ``scene`` are evaluated from an atlas: on request, or if ``auto`` finds it worthwhile.

    Raises :class:`InputError` for a scene that asks for one and varies too many parameters.
    """
    if scene.analysis.name != "floquet" or scene.request.method not in ("auto", "atlas"):
        return False
    count = len(atlas_ranges(scene))
    if scene.request.method == "atlas":
        if count > MAX_RANGES:
            raise InputError(f"options.method = 'atlas': the scene varies {count} parameters; allowed are {MAX_RANGES}")
        return count > 0
    model = scene.system.models[scene.analysis.name]
    return (
        model.smooth is not None
        and 0 < count <= MAX_RANGES
        and Grid.of(scene).size >= _WORTHWHILE
        and scene.request.options["rtol"] >= _FINEST
    )


def solves_allowed(scene: Scene) -> int | None:
    """The largest number of direct solves that the atlas of ``scene`` may take, None for its own limit."""
    return Grid.of(scene).size // _POINTS_PER_SOLVE if scene.request.method == "auto" else None
