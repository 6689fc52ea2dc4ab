"""An analysis: named results of one point (or of one line along a path axis), its solvers, and checked requests to it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import lru_cache, reduce
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError, did_you_mean, nearest, shown
from drivetrain_jax._quantities import FIRST_FAILURE, Dimension, Parameter, Variable
from drivetrain_jax.systems import Model, System


class Outcome(IntEnum):
    """Outcome of a point. From ``NOT_CONVERGED`` (``FIRST_FAILURE``) on, results that could not be computed are NaN."""

    SUCCESS = 0
    TOLERANCE_NOT_MET = 1  # the value is stored with its error, which exceeds the target
    NOT_CONVERGED = 2
    STEP_LIMIT = 3
    NOT_FINITE = 4
    LOST = 5  # its worker crashed three times

    @property
    def has_value(self) -> bool:
        return self < FIRST_FAILURE


OUTCOME = Variable(
    "outcome", "1", "outcome of the computation", dtype="int8", flags=tuple(o.name.lower() for o in Outcome)
)
RTOL = Parameter("rtol", "1", "target relative error of the results", default=1e-10, lower=1e-14, upper=1e-2)
# Allowed values of the option `solver`: three explicit solvers of diffrax of order 8 and 5, and a stiff one.
DIFFRAX_SOLVERS = ("Dopri8", "Dopri5", "Tsit5", "Kvaerno5")
Quantity = TypeVar("Quantity", Parameter, Variable)
# Upper limit of simulated time (30 years, in s), and of steps (11 days at a microsecond each).
MOST_SECONDS, MOST_STEPS = 1e9, 1e12


@dataclass(frozen=True)
class Request:
    """The requested results of an analysis, its method, and its options with defaults."""

    outputs: tuple[str, ...]
    method: str
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Solver:
    """One way to compute the requested results of one point.

    The engine assigns every point to the solver with the smallest ``effort * unit_cost``, and runs batches of ``chunk``
    points of similar effort.
    """

    #: Name in logs and tests.
    name: str
    #: ``solve(values, effort)``: every requested variable and ``outcome``, with the lanes as LAST axis. ``values`` holds all
    #: parameters of the model: varying ones as JAX arrays of lanes ``(N,)``, the others as numbers. ``effort`` is a traced
    #: integer, the largest ``effort(columns)`` in the batch. A path axis is a NumPy array ``(L,)``; results then have the
    #: path as FIRST axis. :func:`~drivetrain_jax.analysis.numerics.lanes.over_lanes` makes it from a function of one point.
    solve: Callable[[Mapping[str, Any], Array], dict[str, Array]]
    #: ``effort(columns)``: number of steps for NumPy arrays ``(N,)``; equal for all points by default.
    effort: Callable[[Mapping[str, np.ndarray]], np.ndarray] = lambda columns: np.ones(())
    #: ``steps(values)``: predicted effort of every lane from traced values, if ``solve`` uses its effort.
    steps: Callable[[Mapping[str, Any]], Array] | None = None
    #: Cost of a step, relative to the other solvers.
    unit_cost: float = 1.0
    #: Rough time of one step on one core in s, for a point (also of a path). It determines the size of blocks, and up to
    #: which number of points kernels compile without optimisation.
    seconds: float = 2e-4
    #: Points of a batch; lines if there is a path axis.
    chunk: int = 256
    #: Integrations in time, which need other compiler options (``numerics.kernels.compiler_options``).
    march: bool = False
    #: Loops over some tens of lanes, which need other compiler options.
    short_loops: bool = False
    #: One point takes as long as a compilation.
    lengthy: bool = False
    #: For jobs of one point only, which wait for the compiler.
    single: bool = False
    #: So few points are asked for that the compiler would take longer to optimise than all of them to compute.
    few: bool = False


def finite_results(
    results: Mapping[str, Array], *, path: bool = False, gaps: Collection[str] = (), infinite: Collection[str] = ()
) -> dict[str, Array]:
    """``results`` with outcome ``NOT_FINITE``, and NaN for all numbers, where a success has no finite value.

    The axes of a result are the ``path`` if there is one, its own, and the lanes. Results in ``gaps`` may be NaN, those in
    ``infinite`` may be infinite.
    """
    outcome = results[OUTCOME.name]
    real = {name: x for name, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact)}

    def lost(name: str, x: Array) -> Array:
        missing = jnp.zeros(x.shape, bool) if name in gaps else jnp.isnan(x)
        missing |= False if name in infinite else jnp.isinf(x)
        return jnp.any(missing, axis=tuple(range(path, path + x.ndim - outcome.ndim)))

    broken = reduce(jnp.logical_or, (lost(*item) for item in real.items()), jnp.zeros(outcome.shape, bool))
    broken &= outcome < Outcome.NOT_CONVERGED

    def kept(x: Array) -> Array:
        axes = tuple(range(path, path + x.ndim - outcome.ndim))
        return jnp.where(jnp.expand_dims(broken, axes), jnp.nan, x)

    kept_values = {name: kept(x) for name, x in real.items()}
    return {**results, **kept_values, OUTCOME.name: jnp.where(broken, jnp.int8(Outcome.NOT_FINITE), outcome)}


def stacked(jacobian: Any) -> Array:
    """A pytree of derivatives with respect to each parameter as one Jacobian ``(..., P)``."""
    return jnp.stack(jax.tree.leaves(jacobian), axis=-1)


def in_time_of(system: type[System], quantities: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
    """``quantities`` in s and 1/s, in the unit of time of ``system`` instead."""
    second = system.unit_of_time()
    units = {"s": second, "1/s": f"1/{second}"}
    return tuple(replace(quantity, units=units.get(quantity.units, quantity.units)) for quantity in quantities)


def forward_derivatives(
    solvers: Callable[[type[System], Request], tuple[Solver, ...]],
    system: type[System],
    request: Request,
    parameters: Any,
    constants: Any,
    results: Mapping[str, Array],
) -> dict[str, Array]:
    """Jacobians by forward differentiation through the first of ``solvers``, see :class:`Analysis`."""
    solve = solvers(system, request)[0].solve
    names = [n for n, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact) and not n.endswith("_error")]

    def found(parameters: Any) -> dict[str, Array]:
        solved = solve(eqx.combine(parameters, constants.tree), jnp.int64(1))
        return {name: solved[name] for name in names}

    jacobians = jax.jacfwd(found)(parameters)
    return {name: stacked(jacobian) for name, jacobian in jacobians.items()}


@dataclass(frozen=True, eq=False)
class Analysis:
    """Named results, methods and solvers: the one record of an analysis.

    Figures and rules of an analysis are registered by its name, because they are used without jax.
    """

    #: Name in scenes and of the function, ``floquet``.
    name: str
    #: One line about the analysis.
    title: str
    #: All results; an analysis that has the results of its systems gives them in ``of_system``.
    variables: tuple[Variable, ...]
    #: Names of the results that are computed if a request names none.
    default_outputs: tuple[str, ...]
    #: The names of the options of each method; the first method is the default.
    methods: Mapping[str, tuple[str, ...]]
    #: The options of all methods.
    options: tuple[Parameter, ...]
    #: ``solvers(system, request)``: the candidates for the requested method.
    solvers: Callable[[type[System], Request], tuple[Solver, ...]]
    #: ``dimensions(system, request, fixed)``: the dimensions of the results besides those of the sweep. ``fixed`` holds the
    #: parameters that do not vary (a list is complete even if one entry varies). Raises ``InputError`` if request and
    #: parameters do not match.
    dimensions: Callable[[type[System], Request, Mapping[str, Any]], tuple[Dimension, ...]] = lambda *_: ()
    #: ``lacks(system)``: the reason for each result and method that the system does not support.
    lacks: Callable[[type[System]], Mapping[str, str]] = lambda _: {}
    #: ``path_axis(system, request)``: the axis that is computed as a whole, if any.
    path_axis: Callable[[type[System], Request], str | None] = lambda *_: None
    #: ``derivatives(system, request, parameters, constants, results)``: Jacobians ``(..., P)`` of differentiable results at
    #: one point by all P ``parameters`` (arrays; ``constants`` hold the rest). ``results`` include ``derivative_outputs``.
    derivatives: Callable[..., Mapping[str, Array]] | None = None
    #: ``derivative_outputs(outputs)``: results that ``derivatives`` needs besides the requested ones.
    derivative_outputs: Callable[[tuple[str, ...]], tuple[str, ...]] = lambda _: ()
    #: The analysis accepts ranges for axes, and returns a function of the parameters instead of values on a grid.
    continuous: bool = False
    #: One line about each method.
    method_titles: Mapping[str, str] = field(default_factory=dict)
    #: Methods by their other names.
    aliases: Mapping[str, str] = field(default_factory=dict)
    #: ``of_system(system)``: the fields that depend on the system, by name, for example its ``variables``.
    of_system: Callable[[type[System]], Mapping[str, Any]] = lambda _: {}
    #: Another analysis whose models this analysis works with, so that systems need no model for it.
    uses: str = ""
    #: The option that limits an iteration: a larger value may help a point that has not converged.
    patience: str = ""
    #: What may decide an undecided verdict, with options in braces.
    undecided: str = ""

    def __post_init__(self) -> None:
        known = [option.name for option in self.options]
        for method, names in self.methods.items():
            for name in names:
                if name not in known:
                    where = f"methods[{method!r}] of analysis {self.name}"
                    raise InputError(f"{where}: {name!r} is not an option{nearest(name, known)}")

    def advice(self, request: Request) -> str:
        """Advice on an undecided verdict, as text; empty without one."""
        return self.undecided.format(**request.options)

    def remedy(self, request: Request) -> str:
        """The option that may help a point that has not converged, as text; empty without one."""
        value = request.options.get(self.patience)
        return "" if value is None else f"a larger {self.patience} than {value} may help"

    def for_system(self, system: type[System]) -> Analysis:
        """The analysis of ``system``, with the fields that it declares."""
        return _for_system(self, system)

    def model(self, system: type[System]) -> Model:
        """The model of ``system`` for the analysis; ``KeyError`` if there is none."""
        return system.models[self.uses or self.name]

    def variable(self, name: str) -> Variable:
        """The result called ``name``; ``KeyError`` if there is none."""
        return {v.name: v for v in self.variables}[name]


# Cached, because kernels are cached by the identity of the analysis.
@lru_cache(maxsize=256)
def _for_system(analysis: Analysis, system: type[System]) -> Analysis:
    declared = analysis.of_system(system)
    return replace(analysis, **declared) if declared else analysis


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
        raise InputError(f"outputs = {shown(outputs)}: expected a list of names")
    lacking = analysis.lacks(system)
    names = [v.name for v in analysis.variables]
    offered = [name for name in names if name not in lacking]
    wanted = [name for name in analysis.default_outputs if name not in varies] if outputs is None else outputs
    for name in wanted:
        if name in names and name in varies:
            raise InputError(f"outputs: {name!r} varies in this scene; leave it out")
        if name not in names and name != OUTCOME.name:
            raise InputError(f"outputs: {name!r} is not a result of {analysis.name}{nearest(name, offered)}")
    # The outcome is always a result.
    wanted = [name for name in wanted if name != OUTCOME.name]
    if not wanted or len(set(wanted)) < len(wanted):
        raise InputError(f"outputs = {shown(outputs)}: expected one or more of {', '.join(offered)}, each once")
    request = Request(tuple(wanted), *_method_and_options(analysis, dict(options), lacking))
    for key, name, known in (
        ("options.method", request.method, analysis.methods),
        *(("outputs", name, names) for name in request.outputs),
    ):
        if name in lacking:
            allowed = ", ".join(other for other in known if other not in lacking)
            raise InputError(f"{key} = {name!r}: {lacking[name]}; expected {allowed}")
    return request


def dimensions_of(
    analysis: Analysis, system: type[System], request: Request, fixed: Mapping[str, Any]
) -> tuple[Dimension, ...]:
    """The dimensions of the results; :class:`InputError` if a requested result has another one."""
    dimensions = analysis.dimensions(system, request, fixed)
    known = [dimension.name for dimension in dimensions]
    # The outputs of a continuous analysis are evaluated later, from its own results.
    for name in () if analysis.continuous else request.outputs:
        for dim in analysis.variable(name).dims:
            if dim not in known:
                raise InputError(f"analysis {analysis.name}: {name} has the dimension {dim!r}{nearest(dim, known)}")
    return dimensions


def checked_solvers(
    analysis: Analysis, system: type[System], request: Request, dimensions: Sequence[Dimension]
) -> tuple[Solver, ...]:
    """The solvers of ``request``. Wrong results of a solver raise :class:`InputError` when they are traced.

    Those of a continuous analysis return values from which its function is made, and are not checked.
    """
    if analysis.continuous:
        return tuple(analysis.solvers(system, request))
    path = analysis.path_axis(system, request) is not None
    sizes = {solver.name: len(solver.values) for solver in dimensions}
    solvers = analysis.solvers(system, request)
    return tuple(replace(s, solve=_CheckedSolve(analysis, request, path, sizes, s.solve)) for s in solvers)


@dataclass(frozen=True, eq=False)
class _CheckedSolve:
    """``solve`` of a solver, which returns the requested results and no others; ``sizes`` with 0 are unknown."""

    analysis: Analysis
    request: Request
    path: bool
    sizes: Mapping[str, int]
    solve: Callable[[Mapping[str, Any], Array], dict[str, Array]]

    def __call__(self, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        results = self.solve(values, effort)
        wanted = {v.name: v for v in (*(self.analysis.variable(name) for name in self.request.outputs), OUTCOME)}
        for name in (name for name in wanted if name not in results):
            solved = f"solve returned {', '.join(results)}, not {name}"
            raise InputError(f"analysis {self.analysis.name}: {solved}; expected {', '.join(wanted)}")
        return {name: self._checked(variable, jnp.asarray(results[name])) for name, variable in wanted.items()}

    def _checked(self, variable: Variable, array: Array) -> Array:
        dims = [*(["path"] if self.path else []), *variable.dims]
        sizes = [self.sizes.get(dim, 0) for dim in dims]
        fits = all(size in {0, length} for size, length in zip(sizes, array.shape, strict=False))
        if not fits or array.ndim - len(dims) not in {0, 1}:
            text = ", ".join([*(f"{dim} = {n}" if n else dim for dim, n in zip(dims, sizes, strict=True)), "lanes"])
            shape = f"{variable.name} has the shape {array.shape}; expected ({text})"
            raise InputError(f"analysis {self.analysis.name}: {shape}")
        return array


def _method_and_options(
    analysis: Analysis, options: dict[str, Any], lacking: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    methods = [name for name in analysis.methods if name not in lacking]
    method = options.pop("method", next(iter(analysis.methods)))
    if isinstance(method, str):
        method = analysis.aliases.get(method, method)
    if not isinstance(method, str) or method not in analysis.methods:
        raise InputError(f"options.method = {shown(method)}: unknown{nearest(str(method), methods)}")
    used = analysis.methods[method]
    for key, value in options.items():
        if key not in used:
            others = [name for name in methods if key in analysis.methods[name]]
            guess = f", but by {', '.join(others)}" if others else did_you_mean(key, ("method", *used))
            allowed = f"expected {', '.join(('method', *used))}"
            raise InputError(f"options.{key} = {shown(value)}: not used by method {method}{guess}; {allowed}")
    return method, {o.name: _option(o, options) for o in analysis.options if o.name in used}


def _option(option: Parameter, options: Mapping[str, Any]) -> Any:
    if option.name in options:
        return checked(option, options[option.name], "options.")
    if option.default is None and not option.derived:
        raise InputError(f"options.{option.name}: missing; expected {option.allowed}")
    return option.default


def checked(parameter: Parameter, value: Any, where: str) -> Any:
    """``value`` in its stored type, or :class:`InputError`; ``where`` is its table of the scene."""
    try:
        return parameter.check(value)
    except ValueError as error:
        raise InputError(f"{where}{error}") from None
    except OverflowError:
        raise InputError(f"{where}{parameter.name} = {shown(value)}: expected {parameter.allowed}") from None
