"""Sensitivities of an answer to every parameter or physical datum, largest effect first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._programs import compiled, program_identity
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.analysis.numerics.kernels import options_for_few
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.analysis.request import make_request
from drivetrain_jax.atlas.windows import Crossing
from drivetrain_jax.runs.physical import GivenData, described
from drivetrain_jax.runs.scene import find_system
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_answers import AtlasQuery

# Relative step of central differences of the conversions of physical data, and step at 0. Part of the largest effect below
# which an effect is rounding.
_STEP, _ROUNDING = 1e-5, 1e-9


class Sensitivity(NamedTuple):
    """The ``slope`` of an answer by the datum ``name`` in its ``units``, and its change for one more ``percent``."""

    name: str
    units: str
    slope: float
    percent: float


def radius_sensitivities(asked: AtlasQuery, slopes: Mapping[str, float]) -> list[Sensitivity]:
    """Sensitivities of the spectral radius at the point of a question; ``slopes`` is its gradient by the parameters."""
    point = {**asked.atlas.fixed, **asked.values}
    return _of_radius(asked.atlas.scene.system, asked.shaft, point, slopes)


def point_sensitivities(
    system: type[System], point: Mapping[str, Any], physical: Mapping[str, Any]
) -> list[Sensitivity] | None:
    """Sensitivities of the spectral radius at a ``point`` (parameters) that follows from ``physical`` data, if any; None
    without a gradient. Raises :class:`InputError` for a system without a spectral radius."""
    if "floquet" not in system.models:
        raise InputError(f"sensitivities: {system.name} has no spectral radius; allowed for floquet")
    slopes = radius_gradient(system, point)
    shaft = GivenData(system.physical, physical) if physical and system.physical else None
    return None if slopes is None else _of_radius(system, shaft, point, slopes)


def _of_radius(
    system: type[System], shaft: GivenData | None, point: Mapping[str, Any], slopes: Mapping[str, float]
) -> list[Sensitivity]:
    def change(changes: Mapping[str, float], _: Any) -> float:
        return sum(slopes[name] * x for name, x in changes.items() if name in slopes)

    return _of_data(system, shaft, point, "", change)


def limit_sensitivities(asked: AtlasQuery, parameter: str, limit: Crossing) -> list[Sensitivity]:
    """Sensitivities of a limit of ``parameter``, in physical units if its data are known; empty without a gradient.

    On the limit the spectral radius is 1, so ``d parameter/dp = -(d rho/dp)/(d rho/d parameter)``.
    """
    point = {**asked.atlas.fixed, **asked.numbers(), **limit.point, parameter: limit.value}
    slopes = radius_gradient(asked.atlas.scene.system, point)
    if slopes is None or slopes[parameter] == 0:
        return []
    turned = {name: -slope / slopes[parameter] for name, slope in slopes.items() if name != parameter}

    def limit_at(changes: Mapping[str, float], data: Mapping[str, Any]) -> float:
        value = limit.value + sum(turned[n] * x for n, x in changes.items() if n in turned)
        back = asked.shaft.physical.back(parameter, data) if asked.shaft else None
        return float(back[1](value)) if back else value

    return _of_data(asked.atlas.scene.system, asked.shaft, point, parameter, limit_at)


def _of_data(
    system: type[System],
    shaft: GivenData | None,
    point: Mapping[str, float],
    without: str,
    answer: Callable[[dict[str, float], Any], float],
) -> list[Sensitivity]:
    """Sensitivities of ``answer(changes of the parameters, data)`` by the physical data, and by parameters without such.

    The quantity behind the parameter ``without`` is no datum, because it is the answer.
    """
    data: dict[str, Any] = {name: value for name, value in point.items() if name != without}
    if shaft:
        follow = {each.parameter: each.needs for each in shaft.physical.conversions}
        own = {name: shaft.quantity(name, value) for name, value in point.items()}
        ends = {known[0]: known[1] for name, known in own.items() if known and name != without}
        given = {name: x for name, x in shaft.data.items() if name in shaft.physical.names and _is_number(x)}
        given = {**given, **ends}
        given.pop(follow[without][0] if without in follow else "", None)
        known = {name for name, needs in follow.items() if set(needs) <= given.keys()}
        used = {need for name in known for need in follow[name]}
        data = {name: x for name, x in given.items() if name in used} | {
            name: value for name, value in data.items() if name not in known
        }

    def at(data: Mapping[str, Any]) -> float:
        converted = shaft.physical.converted(data) if shaft else {}
        parameters = {**data, **converted}
        return answer({name: parameters[name] - x for name, x in point.items() if name in parameters}, data)

    names, found = described(system), []
    for name, value in data.items():
        if names[name].integer:
            continue
        step = _STEP * abs(value) or _STEP
        slope = (at({**data, name: value + step}) - at({**data, name: value - step})) / (2 * step)
        found.append(Sensitivity(name, names[name].units, slope, slope * value / 100))
    return sorted(found, key=lambda each: -abs(each.percent))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def gradient_lines(found: list[Sensitivity] | None) -> list[str]:
    """The sensitivities of the spectral radius as text."""
    if found is None:
        return [
            "gradient of spectral_radius",
            "  none: two multipliers have the largest modulus, within the errors, or it cannot be computed",
        ]
    return [
        "gradient of spectral_radius, largest effect of 1 % first",
        *(
            f"  {each.name:<24} {each.percent:+.6g} for +1 %, {each.slope:.6g}"
            f"{'' if each.units == '1' else f' per {each.units}'}"
            for each in found
        ),
    ]


def limit_line(asked: AtlasQuery, parameter: str, limit: Crossing | None, before: str = "") -> tuple[str, list[Any]]:
    """The sensitivities of a limit as a line of text and as data; empty without any."""
    found = limit_sensitivities(asked, parameter, limit) if limit else []
    if limit is None or not found:
        return "", []
    physical = asked.shaft.quantity(parameter, limit.value) if asked.shaft else None
    name, _, units = physical or (parameter, 0.0, asked.atlas.scene.system.parameter(parameter).units)
    least = _ROUNDING * abs(found[0].percent)
    changes = ", ".join(f"{each.name} {each.percent:+.3g}" for each in found if abs(each.percent) > least)
    unit = "" if units == "1" else f" [{units}]"
    return f"{before}+1 % of a value changes {name} by{unit}: {changes}", [x._asdict() for x in found]


def radius_gradient(system: type[System], values: Mapping[str, float]) -> dict[str, float] | None:
    """Derivatives of the spectral radius by all parameters of ``system`` at ``values``, integers apart; None without any."""
    names = system.models["floquet"].parameters
    found = np.asarray(_compiled_gradient(system, names)({name: np.float64(values[name]) for name in names}))
    # JAX orders the leaves of a dictionary by key.
    slopes = dict(zip(sorted(names), map(float, found), strict=True))
    real = [name for name in names if not system.parameter(name).integer]
    return {name: slopes[name] for name in real} if np.isfinite([slopes[name] for name in real]).all() else None


@lru_cache(maxsize=8)
def _compiled_gradient(system: type[System], names: tuple[str, ...]) -> Callable[[dict[str, float]], jax.Array]:
    """The derivative rule of :func:`~drivetrain_jax.floquet` alone: tracing the value as well takes twice the time."""
    analysis = get_analysis("floquet").for_system(system)
    request = make_request(system, analysis, ["spectral_radius"], {})

    def slopes(parameters: dict[str, jax.Array]) -> jax.Array:
        assert analysis.derivatives is not None
        constants = Constants(dict.fromkeys(names))
        return analysis.derivatives(system, request, parameters, constants, {})["spectral_radius"]

    kinds = ({name: np.float64(0.0) for name in names},)
    identity = program_identity(system, analysis, "gradient") if find_system(system.name) is system else ""
    return compiled(slopes, kinds, options_for_few(), identity)
