"""Contenders on gear rattle: motions over ten drive periods, attractors, basins, and the response at a frequency. One core.

Motions: the error is that of (u, v) at the end relative to the size of the motion (amplitude, and amplitude times
omega), against the solution in extended precision, event by event (tests/oracles/rattle_reference.py). The closed form
solves 256 equal lanes at once, diffrax 8, and SciPy one after another. Regions: always in contact (easy); contact on
both flanks (typical); a separation by 5e-8 of the backlash (near-grazing); contact stiffness 1e6; damping 1e-4; chaos.

Attractors: every method finds the motion that an initial state leads to; the error is the distance of its state at the
start of a period from the cycle of the reference, over the range of its displacement (rates over omega). In the region
of the response it is that of the largest displacement. The package recognises when a motion repeats. Its rivals
integrate as many periods as the damping needs to settle to their tolerance, and half as many again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.measure import Job, Judged, Method, Study, engine_job, judged, outcomes, points_job
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.oracles.rattle_reference import extended, field, scipy_events, scipy_plain

PERIODS = 10
TABLE1 = PRESETS["table1"] | {"omega": 0.76}
FREE_PLAY = TABLE1 | {"alpha": 0.0}
_LANES, _FEW, _PAIR = 256, 8, 2
_MOST_STEPS = 100_000


def _touching(values: Mapping[str, float], depth: float) -> tuple[dict[str, float], tuple[float, float]]:
    """``values`` with the omega at which the linear motion in contact passes the flank by ``depth``, and its state."""
    mean, drive, c = values["B0"], values["B1"], values["c"]
    # (1 - w^2)^2 + c^2 w^2 = (B1/size)^2, the root above resonance.
    half = 1 - c * c / 2
    square = half + math.sqrt(half * half - 1 + (drive / (mean + depth)) ** 2)
    response = drive / (1 - square + 1j * c * math.sqrt(square))
    state = (values["b"] + mean + response.real, -math.sqrt(square) * response.imag)
    return {**values, "omega": math.sqrt(square)}, state


REGIONS: dict[str, tuple[dict[str, float], tuple[float, float]]] = {
    "easy": (FREE_PLAY | {"omega": 2.0}, (0.2145, 0.0007)),
    "typical": (TABLE1, (0.42853695, 0.22067533)),
    "near-grazing": _touching(FREE_PLAY, 5e-8 * FREE_PLAY["b"]),
    "stiff contact, k = 1e6": (FREE_PLAY | {"k": 1e6, "c": 50.0, "B1": 0.1, "omega": 100.0}, (0.17450704, 0.00104055)),
    "light damping": (TABLE1 | {"c": 1e-4}, (0.0, 0.0)),
    "chaotic": (FREE_PLAY | {"B1": 0.2, "omega": 1.171}, (0.0, 0.0)),
}


@cache
def reference(region: str) -> tuple[np.ndarray, np.ndarray]:
    """State after ten periods, and the size of its components."""
    values, state = REGIONS[region]
    ends = np.array([extended(values, *state, count)[:2] for count in (1, 4, PERIODS)])
    amplitude = max(np.abs(ends[:, 0]).max(), values["b"])
    if region == "stiff contact, k = 1e6":
        amplitude = values["B1"] / values["omega"] ** 2
    return ends[-1], amplitude * np.array([1.0, max(values["omega"], 1.0)])


def motion_error(region: str, setting: Any, states: np.ndarray) -> Judged:
    """The error of the first lane of ``states`` (lanes, 2)."""
    exact, size = reference(region)
    return judged(np.max(np.abs(states[0] - exact) / size))


def arrays(values: Mapping[str, float], lanes: int) -> dict[str, np.ndarray]:
    """The values as arrays of equal lanes."""
    return {name: np.full(lanes, values[name]) for name in TABLE1}


@cache
def marching(lanes: int) -> Callable[..., Any]:
    """The closed form, compiled for this many lanes: states (2, lanes), flags of finished lanes."""
    import jax
    import jax.numpy as jnp

    from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start

    def run(values: Any, u: Any, v: Any, periods: Any) -> tuple:
        made = prepare(Rattle.models["basins"].build(values))
        motion = march(made, start(made, u, v, periods), _MOST_STEPS)
        return jnp.stack([motion.u, motion.v]), motion.left == 0

    example = arrays(TABLE1, lanes)
    return jax.jit(run).lower(example, example["b"], example["b"], np.zeros(lanes, np.int32)).compile()


# The longest step of the solver with events over the fastest oscillation: a contact that begins and ends within one step is
# missed. Most contacts and separations of a motion.
_LONGEST_ARC, _MOST_SEGMENTS = 0.3, 4096


def integrate(model: Any, state: Any, end: Any, rtol: Any, events: bool) -> tuple[Any, Any]:
    """``(u, u')`` of one lane at the time ``end`` by diffrax from ``state`` at 0, shape ``(2,)``, and a flag of success.

    With ``events`` the field is frozen to one linear region. The solver stops at the flank of the region, found by root
    finding on the dense output, and continues in the next region. Without ``events`` the adaptive solver steps across the
    kinks, where its error estimate is wrong.
    """
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix

    solver, fastest = diffrax.Dopri8(), jnp.sqrt(model.stiffness * jnp.maximum(model.alpha, 1.0))
    longest = _LONGEST_ARC / jnp.maximum(fastest, model.omega) if events else None
    controller = diffrax.PIDController(rtol=rtol, atol=1e-3 * rtol, dtmax=longest)
    options = {"saveat": diffrax.SaveAt(t1=True), "max_steps": _MOST_STEPS, "throw": False}
    if not events:
        term = diffrax.ODETerm(lambda t, y, args: model.field(t, y))
        solution = diffrax.diffeqsolve(term, solver, 0.0, end, None, state, stepsize_controller=controller, **options)
        return solution.ys[0], solution.result == diffrax.RESULTS.successful

    def frozen(t: Any, y: Any, side: Any) -> Any:
        """The linear field of the region ``side``, continued beyond its flanks."""
        spring = jnp.where(side == 0, model.alpha * y[0], y[0] - side * (1 - model.alpha) * model.b)
        drive = model.B0 + model.B1 * jnp.cos(model.omega * t)
        return jnp.stack([y[1], drive - model.damping * y[1] - model.stiffness * spring])

    def distance(t: Any, y: Any, args: Any, upper: bool, **_: Any) -> Any:
        """Distance to the upper or the lower flank of the region ``args``, positive inside."""
        above = jnp.where(args > 0, jnp.inf, jnp.where(args == 0, model.b, -model.b) - y[0])
        below = jnp.where(args < 0, jnp.inf, y[0] - jnp.where(args == 0, -model.b, model.b))
        return jnp.minimum(above if upper else below, 1e3)

    event = diffrax.Event(
        (partial(distance, upper=True), partial(distance, upper=False)), optimistix.Newton(1e-12, 1e-12),
        direction=(False, False),
    )  # fmt: skip

    def segment(carry: tuple[Any, Any, Any, Any]) -> tuple[Any, Any, Any, Any]:
        t, y, side, count = carry
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(frozen),
            solver,
            t,
            end,
            None,
            y,
            side,
            stepsize_controller=controller,
            event=event,
            **options,
        )
        upper, lower = solution.event_mask
        there = solution.ys[0]
        moved = jnp.clip(side + jnp.where(upper, 1.0, jnp.where(lower, -1.0, 0.0)), -1.0, 1.0)
        flank = jnp.where(jnp.where(upper, moved > 0, side > 0), model.b, -model.b)
        there = there.at[0].set(jnp.where(upper | lower, flank, there[0]))
        failed = ~(solution.result == diffrax.RESULTS.successful) & ~(upper | lower)
        return jnp.where(failed, jnp.nan, solution.ts[0]), there, moved, count + 1

    side = jnp.where(state[0] > model.b, 1.0, jnp.where(state[0] < -model.b, -1.0, 0.0))
    start = (jnp.zeros_like(end), state, side, jnp.asarray(0))
    t, there, _, _ = jax.lax.while_loop(lambda carry: (carry[0] < end) & (carry[3] < _MOST_SEGMENTS), segment, start)
    return there, t >= end


@cache
def integrating(events: bool) -> Callable[..., Any]:
    """diffrax over 8 lanes, compiled once for all regions and tolerances."""
    import jax
    import jax.numpy as jnp

    def one(values: Any, state: Any, rtol: Any, periods: Any) -> Any:
        end = periods * 2 * jnp.pi / values["omega"]
        there, done = integrate(Rattle.models["basins"].build(values), state, end, rtol, events)
        return jnp.where(done, there, jnp.nan)

    batch = jax.jit(jax.vmap(one, in_axes=(0, 0, None, None)))
    return batch.lower(arrays(TABLE1, _FEW), np.zeros((_FEW, 2)), 1e-6, 1.0).compile()


def closed_form(region: str, setting: Any) -> Job:
    """The package's exact motion."""
    values, state = REGIONS[region]
    run = marching(_LANES)
    batch = (arrays(values, _LANES), *(np.full(_LANES, x) for x in state), np.full(_LANES, PERIODS, np.int32))
    return lambda: [np.asarray(part) for part in run(*batch)]


def _closed_error(region: str, setting: Any, result: Any) -> Judged:
    return motion_error(region, setting, result[0].T) if result[1][0] else Judged(math.nan, 1, "step_limit")


def by_diffrax(events: bool, region: str, rtol: float) -> Job:
    """diffrax as a careful user would set it up."""
    values, state = REGIONS[region]
    run, batch = integrating(events), (arrays(values, _FEW), np.tile(state, (_FEW, 1)), rtol, float(PERIODS))
    return lambda: np.asarray(run(*batch))


def by_scipy(solver: Callable, region: str, rtol: float) -> Job:
    """SciPy's DOP853, one lane after another."""
    values, state = REGIONS[region]
    return lambda: np.array([solver(values, *state, PERIODS, rtol) for _ in range(_PAIR)])


_TOLERANCES = (1e-4, 1e-6, 1e-9, 1e-12)
STUDY = Study(
    "rattle", tuple(REGIONS), ("typical", "near-grazing", "chaotic"),
    (
        Method("package, closed form", closed_form, _LANES, ("exact",), ("exact",), "{}", _closed_error),
        Method("diffrax with events", partial(by_diffrax, True), _FEW, _TOLERANCES, (1e-12,)),
        Method("diffrax across the kinks", partial(by_diffrax, False), _FEW, _TOLERANCES, (1e-12,)),
        Method("scipy with events", partial(by_scipy, scipy_events), _PAIR, _TOLERANCES, (1e-12,)),
        Method("scipy across the kinks", partial(by_scipy, scipy_plain), _PAIR, _TOLERANCES, (1e-12,)),
    ),
    motion_error, lambda regions: ["ten drive periods per point"],
)  # fmt: skip

BASINS, RESPONSE = "basins", "response"
LIMITS: dict[str, dict[str, float]] = {
    "attractor, both flanks": TABLE1,
    "attractor, period 2": FREE_PLAY | {"B1": 0.2, "omega": 1.0},
    "attractor, light damping": TABLE1 | {"c": 0.02},
    BASINS: TABLE1 | {"omega": 0.72},
    RESPONSE: TABLE1 | {"omega": 0.6},
}
_STATES = tuple(name for name in LIMITS if name != RESPONSE)
_MEMBERS, _CHECKED, _LONGEST_CYCLE = 64, 4, 8


def periods_to(values: Mapping[str, float], accuracy: float) -> int:
    """Drive periods until the damping alone has reduced a transient to ``accuracy``, and half as many again."""
    return math.ceil(-1.5 * math.log(accuracy) * values["omega"] / (math.pi * values["c"]))


class Cycle(NamedTuple):
    """States at the starts of drive periods, and the range of the displacement."""

    states: np.ndarray
    size: float


def starts_of(region: str, count: int) -> np.ndarray:
    """Initial states ``(count, 2)``: at rest, or random ones for basins."""
    scale = np.array([1.0, 0.6]) if region == BASINS else np.zeros(2)
    return scale * np.random.default_rng(3).uniform(-1.0, 1.0, (count, 2))


@cache
def cycles(region: str) -> tuple[Cycle, ...]:
    """The cycle that each of the first initial states leads to."""
    return tuple(_cycle(LIMITS[region], *state) for state in starts_of(region, _CHECKED))


def _cycle(values: Mapping[str, float], u: float, v: float) -> Cycle:
    u, v, _ = extended(values, u, v, periods_to(values, 1e-16))
    states = []
    for _ in range(_LONGEST_CYCLE):
        u, v, _ = extended(values, u, v, 1)
        states.append((u, v))
    low, high = extremes(values, states[0])
    return Cycle(np.array(states), high - low)


def extremes(values: Mapping[str, float], state: Sequence[float]) -> tuple[float, float]:
    """Smallest and largest displacement over the longest cycle from ``state``."""
    end = _LONGEST_CYCLE * 2 * math.pi / values["omega"]
    motion = solve_ivp(field(values), (0, end), state, "DOP853", rtol=1e-13, atol=1e-16, events=lambda _, y: y[1])
    return float(motion.y_events[0][:, 0].min()), float(motion.y_events[0][:, 0].max())


def limit_error(region: str, setting: Any, states: np.ndarray, notice: str = "") -> Judged:
    """The largest error of the first ``states`` (lanes, 2), or that of the largest displacement."""
    if region == RESPONSE:
        return response_error(extremes(LIMITS[region], states[0])[1], notice)
    errors = []
    for state, cycle in zip(states, cycles(region), strict=False):
        away = np.abs(cycle.states - state) / np.array([1.0, LIMITS[region]["omega"]])
        errors.append(away.max(axis=1).min() / cycle.size)
    known = np.isfinite(errors)
    return Judged(float(np.nanmax(errors)) if known.any() else math.nan, int(np.sum(~known)), notice)


def response_error(largest: float, notice: str) -> Judged:
    """The error of a largest displacement."""
    cycle = cycles(RESPONSE)[0]
    return judged(abs(largest - extremes(LIMITS[RESPONSE], cycle.states[0])[1]) / cycle.size, notice)


def steady_state(region: str, rtol: float) -> Job:
    """The analysis ``steady_state``."""
    columns = arrays(LIMITS[region], _MEMBERS) | dict(zip(("u0", "v0"), starts_of(region, _MEMBERS).T, strict=True))
    return points_job("rattle", "steady_state", ["orbit_state", "state_error"], columns, options={"rtol": rtol})


def response(method: str, output: str, option: str, region: str, setting: Any) -> Job:
    """The analysis ``frequency_response``; the last of its frequencies is that of the region."""
    omega = np.linspace(0.98, 1.0, _MEMBERS) * LIMITS[region]["omega"]
    return engine_job({
        "system": "rattle", "analysis": "frequency_response", "outputs": ["u_max", output],
        "axes": {"omega": {"values": omega.tolist()}},
        "fixed": {name: value for name, value in LIMITS[region].items() if name != "omega"},
        "options": {"method": method, option: setting},
    })  # fmt: skip


def _steady_error(region: str, setting: Any, result: Any) -> Judged:
    return limit_error(region, setting, result["orbit_state"], outcomes(result["outcome"][:_CHECKED]))


def _response_error(region: str, setting: Any, result: Any) -> Judged:
    residual = np.ravel(result.get("residual", np.zeros(1)))[-1]
    notice = outcomes(result["outcome"][-1:]) or ("residual" if residual > 1e-9 * 0.08 else "")
    return response_error(float(np.ravel(result["u_max"])[-1]), notice)


def _members(region: str) -> int:
    return _CHECKED if region == BASINS else 1


def settled_by_scipy(solver: Callable, region: str, rtol: float) -> Job:
    """DOP853 from the initial states, one after another."""
    values, states = LIMITS[region], starts_of(region, _members(region))
    return lambda: np.array([solver(values, *state, periods_to(values, rtol), rtol) for state in states])


def settled_by_diffrax(events: bool, region: str, rtol: float) -> Job:
    """diffrax from the initial states."""
    run, periods = integrating(events), float(periods_to(LIMITS[region], rtol))
    batch = (arrays(LIMITS[region], _FEW), starts_of(region, _FEW), rtol, periods)
    return lambda: np.asarray(run(*batch))


_TWO = (1e-6, 1e-10)
ATTRACTORS = Study(
    "attractors", tuple(LIMITS), ("attractor, both flanks", RESPONSE),
    (
        Method("package, steady_state", steady_state, _MEMBERS, _TWO, (1e-9,), error=_steady_error, regions=_STATES),
        Method("package, exact", partial(response, "exact", "state_error", "rtol"), _MEMBERS, _TWO, (1e-9,),
               error=_response_error, regions=(RESPONSE,)),
        Method("package, harmonic_balance", partial(response, "harmonic_balance", "residual", "harmonics"), _MEMBERS,
               (15, 60), (15,), "{} harmonics", _response_error, (RESPONSE,)),
        Method("diffrax with events", partial(settled_by_diffrax, True), _FEW, _TWO, (1e-10,)),
        Method("diffrax across the kinks", partial(settled_by_diffrax, False), _FEW, _TWO, (1e-10,)),
        Method("scipy with events", partial(settled_by_scipy, scipy_events), _members, _TWO, (1e-10,)),
        Method("scipy across the kinks", partial(settled_by_scipy, scipy_plain), _members, _TWO, (1e-10,)),
    ),
    limit_error, lambda regions: ["rivals: the time of the transient only, not of finding the largest displacement"],
)  # fmt: skip
