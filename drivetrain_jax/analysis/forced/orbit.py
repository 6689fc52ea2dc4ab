"""Periodic orbits of forced systems: transition over a period, Newton's method, and continuation.

All functions work on one point. Derivatives come from the variational equations, never from differentiating a solver.

Derivatives of a solution of ``y' = f(t, y; p)`` of period T by p: with s = t/T as time, the columns ``V = dy/dy0`` and
``S = dy/dp`` at fixed ``y0`` obey ``V' = T f_y V`` and ``S' = T f_y S + d(T f)/dp``. The start moves by
``dy0 = (I - V(1))^-1 S(1) dp``. At a peak the solution is stationary in time, so that its height moves by ``V dy0 + S dp``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis._base import Outcome
from drivetrain_jax.analysis.numerics.continuation import Mapped, PeriodMap, course, follow, sections
from drivetrain_jax.analysis.numerics.linear_algebra import solve
from drivetrain_jax.systems import ForcedModel

if TYPE_CHECKING:
    import diffrax

Field = Callable[[Any, Array], Array]
Parametric = Callable[[Any, Any, Array], Array]

MAX_STEPS = 65536
# Absolute tolerance over relative tolerance, for unknowns of order one. It is small, because components of one solution
# may differ by the ratio of forcing and natural frequency.
ATOL_RATIO = 1e-6
# Shortest step over period: a field that is not finite then fails at once instead of after MAX_STEPS rejections.
STEP_RATIO = 1e-10

# Size below which corrections that no longer shrink are at the limit of rounding.
STALLED = 1e-6
# Most corrections of an orbit that is known approximately, and size of the first one; each halves this limit.
MAX_POLISH, NEAR = 10, 0.1


class Transition(NamedTuple):
    """State ``end`` (n,) after a period, its derivative ``matrix`` (n, n) by the start, an ``Outcome``, and the number of
    ``steps``."""

    end: Array
    matrix: Array
    outcome: Array
    steps: Array | int = 0


class Orbit(NamedTuple):
    """Periodic orbit: ``state`` (n,) at t = 0, transition ``matrix`` (n, n) about it, its last Newton correction ``error``
    and an ``Outcome``; ``corrections`` counts the Newton steps."""

    state: Array
    matrix: Array
    error: Array
    outcome: Array
    corrections: Array


def size_of(vector: Array) -> Array:
    """Largest modulus of the entries, or 1 for the zero vector: the unit in which the vector is of order one."""
    size = jnp.max(jnp.abs(vector))
    return jnp.where(size > 0, size, 1.0)


def in_units_of(size: Array, field: Field) -> Field:
    """The field of ``y/size``."""
    return lambda t, y: field(t, size * y) / size


def variational(field: Field) -> Field:
    """The field of ``[y, V]``, shape ``(n, 1 + m)``: columns ``V`` obey the variational equations V' = (df/dy) V."""

    def lifted(t: Any, columns: Array) -> Array:
        slope, push = jax.linearize(lambda y: field(t, y), columns[:, 0])
        return jnp.concatenate([slope[:, None], jax.vmap(push, in_axes=1, out_axes=1)(columns[:, 1:])], axis=1)

    return lifted


def controller(period: float, rtol: Array | float) -> diffrax.PIDController:
    """Step-size control of all integrations here, for unknowns of order one."""
    import diffrax  # a quarter of the time in which a process that does not need it is ready

    return diffrax.PIDController(rtol=rtol, atol=ATOL_RATIO * rtol, dtmin=STEP_RATIO * period, force_dtmin=False)


def integrate(
    field: Field, start: Array, period: Array | float, rtol: Array | float, most: int = MAX_STEPS
) -> tuple[Array, Array, Array]:
    """State after one period from ``start`` at t = 0, by Dopri8 with error control, an ``Outcome``, and the number of steps,
    at most ``most``."""
    import diffrax

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: field(t, y)),
        diffrax.Dopri8(),
        0.0,
        period,
        None,
        start,
        stepsize_controller=controller(period, rtol),  # pyright: ignore[reportArgumentType]
        adjoint=diffrax.ForwardMode(),
        max_steps=most,
        throw=False,
    )
    end = solution.ys[-1]  # pyright: ignore[reportOptionalSubscript]
    limited = solution.result == diffrax.RESULTS.max_steps_reached
    failed = (solution.result != diffrax.RESULTS.successful) | ~jnp.all(jnp.isfinite(end))
    outcome = jnp.where(limited, Outcome.STEP_LIMIT, jnp.where(failed, Outcome.NOT_FINITE, Outcome.SUCCESS))
    return end, outcome, solution.stats["num_steps"]


def transition(
    field: Field, start: Array, period: Array | float, rtol: Array | float, most: int = MAX_STEPS
) -> Transition:
    """Map over one period at ``start`` (entries of order one) and its derivative, by the variational equations."""
    columns = jnp.concatenate([start[:, None], jnp.eye(start.size)], axis=1)
    end, outcome, steps = integrate(variational(field), columns, period, rtol, most)
    return Transition(end[:, 0], end[:, 1:], outcome, steps)


def newton_step(step: Transition, start: Array) -> Array:
    """Newton correction of ``start`` towards the fixed point of the map: ``(I - Z)^-1 (end - start)``."""
    return solve(jnp.eye(start.size) - step.matrix, (step.end - start)[:, None])[:, 0]


def corrected(field: Field, guess: Array, period: float, rtol: float) -> Orbit:
    """Periodic orbit near ``guess`` by Newton's method; ``NOT_CONVERGED`` if it leads nowhere or ``guess`` is NaN."""
    n = guess.size

    def running(s: Orbit) -> Array:
        near = (s.error <= NEAR * 0.5**s.corrections) & jnp.all(jnp.isfinite(s.state))
        return (s.outcome == Outcome.NOT_CONVERGED) & (s.corrections < MAX_POLISH) & near

    def correct(s: Orbit) -> Orbit:
        step = transition(field, s.state, jnp.where(running(s), period, 0.0), rtol)
        delta = newton_step(step, s.state)
        change = jnp.max(jnp.abs(delta))
        done = (step.outcome == Outcome.SUCCESS) & _settled(change / size_of(s.state), change / s.error, rtol)
        outcome = jnp.where(done, Outcome.SUCCESS, Outcome.NOT_CONVERGED)
        return Orbit(s.state + delta, step.matrix, change, outcome, s.corrections + 1)

    none = jnp.asarray(Outcome.NOT_CONVERGED)
    first = Orbit(guess, jnp.full((n, n), jnp.nan), jnp.asarray(NEAR), none, jnp.zeros((), int))
    return jax.lax.while_loop(running, correct, first)


def _settled(relative: Array, shrunk: Array, rtol: float) -> Array:
    """True after the last correction: of the size of the tolerance, or of that of rounding and no longer shrinking."""
    return (relative <= rtol) | ((relative <= STALLED) & ~(shrunk <= 0.1))


def periodic_slopes(
    field: Parametric, parameters: Any, state: Array, peaks: tuple[Array, Callable[[Any], Array]], rtol: float
) -> tuple[Array, Array]:
    """Derivatives of the periodic solution through ``state``, ``(n, P)``, and of its largest values, ``(k, P)``, by all
    ``parameters``, a pytree of P numbers.

    ``field(parameters, s, y)`` returns ``T f`` at the fraction s of the period. ``peaks`` holds the fractions of the period
    at which the products of rows with y have their largest modulus, and the function of the parameters that returns these
    rows ``(k, n)``. NaN where the integration fails.
    """
    import diffrax

    n, size = state.size, size_of(state)
    lifted, scale, known = _lifted(field, parameters, state, size)
    places, rows_at = peaks
    order = jnp.argsort(places)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lifted),
        diffrax.Dopri8(),
        0.0,
        1.0,
        None,
        jnp.concatenate([(state / size)[None], jnp.eye(n), jnp.zeros((scale.size, n))]),
        saveat=diffrax.SaveAt(t1=True, ts=jnp.clip(places[order], 0.0, 1.0)),
        stepsize_controller=controller(1.0, rtol),
        adjoint=diffrax.ForwardMode(),
        max_steps=MAX_STEPS,
        throw=False,
    )
    values = jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys, jnp.nan)  # pyright: ignore[reportArgumentType]
    on_peaks, end = values[:-1][jnp.argsort(order)], values[-1]
    moved = jnp.where(known, solve(jnp.eye(n) - end[1 : n + 1].T, end[n + 1 :].T), jnp.nan)
    by_parameter = jnp.stack(jax.tree.leaves(jax.jacfwd(rows_at)(parameters)), axis=-1) * scale
    tops = [
        jnp.sign(row @ y[0]) * (row @ (y[1 : n + 1].T @ moved + y[n + 1 :].T) + y[0] @ slope)
        for y, row, slope in zip(on_peaks, rows_at(parameters), by_parameter, strict=True)
    ]
    return size * moved / scale, size * jnp.array(tops).reshape(-1, scale.size) / scale


def _lifted(field: Parametric, parameters: Any, state: Array, size: Array) -> tuple[Callable[..., Array], Array, Array]:
    """The field of the rows ``y/size``, V and S, ``(1 + n + P, n)``; the unit of every parameter, ``(P,)``; and flags of
    those by which the field has a derivative, the only ones whose rows move."""
    leaves, tree = jax.tree.flatten(parameters)
    point, n = jnp.stack(leaves), state.size
    # Relative changes of the parameters keep all rows of similar size.
    scale = jnp.where(point == 0, 1.0, jnp.abs(point))

    def right(s: Any, y: Array, change: Array) -> Array:
        moved = jax.tree.unflatten(tree, list(point + scale * change))
        return field(moved, s, size * y) / size

    # NaN in one row would end the integration of all.
    known = jnp.all(jnp.isfinite(jax.jacfwd(right, 2)(0.0, state / size, jnp.zeros(point.size))), axis=0)
    directions = jnp.concatenate([jnp.zeros((n, point.size)), jnp.diag(known.astype(float))])

    def lifted(s: Any, rows: Array, _: None) -> Array:
        slope, push = jax.linearize(lambda y, change: right(s, y, change), rows[0], jnp.zeros(point.size))
        return jnp.concatenate([slope[None], jax.vmap(push)(rows[1:], directions)])

    return lifted, scale, known


# Approximate orbits by continuation, which Newton's method then corrects.


# Most steps of a search, tolerance of its integrations, and last correction of its points. All are coarse.
_ATTEMPTS, _RTOL, _CONVERGED = 60, 1e-5, 1e-3
# Along growing forcing: longest step, and most steps of an integration. Small orbits are nearly proportional to the forcing.
_WHOLE, _MOST = 0.5, 4096
# Along the speed: ratio of speeds over which the search runs, orbits kept of each direction, longest step, and most steps of
# an integration: far from any orbit of interest a state may oscillate without limit.
REACH, _EACH, _LONGEST, _STEPS = 1.3, 3, 0.1, 256
# Most orbits that a point compares: from the path of growing forcing, and from both directions of the search.
MOST = 1 + 2 * _EACH


def period_map(field: Field, rtol: float, most: int) -> PeriodMap:
    """The map of lanes ``x = (y, p)`` over a period, with ``field(s, x)`` at the fraction s of it.

    NaN if the integration fails or needs more than ``most`` steps.
    """

    def one(x: Array) -> Mapped:
        n = x.size - 1
        # Lanes that have ended are NaN: they integrate over an empty span.
        span = jnp.where(jnp.all(jnp.isfinite(x)), 1.0, 0.0)
        step = transition(lambda s, x: jnp.append(field(s, x), 0.0), x, span, rtol, most)
        end = jnp.where(step.outcome == Outcome.SUCCESS, step.end[:n], jnp.nan)
        return Mapped(end, step.matrix[:n, :n], step.matrix[:n, n], jnp.asarray(step.steps, float))

    return jax.vmap(one, 1, -1)


def _guesses(lanes_map: PeriodMap, x: Array, scale: Array, at: Array, count: int, **search: Any) -> Array:
    """Up to ``count`` approximate orbits at the parameter ``at`` on each branch from ``x``, ``(count, n, N)``, NaN if
    missing; ``search``: further arguments of :func:`follow`."""
    branch = follow(lanes_map, x, scale, attempts=_ATTEMPTS, converged=_CONVERGED, special=False, **search)
    guess, exists, _ = sections(course(branch.x, scale), at, count)
    return jnp.where(exists[:, None], guess, jnp.nan)[:, :-1]


def along_forcing(field: Field, period: float, n: int) -> Array:
    """Approximate orbit of ``y' = field(t, y)`` on the path from rest along growing forcing, ``(n,)``; NaN if there is none.

    The orbits of ``y' = field(t, y) - (1 - lambda) field(t, 0)`` form a path (y, lambda) that starts at (0, 0). The
    continuation runs through folds until lambda = 1. An orbit that is not on this path is not found. States should be of
    order one.
    """

    def forced(s: Any, x: Array) -> Array:
        return period * (field(period * s, x[:n]) - (1 - x[n]) * field(period * s, jnp.zeros(n)))

    search: dict[str, Any] = {"direction": jnp.ones(1), "longest": _WHOLE, "limits": (0.0, 1.0)}
    rest, unit = jnp.zeros((n + 1, 1)), jnp.ones((n + 1, 1))
    guess = _guesses(period_map(forced, _RTOL, _MOST), rest, unit, jnp.ones(()), 1, **search)
    # Newton's method gives the derivatives of the orbit.
    return jax.lax.stop_gradient(guess[0, :, 0])


def speed_map(model_at: Callable[[Any], ForcedModel], rtol: float, most: int) -> PeriodMap:
    """The map of lanes ``x = (y, speed)`` over a period; see :func:`period_map`."""

    def moving(s: Any, x: Array) -> Array:
        model = model_at(x[-1])
        return model.period * model.field(model.period * s, x[:-1])

    return period_map(moving, rtol, most)


def neighbours(model_at: Callable[[Any], ForcedModel], speed: Array, n: int) -> Array:
    """Approximate orbits at ``speed`` on branches from a lower and from a higher speed, ``(MOST - 1, n)``, NaN if missing.

    Both branches begin at the orbit to which Newton's method leads from rest, 1.3 times below and above the speed, and run
    through folds to the other end of this range.
    """
    far = speed * jnp.array([1 / REACH, REACH])
    x = jnp.concatenate([jnp.zeros((n, 2)), far[None]])
    scale = jnp.concatenate([jnp.ones((n, 2)), jnp.full((1, 2), speed)])
    search: dict[str, Any] = {"direction": jnp.array([1.0, -1.0]), "longest": _LONGEST}
    search |= {"limits": (far[0] * (1 - 1e-9), far[1] * (1 + 1e-9))}
    guess = _guesses(speed_map(model_at, _RTOL, _STEPS), x, scale, speed, _EACH, **search)
    return guess.transpose(0, 2, 1).reshape(-1, n)
