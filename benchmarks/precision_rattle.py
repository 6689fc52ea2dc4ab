"""Error against run time for gear rattle: the closed form, diffrax and SciPy with and without events, harmonic balance.

    python -m benchmarks.precision_rattle [--quick] [--out FOLDER]     # precision_rattle.csv and .png

Every region is one gear pair with an initial state, integrated over ten drive periods. The error is that of (u, v) at the
end relative to the size of the motion (amplitude, and amplitude times omega), against the solution in extended precision,
event by event (tests/oracles/rattle_reference.py). The closed form solves 256 equal lanes at once, diffrax 8, and SciPy one
after another. Harmonic balance gives an orbit and no transient. Its error is the distance of its state at the start of a
period from the nearest orbit (Newton iterations on the map of one period, checked in extended precision). Its ``residual``
counts as a notice from 1e-6 of the drive on.

Regions: always in contact (easy); contact on both flanks (typical); a separation by 5e-8 of the backlash (near-grazing);
contact stiffness 1e6; damping 1e-4; chaos, where ten periods stretch errors several thousand times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from benchmarks.rattle_diffrax import integrate
from benchmarks.timing import once
from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis
from drivetrain_jax.analysis.frequency_response.harmonic_response import describe, sweep
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.oracles.rattle_reference import extended, scipy_events, scipy_plain

PERIODS = 10
TABLE1 = PRESETS["table1"] | {"omega": 0.76}
REGIONS: dict[str, tuple[dict[str, float], tuple[float, float]]] = {}
_LANES, DIFFRAX_LANES, _FEW = 256, 8, 2
_MOST_STEPS, _NOTICED = 100_000, 1e-6


def _touching(values: dict[str, float], depth: float) -> tuple[dict[str, float], tuple[float, float]]:
    """``values`` with the omega at which the linear motion in contact passes the flank by ``depth``, and its state."""
    mean, drive, c = values["B0"], values["B1"], values["c"]
    size = mean + depth
    # (1 - w^2)^2 + c^2 w^2 = (B1/size)^2, the root above resonance.
    half = 1 - c * c / 2
    square = half + math.sqrt(half * half - 1 + (drive / size) ** 2)
    response = drive / (1 - square + 1j * c * math.sqrt(square))
    state = (values["b"] + mean + response.real, -math.sqrt(square) * response.imag)
    return values | {"omega": math.sqrt(square)}, state


FREE_PLAY = TABLE1 | {"alpha": 0.0}
REGIONS |= {
    "easy": (FREE_PLAY | {"omega": 2.0}, (0.2145, 0.0007)),
    "typical": (TABLE1, (0.42853695, 0.22067533)),
    "near-grazing": _touching(FREE_PLAY, 5e-8 * FREE_PLAY["b"]),
    "stiff contact, k = 1e6": (
        FREE_PLAY | {"k": 1e6, "c": 50.0, "B1": 0.1, "omega": 100.0},
        (0.17450704, 0.00104055),
    ),
    "light damping": (TABLE1 | {"c": 1e-4}, (0.0, 0.0)),
    "chaotic": (FREE_PLAY | {"B1": 0.2, "omega": 1.171}, (0.0, 0.0)),
}
_NAMES = tuple(TABLE1)
_QUICK = ("typical", "near-grazing", "chaotic")


@cache
def reference(region: str) -> tuple[np.ndarray, np.ndarray]:
    """State after ten periods, and the size of its components."""
    values, state = REGIONS[region]
    ends = np.array([extended(values, *state, count)[:2] for count in (1, 4, PERIODS)])
    if region == "stiff contact, k = 1e6":
        amplitude = values["B1"] / values["omega"] ** 2
    else:
        amplitude = max(np.abs(ends[:, 0]).max(), values["b"])
    return ends[-1], amplitude * np.array([1.0, max(values["omega"], 1.0)])


def error_of(region: str, states: np.ndarray) -> Judged:
    """The error of the first lane of ``states`` (2, lanes)."""
    exact, size = reference(region)
    error = float(np.max(np.abs(states[:, 0] - exact) / size))
    return Judged(error) if math.isfinite(error) else Judged(math.nan, 1, "nan")


def arrays(values: dict[str, float], lanes: int) -> dict[str, np.ndarray]:
    """The values as arrays of equal lanes."""
    return {name: np.full(lanes, values[name]) for name in _NAMES}


@once
def marching(lanes: int) -> Callable[..., Any]:
    """The closed form, compiled for this many lanes: states, transition matrices (2, 2), and flags of finished lanes."""

    def run(values: dict[str, jax.Array], u: jax.Array, v: jax.Array, periods: jax.Array) -> tuple:
        made = prepare(Rattle.models["basins"].build(values))
        motion = march(made, start(made, u, v, periods), _MOST_STEPS)
        return jnp.stack([motion.u, motion.v]), jnp.stack(motion.matrix), motion.left == 0

    example = arrays(TABLE1, lanes)
    return jax.jit(run).lower(example, example["b"], example["b"], np.zeros(lanes, np.int32)).compile()


@once
def integrating(events: bool) -> Callable[..., Any]:
    """diffrax over a batch, compiled once for all regions and tolerances."""

    def one(values: dict[str, jax.Array], state: jax.Array, rtol: jax.Array, periods: jax.Array) -> jax.Array:
        end = periods * 2 * jnp.pi / values["omega"]
        found, done = integrate(Rattle.models["basins"].build(values), state, end, rtol=rtol, events=events)
        return jnp.where(done, found, jnp.nan)

    example = arrays(TABLE1, DIFFRAX_LANES)
    batch = jax.jit(jax.vmap(one, in_axes=(0, 0, None, None)))
    return batch.lower(example, np.zeros((DIFFRAX_LANES, 2)), 1e-6, 1.0).compile()


@once
def balancing(harmonics: int) -> Callable[..., Any]:
    """Harmonic balance from rest at one frequency, compiled: state at tau = 0, residual, and a flag of success."""
    basis = Basis(harmonics)

    def run(values: dict[str, jax.Array]) -> tuple:
        model = Rattle.models["basins"].build(values)
        swept = sweep(model, basis, values["omega"][None])
        x, good = swept.x[0], swept.balanced[0]
        described = describe(model, basis, x, values["omega"], good, swept.saddle[0])
        v = values["omega"] * jnp.sum(basis.orders[2::2, None] * x[2::2], axis=0)
        return jnp.stack([x[0] + jnp.sum(x[1::2], axis=0), v]), described.residual, good

    return jax.jit(run).lower(arrays(TABLE1, 1)).compile()


def nearest_orbit(values: dict[str, float], state: np.ndarray) -> np.ndarray | None:
    """The orbit of period one nearest to ``state``, by Newton iterations; None unless extended precision confirms it."""
    step, here = marching(1), np.array(state, float)
    for _ in range(12):
        there, matrix, _ = step(arrays(values, 1), here[:1], here[1:], np.ones(1, np.int32))
        there, m = np.asarray(there)[:, 0], np.asarray(matrix)[:, 0].reshape(2, 2)
        here = here + np.linalg.solve(np.eye(2) - m, there - here)
    again = np.array(extended(values, *here, 1)[:2])
    return here if np.all(np.abs(again - here) <= 1e-11 * np.abs(here).max()) else None


def closed_form(region: str) -> Contender:
    """The package's exact motion."""
    values, (u, v) = REGIONS[region]
    batch = (arrays(values, _LANES), np.full(_LANES, u), np.full(_LANES, v), np.full(_LANES, PERIODS, np.int32))

    def prepared() -> Callable[[], Any]:
        run = marching(_LANES)
        return lambda: jax.block_until_ready(run(*batch))

    def judged(found: Any) -> Judged:
        states, _, arrived = map(np.asarray, found)
        return error_of(region, states) if arrived[0] else Judged(math.nan, 1, "step_limit")

    return Contender("rattle", region, "package, closed form", "exact", _LANES, prepared, judged)


def by_diffrax(region: str, events: bool, rtol: float) -> Contender:
    """diffrax as a careful user would set it up."""
    values, state = REGIONS[region]
    batch = (arrays(values, DIFFRAX_LANES), np.tile(state, (DIFFRAX_LANES, 1)), rtol, float(PERIODS))

    def prepared() -> Callable[[], np.ndarray]:
        run = integrating(events)
        return lambda: np.asarray(run(*batch)).T

    name = "diffrax with events" if events else "diffrax across the kinks"
    return Contender("rattle", region, name, f"rtol={rtol:g}", DIFFRAX_LANES, prepared, partial(error_of, region))


def by_scipy(region: str, events: bool, rtol: float) -> Contender:
    """SciPy's DOP853, one lane after another."""
    values, state = REGIONS[region]
    solver = scipy_events if events else scipy_plain

    def job() -> np.ndarray:
        return np.array([solver(values, *state, PERIODS, rtol) for _ in range(_FEW)]).T

    name = "scipy with events" if events else "scipy across the kinks"
    return Contender("rattle", region, name, f"rtol={rtol:g}", _FEW, lambda: job, partial(error_of, region))


def by_balance(region: str, harmonics: int) -> Contender:
    """The package's harmonic balance."""
    values, _ = REGIONS[region]

    def prepared() -> Callable[[], Any]:
        run, one = balancing(harmonics), arrays(values, 1)
        return lambda: jax.block_until_ready(run(one))

    def judged(found: Any) -> Judged:
        state, residual, balanced = (np.asarray(part)[..., 0] for part in found)
        if not balanced:
            return Judged(math.nan, 1, "not_converged")
        orbit, size = nearest_orbit(values, state), reference(region)[1]
        error = math.nan if orbit is None else float(np.max(np.abs(state - orbit) / size))
        told = "residual" if residual > _NOTICED * (abs(values["B0"]) + abs(values["B1"])) else ""
        return Judged(error, int(orbit is None), told)

    name = "package, harmonic balance"
    return Contender("rattle", region, name, f"{harmonics} harmonics", 1, prepared, judged)


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions; harmonic balance where there is an orbit to find."""
    found = []
    for region in _QUICK if quick else REGIONS:
        found.append(closed_form(region))
        for rtol in (1e-12,) if quick else (1e-4, 1e-6, 1e-9, 1e-12):
            found += [by_diffrax(region, events, rtol) for events in (True, False)]
            found += [by_scipy(region, events, rtol) for events in (True, False)]
        if region != "chaotic":
            found += [by_balance(region, harmonics) for harmonics in ((15,) if quick else (3, 7, 15, 31, 63))]
    return found, ["ten drive periods per point; harmonic balance: one orbit per point"]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_rattle", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
