"""The analyses as pure functions, such as ``floquet(shaft)``, under ``jax.jit``, ``jax.vmap`` and ``jax.grad``, too.

A function takes one system, whose numbers may be traced, and returns a :class:`Result`, a pytree of the requested variables
and ``outcome``. Concrete numbers are solved by the cheapest solver, as in a scene, traced numbers by the first one. Under
``jax.vmap`` the kernels of a sweep solve all lanes, lanes of similar effort together. Derivatives are forward Jacobians
contracted with the tangents, so forward and reverse mode both work. A missing derivative is NaN.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap

from drivetrain_jax import _programs
from drivetrain_jax._errors import InputError, nearest
from drivetrain_jax._quantities import NamedResults
from drivetrain_jax.analysis import OUTCOME, Analysis, Dimension, Outcome, Request, Solver, analysis_of, get_analysis
from drivetrain_jax.analysis._base import checked_solvers, dimensions_of, make_request
from drivetrain_jax.analysis.numerics.kernels import compiler_options, options_for_few
from drivetrain_jax.analysis.numerics.lanes import Constants, in_blocks, lanes_last, with_lanes
from drivetrain_jax.systems import System
from drivetrain_jax.systems._base import printed, scaled

# Lanes of similar effort that are solved together, and lanes whose program is compiled without optimisation.
_TOGETHER, _FEW = 128, 128


class Result(NamedResults, eqx.Module):
    """The variables of one analysis and ``outcome``, by attribute or by name; a pytree of arrays.

    Units and meanings: ``drivetrain list SYSTEM``.

    >>> import drivetrain_jax as dt
    >>> found = dt.modes(dt.Planetary(), outputs=["natural_frequency"])
    >>> list(found), found["natural_frequency"].shape
    (['natural_frequency', 'outcome'], (21,))
    """

    _field: ClassVar[str] = "variables"
    variables: dict[str, Array]

    def __repr__(self) -> str:
        return f"Result({', '.join(f'{name}={printed(x)}' for name, x in self.variables.items())})"


@dataclass(frozen=True)
class _Job:
    """Everything about a call except its numbers: equal jobs share one compilation.

    With ``single`` the path has one value and is not a dimension of the results.
    """

    analysis: Analysis
    system: type[System]
    request: Request
    constants: Constants
    path: bool
    single: bool
    dimensions: tuple[Dimension, ...]

    def __hash__(self) -> int:
        return hash((self.analysis.name, self.system, self.request.outputs, self.request.method, self.constants))

    @property
    def solvers(self) -> tuple[Solver, ...]:
        """All solvers that a call can choose from."""
        return checked_solvers(self.analysis, self.system, self.request, self.dimensions)

    def own_dims(self, name: str) -> int:
        """Number of dimensions that the result ``name`` has at one point."""
        return self.path + (0 if name == OUTCOME.name else len(self.analysis.variable(name).dims))


def analyse(name: str, system: System, outputs: Sequence[str] | None, options: Mapping[str, Any]) -> Result:
    """The analysis ``name`` of one ``system``; see the module's docstring."""
    job, parameters = _job(name, system, outputs, options)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(parameters)):
        values = _pure(job)(parameters)
    else:
        values = _concrete(job, parameters)
    return Result({name: x[0] for name, x in values.items()} if job.single else values)


def checked_analysis(name: str, system: Any) -> Analysis:
    """The analysis ``name`` for the class of ``system``; ``InputError`` for another object or without a model."""
    if not isinstance(system, System):
        kind = f"the class {system.__name__}" if isinstance(system, type) else f"a {type(system).__name__}"
        raise InputError(f"system: got {kind}; expected a system such as drivetrain_jax.Cardan(...)")
    return analysis_of(type(system), name)


def _job(name: str, system: System, outputs: Sequence[str] | None, options: Mapping[str, Any]) -> tuple[_Job, Any]:
    """The checked call, and its numbers as arrays."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError("jax_enable_x64 = False: expected True, by jax.config.update or within jax.enable_x64(True)")
    analysis = checked_analysis(name, system)
    model = analysis.model(type(system))
    values = {key: value for key, value in system.values.items() if key in model.parameters}
    try:
        request = make_request(type(system), analysis, [outputs] if isinstance(outputs, str) else outputs, options)
        if model.check:
            model.check(values)
        dimensions = dimensions_of(analysis, type(system), request, values)
    except ValueError as error:
        # Without a scene the names of its tables mean nothing to the caller.
        raise InputError(re.sub(r"^(fixed|options)\.", "", str(error))) from None
    along = analysis.path_axis(type(system), request)
    # Copies, because the path is told from other parameters by its identity.
    values = jax.tree.map(lambda x: x if isinstance(x, str | jax.core.Tracer) else np.array(x, float), values)
    numbers = {_named(place): x for place, x in jax.tree.leaves_with_path(values) if not isinstance(x, str)}
    if along is not None and along not in numbers:
        raise InputError(f"{along}: not a number of {system.name}{nearest(along, numbers)}")
    leaf = None if along is None else numbers[along]
    if along is not None and isinstance(leaf, jax.core.Tracer):
        raise InputError(f"{along}: a traced array; expected concrete numbers for the path that the analysis follows")
    path = None if along is None else np.atleast_1d(np.asarray(leaf, float))
    parameters = jax.tree.map(lambda x: None if isinstance(x, str) or x is leaf else jnp.asarray(x, float), values)
    if batch := next((x.shape for x in jax.tree.leaves(parameters) if x.ndim), None):
        allowed = "expected one system, or a batch under jax.vmap"
        raise InputError(f"{name}: parameters of the shape {batch}; {allowed}")
    rest = jax.tree.map(lambda x: x if isinstance(x, str) else path if x is leaf else None, values)
    single = along is not None and np.ndim(leaf) == 0  # pyright: ignore[reportArgumentType]
    return _Job(analysis, type(system), request, Constants(rest), along is not None, single, dimensions), parameters


def _named(place: Sequence[Any]) -> str:
    """The parameter, or the entry of a list such as ``planet_angle[1]``, that has this place among the values."""
    return "".join([str(place[0].key), *(f"[{key.idx}]" for key in place[1:])])


def jacobians(
    name: str,
    system: System,
    outputs: Sequence[str],
    options: Mapping[str, Any],
    results: Mapping[str, Any],
    hold: bool,
) -> tuple[list[tuple[str, int | None]], dict[str, np.ndarray]]:
    """Derivatives ``(..., P)`` of ``outputs`` of one concrete ``system`` by P numbers, names with the entry of a list.

    ``results`` hold the values of the outputs, and of those that their derivatives need. With ``hold``, values of 0 and
    infinity are fixed, which spares the parts of a model that they leave out.
    """
    needed = get_analysis(name).derivative_outputs(tuple(outputs))
    job, parameters = _job(name, system, [*dict.fromkeys((*outputs, *needed))], options)
    if hold:
        held = jax.tree.map(lambda x: float(x) if x == 0 or np.isinf(x) else None, parameters)
        free = jax.tree.map(lambda x: None if x == 0 or np.isinf(x) else x, parameters)
        job, parameters = replace(job, constants=Constants(eqx.combine(job.constants.tree, held))), free
    keys = [(str(path[0].key), path[1].idx if path[1:] else None) for path, _ in jax.tree.leaves_with_path(parameters)]
    values = {key: jnp.asarray(x)[None] if job.path else jnp.asarray(x) for key, x in results.items()}
    found = _apart(job, "derivatives")((parameters, values))
    return keys, {key: np.asarray(found[key][0] if job.path else found[key]) for key in outputs if key in found}


def _concrete(job: _Job, parameters: Any) -> dict[str, Array]:
    """The results by the solver with the least predicted cost, compiled once for all numbers."""
    columns = eqx.combine(jax.tree.map(lambda x: np.asarray(x)[None], parameters), job.constants.tree)
    efforts = [float(np.max(np.asarray(solver.effort(columns), float))) for solver in job.solvers]
    costs = [effort * solver.unit_cost for effort, solver in zip(efforts, job.solvers, strict=True)]
    index = int(np.argmin(costs))
    if not np.isfinite(costs[index]):
        shapes = jax.eval_shape(_pure(job), parameters)
        missing = {v.name: v.missing for v in job.analysis.variables} | {OUTCOME.name: Outcome.STEP_LIMIT}
        return {name: jnp.full(x.shape, missing[name], x.dtype) for name, x in shapes.items()}
    return _compiled(job, index)(parameters, np.int64(np.ceil(efforts[index])))


@lru_cache(maxsize=64)
def _compiled(job: _Job, index: int) -> Callable[..., dict[str, Array]]:
    _programs.enable()
    return _program(job, partial(_solve, job, index), f"solver {index}", 1)


def _program(job: _Job, function: Callable[..., Any], name: str, lanes: int) -> Callable[..., Any]:
    """``function`` of concrete values of ``lanes`` points, compiled once, and stored on disk for later processes."""
    solver = job.solvers[0]
    options = compiler_options(lanes, march=solver.march, short_loops=solver.short_loops)
    # Without optimisation if a call takes milliseconds: a user with many calls compiles them by `jax.jit`.
    if lanes <= _FEW and not solver.lengthy:
        options = options_for_few()
    request, constants = job.request, [x.tolist() if isinstance(x, np.ndarray) else x for x in job.constants.leaves]
    content = [name, request.outputs, request.method, dict(request.options), constants, job.path, job.single]
    return _programs.Program(function, options, _programs.program_identity(job.system, job.analysis, repr(content)))


@lru_cache(maxsize=64)
def _pure(job: _Job) -> Callable[[Any], dict[str, Array]]:
    """The function of the parameters, with its derivatives."""
    _programs.enable()

    @jax.custom_jvp
    def solve(parameters: Any) -> dict[str, Array]:
        return _apart(job, "values")(parameters)

    @solve.defjvp
    def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[dict[str, Array], dict[str, Any]]:
        (parameters,), (directions,) = primals, tangents
        parameters = _once(job.analysis.name)(parameters)
        outputs = tuple(dict.fromkeys((*job.request.outputs, *job.analysis.derivative_outputs(job.request.outputs))))
        wider = job if outputs == job.request.outputs else replace(job, request=replace(job.request, outputs=outputs))
        results = _pure(wider)(parameters)
        jacobians = _apart(wider, "derivatives")((parameters, results)) if job.analysis.derivatives else {}
        kept = {name: results[name] for name in (*job.request.outputs, OUTCOME.name)}
        smooth = {name: x for name, x in kept.items() if jnp.issubdtype(x.dtype, jnp.inexact)}
        none = {name: np.zeros(x.shape, jax.dtypes.float0) for name, x in kept.items()}
        return kept, none | _tangents(smooth, dict(jacobians), jax.tree.leaves(directions))

    return solve


@cache
def _once(name: str) -> Callable[[Any], Any]:
    """The identity, whose derivative is an error: only first derivatives of the analysis ``name`` are known."""

    @jax.custom_jvp
    def same(parameters: Any) -> Any:
        return parameters

    @same.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        raise InputError(f"{name}: got a second derivative, expected a first; take differences of the gradient")

    return same


@lru_cache(maxsize=128)
def _apart(job: _Job, kind: str, batches: tuple[tuple[int, tuple[bool, ...]], ...] = ()) -> Callable[[Any], Any]:
    """The ``values``, or the ``derivatives`` of parameters and values, of a point in nested ``batches``.

    For concrete numbers, such as those of an eager ``jax.vmap`` or ``jax.grad``, it is a program of its own; for traced ones
    it is part of the caller's.
    """

    def function(arguments: Any) -> Any:
        if kind == "values":
            return _solve(job, 0, arguments)
        parameters, results = arguments
        return job.analysis.derivatives(job.system, job.request, parameters, job.constants, results)  # pyright: ignore[reportOptionalCall]

    for batch, own in batches:
        function = partial(_mapped, function, batch, own)
    inlined, lanes = custom_vmap(jax.jit(function)), math.prod(batch for batch, _ in batches)

    @inlined.def_vmap
    def _(batch: int, batched: Any, arguments: Any) -> Any:
        results = _apart(job, kind, (*batches, (batch, tuple(jax.tree.leaves(batched[0])))))(arguments)
        return results, jax.tree.map(lambda _: True, results)

    @cache
    def program() -> Callable[..., Any]:
        return _program(job, function, f"{kind} {batches}", lanes)

    def call(arguments: Any) -> Any:
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(arguments)):
            return inlined(arguments)
        return _concrete(job, arguments) if kind == "values" and not batches else program()(arguments)

    return call


def _mapped(function: Callable[[Any], Any], batch: int, batched: tuple[bool, ...], arguments: Any) -> Any:
    """``function`` of every member of a batch, in which the leaves ``batched`` of ``arguments`` have a first axis."""
    leaves, tree = jax.tree.flatten(arguments)
    axes = [0 if has_axis else None for has_axis in batched]
    return jax.vmap(lambda *x: function(jax.tree.unflatten(tree, x)), axes, axis_size=batch)(*leaves)


@jax.jit
def _tangents(results: dict[str, Array], jacobians: dict[str, Array], directions: list[Array]) -> dict[str, Array]:
    """The tangent of each result: 0 for error estimates, NaN for a result without a derivative."""
    direction = jnp.stack(directions)

    def tangent(name: str, result: Array) -> Array:
        unknown = 0.0 if name.endswith(("_error", "_residual")) else jnp.nan
        jacobian = jacobians.get(name, jnp.full((result.size, direction.size), unknown))
        jacobian = jnp.asarray(jacobian, result.dtype).reshape(result.size, direction.size)
        return jnp.sum(scaled(jacobian, direction.astype(result.dtype)), axis=1).reshape(result.shape)

    return {name: tangent(name, x) for name, x in results.items()}


def _solve(job: _Job, index: int, parameters: Any, effort: Array | None = None) -> dict[str, Array]:
    """The results of one point by solver number ``index``; without ``effort`` the effort is predicted for every lane."""
    solver = job.solvers[index]

    def of_lanes(constants: Constants, parameters: Any, effort: Array) -> dict[str, Array]:
        lanes = max((x.shape[-1] for x in jax.tree.leaves(parameters) if x.ndim), default=1)

        def solve(values: Any, effort: Array, count: int) -> dict[str, Array]:
            solved = solver.solve(eqx.combine(values, constants.tree), effort)
            return {name: with_lanes(x, job.own_dims(name), count) for name, x in solved.items()}

        if predict is None:
            return solve(parameters, effort, lanes)
        needed = jnp.broadcast_to(predict(eqx.combine(parameters, constants.tree)), lanes)
        order = jnp.argsort(needed)
        in_order = jax.tree.map(lambda x: x[order] if x.ndim else x, (parameters, needed))

        def block(part: Any, count: int) -> dict[str, Array]:
            return solve(part[0], jnp.max(part[1]), count)

        sorted_results = in_blocks(block, in_order, lanes, _TOGETHER)
        place = jnp.argsort(order)
        return {name: x[..., place] for name, x in sorted_results.items()}

    predict = solver.steps if effort is None else None
    if not jax.tree.leaves(parameters):
        return {name: x[..., 0] for name, x in of_lanes(job.constants, parameters, jnp.int64(1)).items()}
    return lanes_last(of_lanes, job.constants, parameters, jnp.int64(1) if effort is None else effort)


@dataclass(frozen=True)
class AnalysisFunction:
    """The analysis ``name`` of another package as a function, like :func:`floquet`."""

    name: str

    def __call__(self, system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
        """The :class:`Result` for one ``system``."""
        return analyse(self.name, system, outputs, options)


def floquet(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Floquet stability of the equilibrium: multipliers of ``x' = A(t) x`` over one period, spectral radius and verdict.

    Args:
        system: a system with a model for it, such as ``Cardan`` or ``Tripod``; one point, or a batch under ``jax.vmap``.
        outputs: variables wanted; default ``spectral_radius``, ``spectral_radius_error`` (absolute bound), ``verdict`` (0
            stable, 1 unstable, 2 undecided). Also ``floquet_multiplier`` (n,) with ``floquet_multiplier_error``, and
            ``floquet_exponent`` (n,) [1/s], NaN where below the error; ``liouville_residual``.
        options: ``method`` ("auto", "direct", "diffrax"), ``rtol``; see ``drivetrain list cardan``.

    Returns: a :class:`Result`. Differentiable: radius, multipliers and exponents; NaN where multipliers coalesce or tie.

    Raises: :class:`~drivetrain_jax.InputError` for options that are unknown or out of range.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.416, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(f"{dt.floquet(shaft).spectral_radius:.8f}")
    1.03193549
    """
    return analyse("floquet", system, outputs, options)


def forced(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Periodic response to the forcing: of the linear system, ``y0 = (I - Z)^-1 r``, and the nonlinear orbit.

    Args as of :func:`floquet`. Outputs: ``periodic_state`` (4,), ``amplitude`` (2,) [rad], ``condition`` (default);
    ``orbit_state``, ``orbit_amplitude``, ``orbit_spectral_radius``; of a driveline also ``torque`` and ``orbit_torque`` (N,)
    [N m]. All are differentiable.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.0, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(dt.forced(shaft).amplitude.round(4))
    [0.0115 0.0344]
    """
    return analyse("forced", system, outputs, options)


def history(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """The components of the state at ``times`` [s], or at ``num`` times from 0 to ``stop``.

    Args as of :func:`floquet`. ``Tripod``: ``phi`` [rad], ``velocity`` [rad/s]. ``Cardan``: ``theta1``, ``theta2`` and their
    rates [rad], times in rad of the shaft. ``Rattle``: ``u`` [m], ``v`` [m/s]; also
    ``acceleration``, ``event_time`` [s] and so on; method "slow_flow" gives ``amplitude`` and ``phase``. Outputs over time
    are differentiable, except by "slow_flow".

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.history(shaft, stop=1e-3, num=5).phi.shape
    (5,)
    """
    return analyse("history", system, outputs, options)


def lyapunov(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Lyapunov spectrum [1/s], falling, with its standard error, the residual of the sum rule and a verdict.

    Args as of :func:`floquet`; options ``standard_error``, ``steps``, ``max_time`` [s] (default 1; slow systems need more).
    Verdicts from 0: fixed_point, periodic, quasi_periodic, parametrically_unstable, chaotic, undecided. No derivatives.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.lyapunov(shaft, max_time=0.05).lyapunov_spectrum.shape
    (2,)
    """
    return analyse("lyapunov", system, outputs, options)


def poincare(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Poincare section: the state ``section`` (strobe, 2) at ``strobes`` periods of the excitation after ``discard`` others.

    Args as of :func:`floquet`. No derivatives.

    >>> import drivetrain_jax as dt
    >>> shaft = dt.Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> dt.poincare(shaft, strobes=128, discard=10).section.shape
    (128, 2)
    """
    return analyse("poincare", system, outputs, options)


def steady_state(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Attractor of an oscillator with play: ``u_max``, ``u_min``, ``u_rms`` [m], ``period_multiple``, ``regime``, impacts.

    Args as of :func:`floquet`. Extremes, means and multipliers of a periodic motion are differentiable; any other
    motion gives NaN.

    >>> import drivetrain_jax as dt
    >>> gears = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
    >>> print(f"{dt.steady_state(gears).u_max:.6f}")
    0.449100
    """
    return analyse("steady_state", system, outputs, options)


def frequency_response(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Response along the frequencies ``system.omega`` (L,), swept up and down: ``u_max`` (L, 2) and so on.

    ``Cardan``: branches of the forced orbit along ``system.Omega``, ``branch_amplitude`` (L, 7, 2) and so on. Args as of
    :func:`floquet`; the frequencies are concrete numbers. Options ``method`` ("exact", "harmonic_balance",
    "multiple_scales", "describing_function"). No derivatives.

    >>> import drivetrain_jax as dt, numpy as np
    >>> gears = dt.Rattle(omega=np.linspace(0.5, 0.9, 3), **dt.Rattle.presets["table1"])
    >>> dt.frequency_response(gears, method="describing_function").u_max.shape
    (3, 2)
    """
    return analyse("frequency_response", system, outputs, options)


def basins(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Shares of random initial states that lead to each attractor of an oscillator with play: ``basin_fraction`` (8,).

    Args as of :func:`floquet`; options ``samples``, ``seed``, ``reach_u`` [m], ``reach_v`` [m/s]. No derivatives.

    >>> import drivetrain_jax as dt
    >>> gears = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
    >>> dt.basins(gears, samples=16).basin_fraction.shape
    (8,)
    """
    return analyse("basins", system, outputs, options)


def critical_speeds(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Critical speeds ``n = 30 p/pi`` [rpm] of a stepped shaft, rising, each certified by a count.

    Args as of :func:`floquet`; options ``modes`` (default 6), ``method``. Outputs ``critical_speed`` (modes,),
    ``natural_frequency`` [Hz], ``angular_frequency`` [rad/s] and ``separation_margin`` are differentiable.

    >>> import drivetrain_jax as dt
    >>> print(dt.critical_speeds(dt.Bicardan(**dt.Bicardan.presets["paper"]), modes=2).critical_speed.round(1))
    [ 8373.8 27007.5]
    """
    return analyse("critical_speeds", system, outputs, options)


def whirl(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Whirl frequencies [rad/s] of a stepped shaft that turns at ``speed``, forward and backward, rising.

    Args as of :func:`floquet`; option ``modes`` (default 8). Outputs ``whirl_frequency`` (modes,), which is differentiable,
    ``whirl_direction`` (0 backward, 1 planar, 2 forward) and ``whirl_count_certified``.

    >>> import drivetrain_jax as dt
    >>> rotor = dt.Bicardan(
    ...     length=(0.4,), EI=(3e4,), rhoA=(0.0,), k_A=float("inf"), k_rot_A=float("inf"), k_D=0.0,
    ...     m_D=12.0, I_D=0.09, Ip_D=0.17, speed=200.0,
    ... )
    >>> print(dt.whirl(rotor, modes=2).whirl_frequency.round(4))
    [306.0077 344.1009]
    """
    return analyse("whirl", system, outputs, options)


def phasing(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Uneven rotation of the rigid output of a driveline, and the phases of the yokes that minimise it.

    Args as of :func:`floquet`. Outputs: ``speed_variation`` (peak to peak over the mean), ``angle_variation`` [rad],
    ``least_variation``, ``best_phase`` (joint,) [rad].

    >>> import drivetrain_jax as dt
    >>> line = {"speed": 100.0, "k": [1e4, 1e4], "c": [0.1, 0.1], "J": [0.1, 1.0]}
    >>> print(f"{dt.phasing(dt.Driveline(beta=['30 deg', '30 deg'], **line)).speed_variation:.5f}")
    0.58333
    """
    return analyse("phasing", system, outputs, options)


def modes(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Natural frequencies [Hz] of a planetary gear, rising, with the type of each mode.

    Args as of :func:`floquet`; outputs also ``dominant_family`` with ``dominant_share`` (default), ``multiplicity``,
    ``participation``, ``mode_shape``, ``kinetic_energy``. ``natural_frequency`` is
    differentiable; NaN where a parameter splits frequencies that are equal.

    >>> import drivetrain_jax as dt
    >>> print(dt.modes(dt.Planetary()).natural_frequency[1].round(2))
    727.27
    """
    return analyse("modes", system, outputs, options)


def harmonic_response(system: System, *, outputs: Sequence[str] | None = None, **options: Any) -> Result:
    """Steady vibration of a planetary gear under harmonic transmission errors and torques, over the frequency.

    Args as of :func:`floquet`; options ``stop`` [Hz] with ``start`` and ``num``, ``damping_ratio`` of all modes. Outputs
    ``amplitude`` (num, dofs) [m] (default) and ``phase`` [rad]. No derivatives.

    >>> import drivetrain_jax as dt
    >>> dt.harmonic_response(dt.Planetary(e_s=1e-6), stop=3000.0, num=101).amplitude.shape
    (101, 21)
    """
    return analyse("harmonic_response", system, outputs, options)
