"""Lyapunov spectra by the variational equations, with error estimates and a verdict.

The exponents of an equilibrium or a periodic motion are those of its orbit (:mod:`~drivetrain_jax.analysis.lyapunov.orbit`),
the others are averages. They are natural logarithms per second, in falling order. Phases of the flow are left out, because
their exponents are always zero. The paper's estimator is available under its own name.

The number of steps is predicted for every point (see :mod:`~drivetrain_jax.analysis.lyapunov.variational`) unless
``steps`` is given; members of a batch with similar numbers use the largest of them.

Outcome: ``SUCCESS``, or ``TOLERANCE_NOT_MET`` if the standard error exceeds the target at ``max_time`` or the steps are too
few: the exponents do not sum to the mean divergence, or a positive exponent changes with half the steps. With too few steps
the verdict is ``undecided``. The exponents of an unbounded motion are means until it leaves the bounds, without an error
(NaN). ``NOT_FINITE`` if the field is not finite at the start or a motion leaves the bounds too soon for exponents.
``STEP_LIMIT`` if a strobe is predicted to need more than 1e5 steps, or the run more than 2e7 for each second of ``max_time``
(at least for one second; given ``steps`` raise this limit).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import MOST_SECONDS, MOST_STEPS, Analysis, Outcome, Request, Solver, in_time_of
from drivetrain_jax.analysis.lyapunov.growth_record import (
    SEGMENTS,
    SETTLED,
    STANDARD_ERRORS,
    SUM_RULE,
    Record,
    block_mean,
    mean_growth,
    record_growth,
    resolved,
    running_mean,
    significant,
    weighted_mean,
    zero_floor,
)
from drivetrain_jax.analysis.lyapunov.orbit import common_period, may_be_chaotic, may_rest
from drivetrain_jax.analysis.lyapunov.section_measures import SAMPLES, paper_estimator, sample
from drivetrain_jax.analysis.lyapunov.variational import (
    LEAST,
    MOST,
    batch_shape,
    contraction,
    initial_state,
    needed_steps,
)
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.systems import Flow, System

# The kind of a motion, by a rule that a diffuse picture or a single number cannot satisfy.
#
# The verdict is undecided if the steps do not resolve the motion. A chaotic motion meets all of these conditions: it is
# bounded, its field can be chaotic, the largest exponent exceeds three standard errors and agrees for two step sizes, the
# exponents sum to the mean divergence, and the 0-1 test gives K > 0.9. Exponents of phases are ignored.

CHAOTIC_K = 0.9
# Least logarithmic growth that counts as exponential, over the averaged three quarters of the time: twice that of growth in
# proportion to time, as at a double multiplier, which is a factor of four.
TELLING = 2 * math.log(4)


class Verdict(IntEnum):
    """Kinds of motion. Fixed point, periodic and quasi-periodic describe the section of a forced system, whose fixed points
    have the period of the strobe, and the motion itself of an unforced system."""

    FIXED_POINT = 0
    PERIODIC = 1
    QUASI_PERIODIC = 2
    PARAMETRICALLY_UNSTABLE = 3
    CHAOTIC = 4
    UNDECIDED = 5


class Evidence(NamedTuple):
    """Input of the verdict; ``m`` exponents without phases, in falling order.

    ``spectrum``, ``error`` (m, ...): exponents and standard errors; ``coarse``, ``coarse_error`` (...): the largest exponent
    with twice the step, and its error; ``sum_residual``: residual of the sum rule; ``k01``: K of the 0-1 test;
    ``bounded``: true if the motion stays bounded; ``following``: see :func:`follows`; ``multiple``: strobes of the motion's
    orbit, 0 if none is found; ``aperiodic``: true if the clocks have no common period; ``returns``: true if the motion comes
    close to itself again and again without repeating, as on a torus; ``resolved``: see :func:`.growth_record.resolved`;
    ``roomy``: true if the field can be chaotic.
    """

    spectrum: Array
    error: Array
    coarse: Array
    coarse_error: Array
    sum_residual: Array
    k01: Array
    bounded: Array
    following: Array
    multiple: Array
    aperiodic: Array
    returns: Array
    resolved: Array
    roomy: Array


def follows(size: Array, used: Array, span: Array, largest: Array) -> Array:
    """Flags where the motion grew or shrank about as fast as its largest exponent, or stayed at rest.

    ``size`` (SEGMENTS, ...): largest component in each segment. A chaotic attractor also has a positive exponent, but its
    size does not grow. A change so small that it may be in proportion to time does not count.
    """
    index = jnp.arange(SEGMENTS).reshape(-1, *(1,) * used.ndim)
    last = jnp.maximum(used - 1, 0)
    begin, end = (jnp.sum(jnp.where(index == i, size, 0.0), axis=0) for i in (used // 4, last))
    time = (last - used // 4) * span
    ratio = jnp.log(jnp.where((begin > 0) & (end > 0), end / jnp.where(begin > 0, begin, 1.0), 1.0))
    at_rest = jnp.max(size, axis=0) == 0
    predicted = largest * time
    return (at_rest | (ratio * jnp.sign(predicted) > 0.5 * abs(predicted))) & (abs(predicted) > TELLING)


def judge(evidence: Evidence, autonomous: bool) -> Array:
    """The verdict, int8 of shape (...)."""
    regular = _autonomous(evidence) if autonomous else _forced(evidence)
    regular = jnp.where(evidence.bounded, regular, Verdict.UNDECIDED)
    positive = significant(evidence.spectrum, evidence.error)
    verdict = jnp.where(positive, jnp.where(_chaotic(evidence), Verdict.CHAOTIC, Verdict.UNDECIDED), regular)
    verdict = jnp.where(_unstable(evidence), Verdict.PARAMETRICALLY_UNSTABLE, verdict)
    sound = evidence.resolved & jnp.all(jnp.isfinite(evidence.spectrum), axis=0)
    return jnp.where(sound, verdict, Verdict.UNDECIDED).astype(jnp.int8)


def _unstable(evidence: Evidence) -> Array:
    """Flags of motions that grow by a positive exponent; a torque may also drive a stable system beyond the bounds."""
    left = ~evidence.bounded & (evidence.spectrum[0] > 0)
    return left | (significant(evidence.spectrum, evidence.error) & evidence.following)


def _chaotic(evidence: Evidence) -> Array:
    """Flags where all conditions of chaos hold, for motions whose largest exponent is positive."""
    chaotic = evidence.bounded & evidence.roomy & (evidence.k01 > CHAOTIC_K)
    chaotic &= evidence.coarse > STANDARD_ERRORS * evidence.coarse_error
    return chaotic & (evidence.sum_residual <= SUM_RULE * jnp.max(jnp.abs(evidence.spectrum), axis=0))


def _forced(evidence: Evidence) -> Array:
    """Kind of an attracting motion, from its orbit, or from clocks that never repeat.

    A motion with a frequency of its own has one zero exponent. It is a torus if it also returns, which a decay slower than
    exponential does not.
    """
    zeros = _zeros(evidence)
    decays = evidence.spectrum[0] < -STANDARD_ERRORS * evidence.error[0] - zero_floor(evidence.spectrum)
    kind = jnp.where(evidence.aperiodic, Verdict.QUASI_PERIODIC, Verdict.UNDECIDED)
    kind = jnp.where(evidence.multiple > 1, Verdict.PERIODIC, kind)
    kind = jnp.where(evidence.multiple == 1, Verdict.FIXED_POINT, kind)
    torus = zeros[0] & (jnp.sum(zeros, axis=0) == 1) & evidence.returns & (evidence.k01 < 1 - CHAOTIC_K)
    kind = jnp.where(decays, kind, Verdict.UNDECIDED)
    return jnp.where(torus, Verdict.QUASI_PERIODIC, kind)


def _zeros(evidence: Evidence) -> Array:
    """Flags of exponents that are zero within their errors, (m, ...)."""
    return jnp.abs(evidence.spectrum) <= STANDARD_ERRORS * evidence.error + zero_floor(evidence.spectrum)


def _autonomous(evidence: Evidence) -> Array:
    """Kind of an unforced motion by its zero exponents: none at rest, one of a periodic motion, more of a torus.

    A plane has no torus: a motion in a plane with two zero exponents is degenerate, or drifts too slowly to decide.
    """
    zeros = _zeros(evidence)
    count = jnp.sum(zeros, axis=0)
    torus = jnp.where(evidence.roomy, Verdict.QUASI_PERIODIC, Verdict.UNDECIDED)
    kind = jnp.where(count == 0, Verdict.FIXED_POINT, jnp.where(count == 1, Verdict.PERIODIC, torus))
    sound = ~jnp.isnan(evidence.spectrum[0]) & (~zeros[0] | (evidence.k01 < 1 - CHAOTIC_K))
    return jnp.where(sound, kind, Verdict.UNDECIDED)


# Limits on the work of a run, and groups of members that need a similar number of steps.
#
# A batch marches in lockstep: every member pays for the most steps per strobe and for the most strobes of all members.
# One group for each range of steps bounds this product, so an extreme member does not multiply the work of the others.

# Most steps of a run of up to a second with predicted steps, in proportion for a longer one: half a minute on one core. The
# paper's scenes take 1e6 steps in 4 s, and the driveshaft at 10 Hz takes 3e6.
MOST_WORK = 2e7
# Upper limits of the steps per strobe of each group.
_GROUPS = (200, 1000, 5000, 25_000, MOST)


def starts(flow: Flow) -> Array:
    """Flags where the period, the state and the field are finite at the start, shape (...)."""
    y = initial_state(flow)
    values = (flow.period, *y, *flow.field(flow.angles(0, 0.0), y))
    return jnp.broadcast_to(reduce(jnp.logical_and, map(jnp.isfinite, map(jnp.asarray, values))), batch_shape(flow))


def is_short_enough(steps: Any, strobes: Any, following: int, request: Request) -> Any:
    """Flags where ``strobes`` in ``max_time`` and the ``following`` ones are within the limits of work.

    The limit grows with given ``steps``, because the user asked for them.
    """
    steps_asked, longest = request.options["steps"], request.options["max_time"]
    most = MOST_WORK * max(1.0, longest) * max(1.0, (steps_asked or LEAST) / LEAST)
    within = (steps * strobes <= MOST_STEPS) & (steps * (strobes + SEGMENTS + following) <= most)
    return within if steps_asked else within & (steps <= MOST)


def by_groups(
    flow: Flow,
    request: Request,
    following: int,
    march: Callable[[Any, Array], dict[str, Array]],
    blank: Mapping[str, Any],
) -> dict[str, Array]:
    """Results of ``march(steps, members)`` of each group, merged; those of members without a march are ``blank`` or NaN.

    The outcome is ``NOT_FINITE`` without a start.
    """
    steps_asked = request.options["steps"]
    # One trace for the shapes and the results.
    march = jax.jit(march, static_argnums=0 if steps_asked else ())
    needed = jnp.full(batch_shape(flow), float(steps_asked)) if steps_asked else needed_steps(flow)
    started = starts(flow)
    able = started & is_short_enough(needed, request.options["max_time"] / jnp.asarray(flow.period), following, request)

    def empty() -> dict[str, Array]:
        shapes = jax.eval_shape(lambda: march(steps_asked or jnp.int64(LEAST), able))
        blanks = {name: jnp.full(x.shape, blank.get(name, jnp.nan), x.dtype) for name, x in shapes.items()}
        return blanks | {"outcome": jnp.where(started, blanks["outcome"], jnp.int8(Outcome.NOT_FINITE))}

    def group(results: dict[str, Array], limits: tuple[Any, Any]) -> tuple[dict[str, Array], None]:
        members = able & (needed > limits[0]) & (needed <= limits[1])
        steps = steps_asked or jnp.max(jnp.where(members, needed, LEAST)).astype(jnp.int64)

        def merged() -> dict[str, Array]:
            new = march(steps, members)
            return {name: jnp.where(members, new[name], x) for name, x in results.items()}

        return jax.lax.cond(jnp.any(members), merged, lambda: results), None

    if steps_asked or flow.fastest is None:
        return group(empty(), (0.0, jnp.inf))[0]
    limits = jnp.array([0.0, *_GROUPS[:-1]]), jnp.array(_GROUPS, float)
    return jax.lax.scan(group, empty(), limits)[0]


_ERROR = "by twice the steps on an orbit, from block means otherwise"
_KINDS = tuple(verdict.name.lower() for verdict in Verdict)
VARIABLES = (
    Variable("lyapunov_spectrum", "1/s", "Lyapunov exponent", ("exponent",)),
    Variable("lyapunov_standard_error", "1/s", f"standard error of the exponent: {_ERROR}", ("exponent",)),
    Variable("lyapunov_history", "1/s", "exponent averaged up to this time", ("segment", "exponent")),
    Variable("sum_rule_residual", "1/s", "sum of the exponents minus the mean divergence"),
    Variable("paper_estimator", "1/s", "published estimate of the exponents, not a Lyapunov exponent", ("component",)),
    Variable(
        "chaos_k01", "1", "largest K of the 0-1 test: near 0 regular, near 1 chaotic; 0 if the motion is on an orbit"
    ),
    Variable("period_multiple", "1", "strobes after which the motion repeats (0: not found)", dtype="int32"),
    Variable("verdict", "1", "kind of motion by its strobes (fixed_point repeats at every one)", (), "int8", _KINDS),
)
_NEEDED = f"as many as the field needs, at least {LEAST}"
OPTIONS = (
    Parameter(
        "standard_error", "1/s", "standard error at which a run without an orbit may end", default=0.0, lower=0.0
    ),
    Parameter("max_time", "s", "longest time of a run", default=1.0, lower=0.0, upper=MOST_SECONDS, open_lower=True),
    count("steps", "integration steps per strobe", derived=_NEEDED, lower=4, upper=1e6),
)
_SECTION = {"verdict", "chaos_k01", "period_multiple"}
# Number of members whose data of one step fit into the innermost caches.
_CHUNK = 64


class Spectrum(NamedTuple):
    """Exponents in falling order and their errors, ``(m, ...)``.

    ``order`` (m, ...) is the place of each exponent in the record. ``weighted`` (...) is true where the exponents are
    weighted means.
    """

    values: Array
    errors: Array
    order: Array
    weighted: Array


def spectrum_of(record: Record) -> Spectrum:
    """Exponents after the transient. For an unbounded motion: means over the recorded time, errors NaN."""
    values, errors, weighted = mean_growth(record)
    values = jnp.where(record.bounded, values, _until_the_end(record, record.growth))
    errors = jnp.where(record.bounded, errors, jnp.nan)
    order = jnp.argsort(-values, axis=0)
    return Spectrum(*(jnp.take_along_axis(x, order, axis=0) for x in (values, errors)), order, weighted)  # pyright: ignore[reportCallIssue]


def _until_the_end(record: Record, series: Array) -> Array:
    """Mean rate of ``series`` (SEGMENTS, m, ...) over the recorded time."""
    means = running_mean(series, record.used, record.span)
    last = jnp.arange(SEGMENTS).reshape(-1, *(1,) * (series.ndim - 1)) == record.used - 1
    return jnp.where(record.used > 0, jnp.sum(jnp.where(last, means, 0.0), axis=0), jnp.nan)


def sum_rule_residual(record: Record, spectrum: Spectrum) -> Array:
    """Sum of the exponents minus the divergence, averaged in the same way; the phases add nothing to either."""
    series = record.contraction[:, None]
    plain, _ = block_mean(series, record.used, record.span)
    weighted, _ = weighted_mean(series, record.contraction_moment[:, None], record.used, record.span)
    mean = jnp.where(spectrum.weighted, weighted, plain)
    return jnp.sum(spectrum.values, axis=0) - jnp.where(record.bounded, mean, _until_the_end(record, series))[0]


def run_twice(
    flow: Flow, steps: Any, max_time: float, target: float, members: Array, to_the_end: bool
) -> tuple[Record, Record]:
    """Records of growth of the ``members`` with ``steps`` and with ``steps // 2`` per strobe (:func:`record_growth`).

    The second march is for members without an orbit whose largest exponent is positive beyond its error; the record of
    others is empty. Both marches share one compiled loop.
    """

    def one(active: Array, steps: Array) -> tuple[Array, Record]:
        record = record_growth(flow, steps, max_time, target, active, to_the_end=to_the_end)
        spectrum = spectrum_of(record)
        positive = spectrum.values[0] > STANDARD_ERRORS * spectrum.errors[0]
        return active & record.bounded & ~record.orbit.found & positive, record

    _, both = jax.lax.scan(one, members, jnp.stack([jnp.asarray(steps), jnp.maximum(steps // 2, 1)]))
    return jax.tree.map(lambda x: x[0], both), jax.tree.map(lambda x: x[1], both)


class Findings(NamedTuple):
    """Results of a run: the spectrum, the spectrum with twice the step if it was run, the residual of the sum rule, and
    a flag if the steps resolve the motion."""

    spectrum: Spectrum
    coarse: Spectrum
    residual: Array
    resolved: Array


def findings_of(fine: Record, coarse_record: Record, period: Any) -> Findings:
    """The spectra of both marches, the residual of the sum rule, and the result of their comparison.

    The exponents of a motion on an orbit are those of the orbit.
    """
    spectrum, coarse, orbit = spectrum_of(fine), spectrum_of(coarse_record), fine.orbit
    residual = sum_rule_residual(fine, spectrum)
    sound = resolved(spectrum.values, spectrum.errors, residual, period, coarse.values[0], coarse.errors[0])
    values = jnp.where(orbit.found, orbit.exponents, spectrum.values)
    errors = jnp.where(orbit.found, orbit.errors, spectrum.errors)
    residual = jnp.where(orbit.found, jnp.sum(values, axis=0) - orbit.divergence, residual)
    return Findings(spectrum._replace(values=values, errors=errors), coarse, residual, sound | orbit.found)


def _solve(system: type[System], request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    """All requested results of a batch, its axis last; ``effort`` only orders the batches."""
    return analyse(system.models["lyapunov"].build(values), request)


def analyse(flow: Flow, request: Request) -> dict[str, Array]:
    """The requested results of ``flow`` and ``outcome``, the batch as last axis."""
    blank = {"verdict": Verdict.UNDECIDED, "period_multiple": 0, "outcome": Outcome.STEP_LIMIT}
    return by_groups(flow, request, _following(request), partial(_march, flow, request), blank)


def _following(request: Request) -> int:
    """Strobes after the run."""
    return SAMPLES if _SECTION & set(request.outputs) else 0


def _march(flow: Flow, request: Request, steps: Any, members: Array) -> dict[str, Array]:
    """The requested results of the ``members`` and ``outcome``, with ``steps`` per strobe."""
    wanted, options = set(request.outputs), request.options
    max_time, target = options["max_time"], options["standard_error"]
    results: dict[str, Array] = {}
    if "paper_estimator" in wanted:
        results["paper_estimator"] = paper_estimator(flow, steps, max_time, members)
    if wanted == {"paper_estimator"}:
        finite = jnp.all(jnp.isfinite(results["paper_estimator"]), axis=0)
        return results | {"outcome": jnp.where(finite, Outcome.SUCCESS, Outcome.NOT_FINITE).astype(jnp.int8)}
    fine, coarse = run_twice(flow, steps, max_time, target, members, "lyapunov_history" in wanted)
    findings = findings_of(fine, coarse, flow.period)
    results |= _of_spectrum(fine, findings)
    if wanted & _SECTION:
        results |= _of_section(flow, steps, fine, findings, members & ("chaos_k01" in wanted))
    results["outcome"] = _outcome(fine, findings, target)
    return {name: results[name] for name in (*request.outputs, "outcome")}


def _of_section(flow: Flow, steps: Any, fine: Record, findings: Findings, wanted: Array) -> dict[str, Array]:
    """Verdict, K and period; K of motions without an orbit, if the verdict needs it or it is ``wanted``."""
    spectrum, coarse, orbit, period = findings.spectrum, findings.coarse, fine.orbit, common_period(flow, fine.state)
    decays = spectrum.values[0] < -STANDARD_ERRORS * spectrum.errors[0] - zero_floor(spectrum.values)
    needed = wanted | ~decays if flow.turns else jnp.ones_like(decays)
    k01, returns = sample(flow, steps, fine, needed & ~orbit.found)
    following = orbit.found | follows(fine.size, fine.used, fine.span, spectrum.values[0])
    resting = may_rest(flow, fine.state)
    # A rest is an orbit of any period, also of clocks that have none in common.
    multiple = jnp.where((period == 0) & decays & following & resting, 1, orbit.multiple)
    evidence = Evidence(
        spectrum.values, spectrum.errors, coarse.values[0], coarse.errors[0], jnp.abs(findings.residual), k01,
        fine.bounded, following, multiple, (period == 0) & ~resting, returns, findings.resolved,
        may_be_chaotic(flow, fine.state),
    )  # fmt: skip
    return {
        "verdict": judge(evidence, autonomous=not flow.turns),
        # The test is meaningless for a few repeating points: K is set to 0, its limit for regular motion.
        "chaos_k01": jnp.where(multiple > 0, 0.0, k01),
        "period_multiple": multiple.astype(jnp.int32),
    }


def _outcome(fine: Record, findings: Findings, target: float) -> Array:
    values, errors = findings.spectrum.values, findings.spectrum.errors
    met = findings.resolved & ((target == 0) | ~fine.bounded | (jnp.max(errors, axis=0) <= target))
    outcome = jnp.where(met, Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET)
    return jnp.where(jnp.all(jnp.isfinite(values), axis=0), outcome, Outcome.NOT_FINITE).astype(jnp.int8)


def _of_spectrum(fine: Record, findings: Findings) -> dict[str, Array]:
    spectrum = findings.spectrum
    history = running_mean(fine.growth, fine.used, fine.span)
    return {
        "lyapunov_spectrum": spectrum.values,
        "lyapunov_standard_error": spectrum.errors,
        "lyapunov_history": jnp.take_along_axis(history, spectrum.order[None], axis=1),
        "sum_rule_residual": findings.residual,
    }


def _effort(system: type[System], request: Request, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Predicted steps, shape (N,), of the run and of the strobes after it.

    A run with a target for the standard error ends early if contraction settles the motion before ``max_time``. Infinite
    above the limits of work.
    """
    options, longest = request.options, request.options["max_time"]
    rate, period, steps, started = predicted(_prediction, (system.models["lyapunov"].build,), columns)
    steps = steps if options["steps"] is None else options["steps"]
    settling = SETTLED / np.fmax(rate, SETTLED / longest) if options["standard_error"] > 0 else longest
    strobes = np.maximum(np.clip(settling, longest / 4, longest) / period, SEGMENTS)
    short = is_short_enough(steps, longest / period, _following(request), request)
    effort = np.where(short, np.ceil(steps * (strobes + _following(request))), np.inf)
    return np.where(started, effort, 1.0)


def _prediction(build: Callable[..., Flow], values: Mapping[str, Any]) -> Array:
    """Mean rate of contraction of one point at its start, its period, the number of steps, and 1 if it starts."""
    flow = build(values)
    rate = contraction(flow) / flow.size
    return jnp.stack([rate, jnp.asarray(flow.period, float), needed_steps(flow), jnp.asarray(starts(flow), float)])


def _dimensions(*_: Any) -> tuple[Dimension, ...]:
    return (
        Dimension("exponent", "number of the exponent, from the largest", ()),
        Dimension("segment", "part of max_time", tuple(range(1, SEGMENTS + 1))),
        Dimension("component", "component of the difference: state, then strobe clock", ()),
    )


def _of_system(system: type[System]) -> dict[str, Any]:
    """Variables, options and advice in the system's unit of time."""
    return {
        "variables": in_time_of(system, VARIABLES),
        "options": in_time_of(system, OPTIONS),
        "undecided": f"a longer max_time than {{max_time:g}} {system.unit_of_time()} may decide",
    }


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    solve, effort = partial(_solve, system, request), partial(_effort, system, request)
    return (Solver("tangent", solve, effort, seconds=3e-7, chunk=_CHUNK, march=True, lengthy=True),)


ANALYSIS = Analysis(
    name="lyapunov",
    title="Lyapunov spectrum",
    variables=VARIABLES,
    default_outputs=("lyapunov_spectrum", "lyapunov_standard_error", "sum_rule_residual", "verdict"),
    methods={"benettin": tuple(option.name for option in OPTIONS)},
    method_titles={"benettin": "the variational equations: multipliers of an orbit, or averages (Benettin)"},
    options=OPTIONS,
    solvers=_solvers,
    dimensions=_dimensions,
    of_system=_of_system,
)
