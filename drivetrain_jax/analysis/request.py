"""Check outputs, method and options against those that the analysis and the system offer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._wording import did_you_mean, nearest, shown
from drivetrain_jax.analysis._base import OUTCOME, Analysis, Request
from drivetrain_jax.systems import System


def make_request(
    system: type[System],
    analysis: Analysis,
    outputs: Sequence[str] | None,
    options: Mapping[str, Any],
    varies: Set[str] = frozenset(),
) -> Request:
    """Outputs, method and options with defaults; a parameter that ``varies`` is a coordinate and not a result.

    Raises :class:`InputError` with one line that names what the system offers.
    """
    lacking = analysis.lacks(system)
    names = [v.name for v in analysis.variables]
    offered = [name for name in names if name not in lacking]
    wanted = [name for name in analysis.default_outputs if name not in varies] if outputs is None else outputs
    for name in wanted:
        if name in names and name in varies:
            raise InputError(f"outputs: {name!r} varies in this scene; allowed is to leave it out")
        if name not in names and name != OUTCOME.name:
            raise InputError(f"outputs: {name!r} is not a result of {analysis.name}{nearest(name, offered)}")
    # The outcome is always a result.
    wanted = [name for name in wanted if name != OUTCOME.name]
    if not wanted or len(set(wanted)) < len(wanted):
        raise InputError(f"outputs = {shown(outputs)}: allowed is one or more of {', '.join(offered)}, each once")
    request = Request(tuple(wanted), *_method_and_options(analysis, dict(options), lacking))
    for field, name, known in (
        ("options.method", request.method, analysis.methods),
        *(("outputs", name, names) for name in request.outputs),
    ):
        if name in lacking:
            allowed = ", ".join(other for other in known if other not in lacking)
            raise InputError(f"{field} = {name!r}: {lacking[name]}; allowed is {allowed}")
    return request


def _method_and_options(
    analysis: Analysis, given: dict[str, Any], lacking: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    methods = [name for name in analysis.methods if name not in lacking]
    method = given.pop("method", next(iter(analysis.methods)))
    if not isinstance(method, str) or method not in analysis.methods:
        raise InputError(f"options.method = {shown(method)}: unknown{nearest(str(method), methods)}")
    used = analysis.methods[method]
    for key, value in given.items():
        if key not in used:
            others = [name for name in methods if key in analysis.methods[name]]
            guess = f", but by {', '.join(others)}" if others else did_you_mean(key, ("method", *used))
            allowed = f"allowed is {', '.join(('method', *used))}"
            raise InputError(f"options.{key} = {shown(value)}: not used by method {method}{guess}; {allowed}")
    return method, {o.name: _option(o, given) for o in analysis.options if o.name in used}


def _option(option: Parameter, given: Mapping[str, Any]) -> Any:
    if option.name in given:
        return checked(option, given[option.name], "options.")
    if option.default is None and not option.derived:
        raise InputError(f"options.{option.name}: missing; allowed is {option.allowed}")
    return option.default


def checked(parameter: Parameter, value: Any, where: str) -> Any:
    """``value`` in its stored type, or :class:`InputError`; ``where`` is its table of the scene."""
    try:
        return parameter.check(value)
    except ValueError as error:
        raise InputError(f"{where}{error}") from None
    except OverflowError:
        raise InputError(f"{where}{parameter.name} = {shown(value)}: allowed is {parameter.allowed}") from None
