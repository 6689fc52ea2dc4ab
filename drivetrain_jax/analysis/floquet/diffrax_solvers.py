"""Floquet analysis by diffrax's own solvers: equal steps for the reduced form, adaptive ones for the published equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial, reduce
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Outcome, Request, Solver
from drivetrain_jax.analysis.floquet.direct import Monodromy, Propagator, compare, unknown
from drivetrain_jax.analysis.floquet.effort import STEPS, stable_steps, steps_needed, traced_panels
from drivetrain_jax.analysis.floquet.propagator import EqualStepSize, LinearTerm, march
from drivetrain_jax.analysis.floquet.results import NEED_ERROR, results
from drivetrain_jax.analysis.numerics.lanes import Constants, lanes_last, over_lanes
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System

# Most steps over the span; usual points take up to 1e4. With equal steps, points that are predicted to need more are not
# begun, and no refinement has more.
MAX_STEPS = 200_000
# Most doublings of the steps.
_MAX_REFINEMENTS = 6
# Cancels the safety factor of `compare`: the error is the plain difference between two tolerances a decade apart.
_REDUCTION = 4.0
# Ratio of rtol to the target of the matrix: the bound of a spectral radius is up to a hundred times the bound of its
# matrix, and succeeds up to ten tolerances.
_MARGIN = 40
# Accuracy of the march that records how errors grow.
_OF_RECORDS = 1e-6

Build = Callable[[Mapping[str, Any]], FloquetModel]


def diffrax_solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    """The solver of the method ``diffrax``: in equal steps for the reduced form, adaptive for the published form.

    Implicit solvers are always adaptive, because their iteration needs the tolerance of the steps.
    """
    solver = getattr(diffrax, request.options["solver"])
    adaptive = request.options["form"] == "published" or issubclass(solver, diffrax.AbstractImplicitSolver)
    return (adaptive_steps if adaptive else equal_steps)(system, request)


def equal_steps(system: type[System], request: Request) -> tuple[Solver, ...]:
    """The reduced form in equal steps, predicted from the order of the solver and refined until two counts agree."""
    rtol, build = request.options["rtol"], system.models["floquet"].build
    solver = getattr(diffrax, request.options["solver"])()
    order = solver.order(diffrax.ODETerm(lambda t, y, args: y))
    # The prediction is fitted for order 8; a lower order needs more steps for a smaller tolerance.
    more = rtol ** (1 / 8 - 1 / order)

    def solve(values: Mapping[str, Any], steps: Array) -> dict[str, Array]:
        model = build(values)
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves(dict(values)) if not isinstance(x, str)))

        def one(point: Mapping[str, Any], steps: Array) -> Array:
            parts = [_in_equal_steps(part, solver, steps) for part in build(point).reduced.parts]
            return reduce(lambda before, after: after @ before, parts)

        def propagate(steps: Array) -> Array:
            return over_lanes(one)(values, steps)

        records = over_lanes(partial(_records, build))(values, jnp.max(traced_panels(build, values, _OF_RECORDS)))
        steps = jnp.maximum(steps, jnp.ceil(stable_steps(model.reduced)).astype(steps.dtype))
        z = _refined(model.reduced, propagate, records, jnp.minimum(steps, MAX_STEPS), shape, rtol / _MARGIN, order)
        return results(z, request.outputs, rtol, model)

    def effort(columns: Mapping[str, Any]) -> np.ndarray:
        steps = more * steps_needed(system, columns, rtol)
        return np.where(steps <= MAX_STEPS, steps, np.inf)

    def steps(values: Mapping[str, Any]) -> Array:
        count = more * jnp.ceil(STEPS * traced_panels(build, values, rtol))
        return jnp.minimum(count, MAX_STEPS).astype(jnp.int64)

    name = f"diffrax: {request.options['solver']}, equal steps"
    return (Solver(name, solve, effort, steps, seconds=1e-6, chunk=256, march=True),)


def _records(build: Build, values: Mapping[str, Any], panels: Array, natural: bool = False) -> Propagator:
    """The growth of errors in one point, whatever method makes them, by the march of ``direct``."""
    model = build(values)
    return march(model.natural if natural else model.reduced, panels).in_units_of(jnp.zeros(()))


def _refined(
    form: LinearPeriodic,
    propagate: Callable[[Array], Array],
    records: Propagator,
    steps: Array,
    shape: tuple[int, ...],
    target: float,
    order: int,
) -> Monodromy:
    """The monodromy matrix, with ``steps`` and twice as many steps until all lanes of two counts agree to ``target``.

    A lane that overflows has two doublings to recover and then no longer delays the others.
    """
    ends, determinant = form.ends(), form.log_determinant and form.log_determinant()
    propagate = jax.jit(propagate)  # traced once, not for its shapes and again for its values
    blank = records._replace(matrix=jnp.zeros_like(records.matrix))
    nothing = jax.tree.map(
        lambda x: jnp.broadcast_to(x.reshape(*x.shape, *(1,) * len(shape)), (*x.shape, *shape)), unknown(form.size)
    )

    def unfinished(state: tuple) -> Array:
        count, current, _, z = state
        finite = jnp.all(jnp.isfinite(z.matrix), axis=(0, 1))
        lagging = jnp.where(finite, count < 2 + _MAX_REFINEMENTS, count < 4) & ~z.met
        return (count < 2) | ((current <= MAX_STEPS) & jnp.any(lagging))

    def refine(state: tuple) -> tuple:
        count, current, coarse, _ = state
        fine = records._replace(matrix=propagate(current))
        z = jax.lax.cond(
            count > 0, lambda: compare(ends, determinant, coarse, fine, current, 2.0**order, target), lambda: nothing
        )
        return count + 1, 2 * current, fine, z

    start = (jnp.int32(0), jnp.maximum(-(-steps // 2), 1), blank, nothing)
    return jax.lax.while_loop(unfinished, refine, start)[-1]


def adaptive_steps(system: type[System], request: Request) -> tuple[Solver, ...]:
    """The reduced form, or the system as published over its full period in its own time, at two tolerances."""
    rtol, atol = request.options["rtol"], request.options["atol"]
    solver = getattr(diffrax, request.options["solver"])()
    needs_error, as_published = bool(NEED_ERROR & set(request.outputs)), request.options["form"] == "published"

    def solve(values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        build = system.models["floquet"].build
        model = build(values)
        form = model.natural if as_published else model.reduced

        def propagate(tolerance: float) -> tuple[Array, Array]:
            controller = diffrax.PIDController(rtol=tolerance, atol=tolerance / rtol * atol)
            return diffrax_propagator(form, solver, stepsize_controller=controller, max_steps=MAX_STEPS)

        fine, success = propagate(rtol / 10)
        coarse, success_coarse = propagate(rtol) if needs_error else (fine, success)
        determinant = form.log_determinant and form.log_determinant()
        panels = traced_panels(build, values, _OF_RECORDS) * (2 if as_published else 1)
        records = _records(build, values, panels, as_published) if needs_error else Propagator(fine, jnp.zeros(()))
        coarse, fine = (records._replace(matrix=matrix) for matrix in (coarse, fine))
        z = compare(form.ends(), determinant, coarse, fine, jnp.zeros(()), 1 + _REDUCTION, rtol)
        values_of_z = results(z, request.outputs, rtol, model)
        failed = ~(success & success_coarse)
        lost = jnp.where(has_finite_entries(form), jnp.int8(Outcome.STEP_LIMIT), jnp.int8(Outcome.NOT_FINITE))
        return values_of_z | {"outcome": jnp.where(failed, lost, values_of_z["outcome"])}

    def effort(columns: Mapping[str, Any]) -> np.ndarray:
        # Infinite where equal steps of order 8 would be five times ``MAX_STEPS``: no explicit solver gets there. An implicit
        # one may.
        steps = steps_needed(system, columns, rtol)
        return np.nan_to_num(steps) if issubclass(type(solver), diffrax.AbstractImplicitSolver) else steps

    name = f"diffrax: {request.options['solver']}, {request.options['form']}, adaptive steps"
    return (Solver(name, over_lanes(solve), effort, seconds=1e-6, chunk=256),)


def _in_equal_steps(form: LinearPeriodic, solver: diffrax.AbstractSolver, steps: Array) -> Array:
    """The propagator of one point between breakpoints by ``steps`` equal steps.

    Under ``jax.vmap`` the lanes are the last axis of a single state, which halves the time of ``solver``.
    """
    arrays, rest = eqx.partition(LinearPeriodic(form.rows, form.span, form.basis), eqx.is_array)
    if form.is_pytree:
        return lanes_last(_integrated, Constants((rest, solver)), arrays, steps)
    # Any other function may depend on unknown arrays.
    return _integrated(Constants((rest, solver)), arrays, steps)[..., 0]


def _integrated(constants: Constants, arrays: LinearPeriodic, steps: Array) -> Array:
    rest, solver = constants.tree
    form = eqx.combine(arrays, rest)
    lanes = max((np.shape(x)[-1] for x in jax.tree.leaves(arrays) if np.ndim(x)), default=1)
    start = jnp.broadcast_to(jnp.eye(form.size)[..., None], (form.size, form.size, lanes))
    # Lanes of different spans share a clock whose unit is the span.
    scaled = diffrax.ODETerm(lambda t, y, args: form.span * form.vf(form.span * t, y, args))
    solution = diffrax.diffeqsolve(
        scaled, solver, 0.0, 1.0, None, start, stepsize_controller=EqualStepSize(steps), saveat=diffrax.SaveAt(t1=True),
        adjoint=diffrax.ForwardMode(), max_steps=None, throw=False,
    )  # fmt: skip
    return solution.ys[-1]  # pyright: ignore[reportOptionalSubscript]


def has_finite_entries(form: LinearPeriodic) -> Array:
    """True if the matrix of one point is finite at 16 instants, and so is the span."""
    times = form.span * (jnp.arange(16) + 0.5) / 16
    return jnp.isfinite(form.span) & jnp.all(jnp.isfinite(jax.vmap(form.matrix)(times)))


def diffrax_propagator(
    form: LinearPeriodic, solver: diffrax.AbstractSolver, max_steps: int | None = None, **options: Any
) -> tuple[Array, Array]:
    """The propagator of one point over the span, NaN where the integration failed, and whether it succeeded."""
    matrix, success = jnp.eye(form.size), has_finite_entries(form)
    for part in form.parts:
        # Without finite entries every step would be rejected, up to the last one.
        end = jnp.where(success, part.span, 0.0)
        solution = diffrax.diffeqsolve(
            LinearTerm(part), solver, 0.0, end, None, matrix, saveat=diffrax.SaveAt(t1=True),
            adjoint=diffrax.ForwardMode(), max_steps=max_steps, throw=False, **options,
        )  # fmt: skip
        success &= solution.result == diffrax.RESULTS.successful
        matrix = solution.ys[-1]  # pyright: ignore[reportOptionalSubscript]
    return jnp.where(success, matrix, jnp.nan), success
