"""Poincare sections: the state at every strobe, 50,000 strobes and more, and measures that distinguish a curve from a
cloud.

Time is a counted strobe plus a fraction, so that the angles of the clocks do not drift. The method ``fixed`` makes equal
steps of order 8. The method ``adaptive`` shows the effect of loose tolerances: it is the pair of Dormand & Prince of orders
5 and 4 with the usual control by ``rtol`` and ``atol``.

Both methods estimate their errors. ``strobe_error`` is the error within one strobe of the section: some strobes, including
the first ones, are repeated with finer equal steps (twice as many as ``fixed``, 96 after ``adaptive``). ``section_error`` is
the accumulated error since the start: the whole motion is repeated with equal steps (a quarter as many, 48 after
``adaptive``; after ``fixed`` twice as many in doubtful cases).

Outcome: ``TOLERANCE_NOT_MET`` if ``section_error`` exceeds 1e-6 or ten times ``rtol``, or is unknown. Every long section of
a chaotic motion has this outcome, because errors grow to the size of the motion; ``strobe_error`` then shows if its strobes
are right. ``NOT_FINITE`` if the state overflowed; earlier strobes are kept. ``STEP_LIMIT`` if the adaptive method needed too
many steps within a strobe or in the mean of all strobes, also with earlier strobes kept, or if all strobes together are more
than 1e12 equal steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import MOST_STEPS, Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.history.integration import has_finite_start
from drivetrain_jax.analysis.lyapunov.growth_record import discarded, sampled
from drivetrain_jax.analysis.lyapunov.section_measures import largest_k01, period_multiple, torus_residual
from drivetrain_jax.analysis.lyapunov.variational import Frame, batch_shape, initial_state, one_kernel, strobe_map
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.systems import Flow, System

# Errors of a section: the error within one strobe, and the accumulated error over the memory of the motion.
#
# A damped motion forgets the errors of its strobes, an undamped motion accumulates them, and close to a tongue they
# grow for hundreds of strobes. Some strobes are repeated with finer equal steps, which gives the error of one strobe.
# The whole motion, discarded strobes included, is repeated once with other equal steps, which may be few. Let r be the
# ratio of the error of a strobe to the change of this strobe by the other steps. As long as both motions differ by at
# most a tenth of the section, the error of the section is at most r times their distance.
#
# The ratio r varies: steps resolve a violent start worse than the settled motion, and the start may dominate the error.
# Therefore the first strobes from the start are also repeated, and the largest ratio counts. If the error may still
# matter, or the other steps diverge although every strobe is right, the motion is repeated with more steps, and the
# distance is the error.
#
# The section of a chaotic motion differs for every number of steps: only the error of one strobe is meaningful.

# Number of repeated strobes: of the section, and from the start.
_TAKEN_AGAIN, EARLY = 8, 16
# Relative distance from the section up to which errors are proportional.
_PROPORTIONAL = 0.1
# Fraction of the largest change below which the change of a strobe is ignored, as its ratio may be that of rounding;
# fraction of the tolerance above which an estimate is repeated with more steps.
_CONSIDERABLE, _DOUBTFUL = 0.01, 0.1


class _Strobes(NamedTuple):
    """Strobes to repeat: their numbers, shape ``(K,)``, and the states at their begin and end, ``(K, n, ...)``."""

    number: np.ndarray
    begin: Array
    end: Array


class Steps(NamedTuple):
    """Equal steps per strobe: of single strobes, of the whole motion, and of the whole motion in doubtful cases.

    The third number is 0 (no repetition) or at least the first one.
    """

    strobe: int
    motion: int
    then: int = 0


def watched(flow: Flow) -> np.ndarray:
    """Components that are neither phases nor angles."""
    return np.array([i for i in range(flow.size) if i not in (*flow.phases, *flow.cyclic)] or [0])


def section_errors(
    flow: Flow, states: Array, early: Array, first: int, steps: Steps, tolerated: float
) -> tuple[Array, Array]:
    """Errors of single strobes and of the whole section ``states``, shape ``(T, n, ...)``, relative to its largest value.

    An error of a tenth or more means another section; NaN is unknown. The states follow after ``first`` strobes from the
    start; ``early`` holds the states after the first ``min(first, EARLY)`` of those strobes, by the same steps.

    Only motions whose strobe errors are within ``tolerated``, or that agree with the first march, have a second march.
    """
    size = jnp.max(jnp.abs(states[:, watched(flow)]), axis=(0, 1))
    size = jnp.where(size == 0, 1.0, size)
    strobes = _strobes(flow, states, early, first)
    # One loop over the numbers of steps, because marches are expensive to compile.
    errors, changes = jax.lax.map(lambda n: _changes(flow, strobes, n) / size, jnp.array(steps[:2]))
    strobe = jnp.max(errors[strobes.number >= first], axis=0)
    share = _share(errors, changes)
    marches = [(steps.motion, share), (steps.then, jnp.ones_like(share))][: 2 if steps.then else 1]

    def whole(error: Array, march: tuple[Array, Array]) -> tuple[Array, None]:
        count, share = march
        followed = error <= _PROPORTIONAL
        doubtful = ~(error <= _DOUBTFUL * tolerated) & (followed | (strobe <= tolerated))
        unknown = jnp.isinf(error) | doubtful

        def found() -> Array:
            start = discarded(flow, count, jnp.int64(first))
            others, _ = sampled(flow, count, start, jnp.int64(first), len(states))
            distance = jnp.max(jnp.abs(others - states)[:, watched(flow)], axis=(0, 1)) / size
            return jnp.where(unknown, jnp.where(distance <= _PROPORTIONAL, distance * share, distance), error)

        return jax.lax.cond(jnp.any(unknown), found, lambda: error), None

    counts, shares = zip(*marches, strict=True)
    error, _ = jax.lax.scan(whole, jnp.full(strobe.shape, jnp.inf), (jnp.array(counts), jnp.stack(shares)))
    return strobe, jnp.where(jnp.isfinite(error), error, jnp.nan)


def _strobes(flow: Flow, states: Array, early: Array, first: int) -> _Strobes:
    """The first strobes from the start, and some of the section."""
    start = jnp.stack(initial_state(flow))[None]
    known = jnp.concatenate([start, early, states[: EARLY - len(early)]])
    begun = np.linspace(0, len(states) - 2, _TAKEN_AGAIN).astype(int)
    return _Strobes(
        np.concatenate([np.arange(len(known) - 1), first + 1 + begun]),
        jnp.concatenate([known[:-1], states[begun]]),
        jnp.concatenate([known[1:], states[begun + 1]]),
    )


def _changes(flow: Flow, strobes: _Strobes, steps: Array) -> Array:
    """Largest change of each of the ``strobes`` when repeated with ``steps`` equal steps, shape ``(K, ...)``."""
    number = jnp.asarray(strobes.number).reshape(-1, *(1,) * (strobes.begin.ndim - 2))
    begin = Frame(tuple(jnp.moveaxis(strobes.begin, 1, 0)))
    ends = one_kernel(flow)(lambda steps, frame: strobe_map(flow, steps)(number, frame))(steps, begin).state
    return jnp.max(jnp.abs(jnp.stack(ends, axis=1) - strobes.end)[:, watched(flow)], axis=1)


def _share(errors: Array, changes: Array) -> Array:
    """Largest ratio of ``errors`` to relevant ``changes``, both ``(K, ...)``; 1 if nothing changes."""
    largest = jnp.max(jnp.where(jnp.isfinite(changes), changes, 0.0), axis=0)
    considerable = (changes > 0) & (changes >= _CONSIDERABLE * largest)
    ratio = jnp.where(considerable, errors / jnp.where(considerable, changes, 1.0), 0.0)
    return jnp.where(largest > 0, jnp.max(ratio, axis=0), 1.0)


VARIABLES = (
    Variable("section", "1", "state at the strobes", ("strobe", "state")),
    Variable("torus_residual", "1", "largest distance from a smooth curve, over the largest value", ("state",)),
    Variable("distinct_points", "1", "distinct points of the section, 0 if it does not repeat", dtype="int32"),
    Variable("chaos_k01", "1", "largest K of the 0-1 test: near 0 regular, near 1 chaotic; 0 if the section repeats"),
    Variable("strobe_error", "1", "estimated error made within one strobe, over the largest value"),
    Variable("section_error", "1", "estimated error of the section since the start, over the largest value"),
)
OPTIONS = (
    count("strobes", "points of the section", default=5000, lower=128, upper=1e7),
    count("discard", "strobes before the first point", default=5000, lower=0, upper=1e9),
    count("steps", "integration steps per strobe", default=48, lower=4, upper=1e6),
    Parameter("rtol", "1", "relative tolerance of a step", default=1e-3, lower=1e-14, upper=1e-1),
    Parameter("atol", "1", "absolute tolerance of a step", default=1e-6, lower=0.0, open_lower=True),
)
# Relative distance below which points are equal; longest period of the search.
_DISTINCT, _LONGEST = 1e-9, 8192
# Most strobes of the 0-1 test, and fewest for a motion that does not repeat: K of smooth curves of three harmonics is up to
# 0.99 with 128 strobes, 0.93 with 256 and 0.13 with 512.
_SAMPLES, _FEWEST_SAMPLES = 2000, 512
# Most steps of the adaptive method within a strobe, and in the mean of all strobes: the driveshaft at 3000 Hz needs 4
# with rtol 1e-3 and 272 with 1e-14.
_MAX_STEPS, _MEAN_STEPS = 4096, 1000
# Error above which the outcome is TOLERANCE_NOT_MET, and the steps that check the adaptive method.
_TOLERATED = 1e-6
_ADAPTIVE_CHECKS = Steps(96, 48)
# The fewest steps that show the accumulation of errors.
_FEWEST = 6
# Most numbers in the sections of a chunk, and most points of a chunk.
_NUMBERS, _CHUNK = 1 << 23, 64


def fixed_section(flow: Flow, request: Request) -> tuple[Array, Array, Array]:
    """States at the strobes by equal steps, shape ``(strobes, n, ...)``, states at the first discarded strobes, and the
    outcome."""
    steps, first = request.options["steps"], request.options["discard"]
    early, _ = sampled(flow, steps, initial_state(flow), jnp.int64(0), min(EARLY, first))
    state = discarded(flow, steps, jnp.int64(first))
    states, _ = sampled(flow, steps, state, jnp.int64(first), request.options["strobes"])
    return states, early, jnp.full(states.shape[2:], Outcome.SUCCESS, jnp.int8)


def adaptive_section(flow: Flow, request: Request) -> tuple[Array, Array, Array]:
    """As :func:`fixed_section`, of one point by the adaptive pair; every strobe is the end of a step. States after a failure
    are NaN."""
    rtol, atol, first = (request.options[name] for name in ("rtol", "atol", "discard"))
    controller = diffrax.PIDController(rtol=rtol, atol=atol)

    def advance(carry: tuple, strobe: Array) -> tuple:
        y, well, total = carry
        # In a batch the loop runs until the last lane is done: failed lanes integrate over an empty span.
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda s, y, _: flow.period * flow.vector(strobe, s, y)),
            diffrax.Dopri5(), 0.0, jnp.where(well, 1.0, 0.0), None, y,
            stepsize_controller=controller, saveat=diffrax.SaveAt(t1=True), max_steps=_MAX_STEPS, throw=False,
        )  # fmt: skip
        y = solution.ys[0]  # pyright: ignore[reportOptionalSubscript]
        total += solution.stats["num_steps"]
        well &= (solution.result == diffrax.RESULTS.successful) & (total <= most)
        return y, well, total

    def keep(carry: tuple, strobe: Array) -> tuple:
        carry = advance(carry, strobe)
        return carry, jnp.where(carry[1], carry[0], jnp.nan)

    begins, most = has_finite_start(flow), _MAX_STEPS + _MEAN_STEPS * (first + request.options["strobes"])
    start = (jnp.stack([jnp.asarray(x, float) for x in flow.start]), begins, jnp.int64(0))
    carry, early = jax.lax.scan(keep, start, jnp.arange(min(EARLY, first)))
    carry = jax.lax.fori_loop(len(early), first, lambda k, c: advance(c, k), carry)
    (_, well, _), states = jax.lax.scan(keep, carry, first + jnp.arange(request.options["strobes"]))
    failed = jnp.where(begins, Outcome.STEP_LIMIT, Outcome.NOT_FINITE)
    return states, early, jnp.where(well, Outcome.SUCCESS, failed).astype(jnp.int8)


def checking_steps(request: Request) -> Steps:
    """Steps of the march that checks a section."""
    if request.method == "adaptive":
        return _ADAPTIVE_CHECKS
    steps = request.options["steps"]
    return Steps(2 * steps, min(steps - 1, max(_FEWEST, steps // 4)), 2 * steps)


def tolerated(request: Request) -> float:
    """Largest error for the outcome ``SUCCESS``."""
    return min(_TOLERATED, 10 * request.options["rtol"]) if request.method == "adaptive" else _TOLERATED


def measures(flow: Flow, states: Array, request: Request) -> dict[str, Array]:
    """Torus residual, distinct points and K of the section ``states``, if requested."""
    results: dict[str, Array] = {}
    kept = watched(flow)
    if "torus_residual" in request.outputs:
        strobes = request.options["discard"] + 1 + jnp.arange(len(states))
        results["torus_residual"] = torus_residual(states, _angle(flow, strobes))
    if {"distinct_points", "chaos_k01"} & set(request.outputs):
        distinct = period_multiple(states[:, kept], jnp.float64(_DISTINCT), min(_LONGEST, len(states) // 2))
        results["distinct_points"] = distinct.astype(jnp.int32)
    if "chaos_k01" in request.outputs:
        last = states[-_SAMPLES:, kept]
        k01 = largest_k01(last) if len(last) >= _FEWEST_SAMPLES else jnp.nan
        k01 = jnp.where(jnp.all(jnp.isfinite(last), axis=(0, 1)), k01, jnp.nan)
        # The limit 0 if the section repeats: a short record of few points may look like diffusion.
        results["chaos_k01"] = jnp.where(distinct > 0, 0.0, k01)
    return results


def _angle(flow: Flow, strobes: Array) -> Array | None:
    """Angle of the first clock that does not define the strobe, shape ``(T, ...)``; None without one."""
    others = [i for i, turns in enumerate(flow.turns) if not isinstance(turns, int)]
    if not others:
        return None
    column = strobes.reshape(-1, *(1,) * len(batch_shape(flow)))
    angle = jnp.asarray(flow.angles(column, 0.0)[others[0]])
    return jnp.broadcast_to(angle, (len(strobes), *batch_shape(flow)))


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """All requested results, the batch (if any) as last axis; ``effort`` only orders the batches."""
    flow: Flow = system.models["poincare"].build(values)
    section = adaptive_section if request.method == "adaptive" else fixed_section
    states, early, outcome = section(flow, request)
    results = measures(flow, states, request)
    allowed = tolerated(request)
    strobe, whole = section_errors(flow, states, early, request.options["discard"], checking_steps(request), allowed)
    results |= {"strobe_error": strobe, "section_error": whole}
    missed = jnp.where(whole <= allowed, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    outcome = jnp.maximum(outcome, missed.astype(jnp.int8))
    scale = jnp.stack(
        [jnp.broadcast_to(jnp.asarray(s, float), states.shape[2:]) for s in flow.scale or (1.0,) * flow.size]
    )
    finite = jnp.all(jnp.isfinite(states), axis=(0, 1))
    # Angles up to whole turns: a section lies on the cylinder.
    cyclic = np.isin(np.arange(flow.size), flow.cyclic).reshape(-1, *(1,) * (states.ndim - 2))
    turned = jnp.where(cyclic, states - 2 * np.pi * jnp.round(states / (2 * np.pi)), states)
    results["section"] = jnp.where(jnp.isfinite(states), turned, jnp.nan) * scale
    outcome = jnp.where(finite | (outcome == Outcome.STEP_LIMIT), outcome, Outcome.NOT_FINITE).astype(jnp.int8)
    return {name: results[name] for name in request.outputs} | {"outcome": outcome}


def _effort(request: Request, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Strobes, shape (N,); infinite above the limit."""
    count = np.broadcast(*jax.tree.leaves({k: v for k, v in columns.items() if not isinstance(v, str)})).size
    strobes = request.options["strobes"] + request.options["discard"]
    # The adaptive method has its own limit.
    return np.full(count, strobes if strobes * request.options.get("steps", 1) <= MOST_STEPS else np.inf)


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    solve, effort = partial(_solve, system, request), partial(_effort, request)
    if request.method == "adaptive":
        return (Solver("adaptive", over_lanes(solve), effort, seconds=3e-5, chunk=16, march=True, lengthy=True),)
    chunk = max(1, min(_CHUNK, _NUMBERS // (2 * request.options["strobes"])))
    return (Solver("fixed", solve, effort, seconds=1e-6, chunk=chunk, march=True, lengthy=True),)


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    first, count = (request.options[name] for name in ("discard", "strobes"))
    strobes = Dimension("strobe", "number of the strobe", tuple(range(first + 1, first + count + 1)))
    state = ", then ".join(c.long_name for c in system.state) or "component of the state"
    return (strobes, Dimension("state", state, ()))


def _of_system(system: type[System]) -> dict[str, Any]:
    section = replace(VARIABLES[0], units=", ".join(c.units for c in system.state) or "1")
    return {"variables": (section, *VARIABLES[1:])}


_COMMON = ("strobes", "discard")
ANALYSIS = Analysis(
    name="poincare",
    title="Poincare section",
    variables=VARIABLES,
    default_outputs=("section",),
    methods={"fixed": (*_COMMON, "steps"), "adaptive": (*_COMMON, "rtol", "atol")},
    method_titles={
        "fixed": "equal steps of order 8",
        "adaptive": "adaptive steps of order 5, to show what a loose tolerance does",
    },
    options=OPTIONS,
    solvers=_solvers,
    dimensions=_dimensions,
    of_system=_of_system,
)
