"""Check outputs, method and options against those that the analysis and the system offer, and what its solvers return."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax._wording import did_you_mean, nearest, shown
from drivetrain_jax.analysis._base import OUTCOME, Analysis, Request, Solver
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
    if outputs is not None and not isinstance(outputs, Iterable):
        raise InputError(f"outputs = {shown(outputs)}: allowed is a list of names")
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


def dimensions_of(
    analysis: Analysis, system: type[System], request: Request, fixed: Mapping[str, Any]
) -> tuple[Dimension, ...]:
    """The dimensions of the results; :class:`InputError` if a requested result has another one."""
    found = analysis.dimensions(system, request, fixed)
    known = [each.name for each in found]
    # The outputs of a continuous analysis are evaluated later, from its own results.
    for name in () if analysis.continuous else request.outputs:
        for dim in analysis.variable(name).dims:
            if dim not in known:
                raise InputError(f"analysis {analysis.name}: {name} has the dimension {dim!r}{nearest(dim, known)}")
    return found


def checked_solvers(
    analysis: Analysis, system: type[System], request: Request, dimensions: Sequence[Dimension]
) -> tuple[Solver, ...]:
    """The solvers of ``request``. Wrong results of a solver raise :class:`InputError` when they are traced.

    Those of a continuous analysis return values from which its function is made, and are not checked.
    """
    if analysis.continuous:
        return tuple(analysis.solvers(system, request))
    path = analysis.path_axis(system, request) is not None
    sizes = {each.name: len(each.values) for each in dimensions}
    return tuple(
        replace(each, solve=_CheckedSolve(analysis, request, path, sizes, each.solve))
        for each in analysis.solvers(system, request)
    )


@dataclass(frozen=True, eq=False)
class _CheckedSolve:
    """``solve`` of a solver, which returns the requested results and no others; ``sizes`` with 0 are unknown."""

    analysis: Analysis
    request: Request
    path: bool
    sizes: Mapping[str, int]
    solve: Callable[[Mapping[str, Any], Array], dict[str, Array]]

    def __call__(self, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        found: Any = self.solve(values, effort)
        wanted = (*(self.analysis.variable(name) for name in self.request.outputs), OUTCOME)
        names = [variable.name for variable in wanted]
        if not isinstance(found, Mapping):
            raise self._error(f"solve returned {type(found).__name__}; allowed is a dict of {', '.join(names)}")
        declared = [*(variable.name for variable in self.analysis.variables), OUTCOME.name]
        for name in found:
            if name not in declared:
                raise self._error(f"solve returned {name!r}, which is not declared{nearest(str(name), declared)}")
        for name in names:
            if name not in found:
                raise self._error(f"solve returned {', '.join(found)}, not {name}; allowed is {', '.join(names)}")
        return {variable.name: self._checked(variable, found[variable.name]) for variable in wanted}

    def _checked(self, variable: Variable, value: Any) -> Array:
        dims = [*(["path"] if self.path else []), *variable.dims]
        sizes = [self.sizes.get(dim, 0) for dim in dims]
        text = ", ".join([*(f"{dim} = {n}" if n else dim for dim, n in zip(dims, sizes, strict=True)), "lanes"])
        try:
            array = jnp.asarray(value)
        except (TypeError, ValueError):
            kind = type(value).__name__
            raise self._error(f"{variable.name} is of type {kind}; allowed is an array ({text})") from None
        fits = all(size in {0, length} for size, length in zip(sizes, array.shape, strict=False))
        if not fits or array.ndim - len(dims) not in {0, 1}:
            raise self._error(f"{variable.name} has the shape {array.shape}; allowed is ({text})")
        return array

    def _error(self, text: str) -> InputError:
        return InputError(f"analysis {self.analysis.name}: {text}")


def _method_and_options(
    analysis: Analysis, given: dict[str, Any], lacking: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    methods = [name for name in analysis.methods if name not in lacking]
    method = given.pop("method", next(iter(analysis.methods)))
    if isinstance(method, str):
        method = analysis.aliases.get(method, method)
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
