"""Error against run time for attractors of gear rattle, their basins, and frequency responses.

    python -m benchmarks.precision_attractors [--quick] [--out FOLDER]     # precision_attractors.csv and .png

A region is one gear pair. In the regions of attractors and basins every method finds the motion that an initial state leads
to; the error is the distance of its state at the start of a drive period from the cycle of the reference, over the range of
the cycle's displacement (rates over omega). In the regions of responses the result is the largest displacement. The
reference goes from event to event in extended precision (tests/oracles/rattle_reference.py); SciPy at 1e-13 locates its
largest displacement. The package recognises when a motion repeats. Its rivals do not: they integrate as many periods as the
damping needs to settle to their tolerance, and half as many again. Harmonic balance solves for the orbit alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import Contender, Judged
from benchmarks.precision_rattle import DIFFRAX_LANES, FREE_PLAY, TABLE1, arrays, integrating
from benchmarks.precision_study import study
from tests.oracles.rattle_reference import extended, field, scipy_events, scipy_plain

REGIONS: dict[str, dict[str, float]] = {
    "attractor, both flanks": TABLE1,
    "attractor, period 2": FREE_PLAY | {"B1": 0.2, "omega": 1.0},
    "attractor, light damping": TABLE1 | {"c": 0.02},
    "basins": TABLE1 | {"omega": 0.72},
    "response": TABLE1 | {"omega": 0.6},
}
_BASINS, _RESPONSE = "basins", "response"
_QUICK = ("attractor, both flanks", _RESPONSE)
_LANES, _CHECKED, _LONGEST_CYCLE = 64, 4, 8


def periods_to(values: Mapping[str, float], accuracy: float) -> int:
    """Drive periods until the damping alone has reduced a transient to ``accuracy``, and half as many again."""
    return math.ceil(-1.5 * math.log(accuracy) * values["omega"] / (math.pi * values["c"]))


class Cycle(NamedTuple):
    """States at the starts of drive periods, and the range of the displacement."""

    states: np.ndarray
    size: float


def starts_of(region: str, count: int) -> np.ndarray:
    """Initial states ``(count, 2)``: at rest, or random ones for basins."""
    scale = np.array([1.0, 0.6]) if region == _BASINS else np.zeros(2)
    return scale * np.random.default_rng(3).uniform(-1.0, 1.0, (count, 2))


@cache
def references(region: str) -> tuple[Cycle, ...]:
    """The cycle that each of the first initial states leads to."""
    return tuple(_cycle(REGIONS[region], *state) for state in starts_of(region, _CHECKED))


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
    found = solve_ivp(field(values), (0, end), state, "DOP853", rtol=1e-13, atol=1e-16, events=lambda _, y: y[1])
    return float(found.y_events[0][:, 0].min()), float(found.y_events[0][:, 0].max())


def error_of(region: str, states: np.ndarray, notice: str = "") -> Judged:
    """The largest error of the first ``states`` (lanes, 2)."""
    errors = []
    for state, cycle in zip(states, references(region), strict=False):
        away = np.abs(cycle.states - state) / np.array([1.0, REGIONS[region]["omega"]])
        errors.append(away.max(axis=1).min() / cycle.size)
    found = np.array(errors)
    return Judged(float(np.nanmax(found)) if np.isfinite(found).any() else math.nan, int(np.isnan(found).sum()), notice)


def response_error(region: str, found: float, notice: str = "") -> Judged:
    """The error of the largest displacement ``found``."""
    cycle = references(region)[0]
    exact = extremes(REGIONS[region], cycle.states[0])[1]
    error = abs(found - exact) / cycle.size
    return Judged(error, 0, notice) if math.isfinite(error) else Judged(math.nan, 1, notice or "nan")


def _scene(region: str, analysis: str, outputs: list[str], **options: Any) -> dict[str, Any]:
    values = REGIONS[region]
    if analysis == "frequency_response":
        omega = np.linspace(0.98, 1.0, _LANES)[::-1] * values["omega"]
        fixed = {name: value for name, value in values.items() if name != "omega"}
        axes = {"omega": {"values": sorted(omega.tolist())}}
        return {"system": "rattle", "analysis": analysis, "outputs": outputs, "axes": axes, "fixed": fixed,
                "options": options}  # fmt: skip
    columns = arrays(dict(values), _LANES) | dict(zip(("u0", "v0"), starts_of(region, _LANES).T, strict=True))
    return columns_scene("rattle", analysis, outputs, columns, options=options)


def steady_state(region: str, rtol: float) -> Contender:
    """The analysis ``steady_state``."""
    scene = _scene(region, "steady_state", ["orbit_state", "state_error"], rtol=rtol)

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        return error_of(region, results["orbit_state"], told(results["outcome"][:_CHECKED]))

    return Contender(
        "attractors", region, "package, steady_state", f"rtol={rtol:g}", _LANES, partial(engine_job, scene), judged
    )


def responses(region: str, method: str, setting: str, **options: Any) -> Contender:
    """The analysis ``frequency_response``; the last of its frequencies is that of the region."""
    outputs = ["u_max", "state_error" if method == "exact" else "residual"]
    scene = _scene(region, "frequency_response", outputs, method=method, **options)

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        residual = np.ravel(results.get("residual", np.zeros(1)))[-1]
        notice = told(results["outcome"][-1:]) or ("residual" if residual > 1e-9 * 0.08 else "")
        return response_error(region, float(np.ravel(results["u_max"])[-1]), notice)

    return Contender("attractors", region, f"package, {method}", setting, _LANES, partial(engine_job, scene), judged)


def by_scipy(region: str, events: bool, rtol: float) -> Contender:
    """DOP853 from the initial states, one after another."""
    count = _CHECKED if region == _BASINS else 1
    solver, values = scipy_events if events else scipy_plain, REGIONS[region]
    name, periods = f"scipy {'with events' if events else 'across the kinks'}", periods_to(values, rtol)

    def job() -> np.ndarray:
        return np.array([solver(values, *state, periods, rtol) for state in starts_of(region, count)])

    def judged(states: np.ndarray) -> Judged:
        if region == _RESPONSE:
            return response_error(region, extremes(values, states[0])[1])
        return error_of(region, states)

    return Contender("attractors", region, name, f"rtol={rtol:g}", count, lambda: job, judged)


def by_diffrax(region: str, events: bool, rtol: float) -> Contender:
    """diffrax from the initial states."""
    values, starts = arrays(dict(REGIONS[region]), DIFFRAX_LANES), starts_of(region, DIFFRAX_LANES)
    batch = (values, starts, rtol, float(periods_to(REGIONS[region], rtol)))
    name = f"diffrax {'with events' if events else 'across the kinks'}"

    def prepared() -> Callable[[], np.ndarray]:
        run = integrating(events)
        return lambda: np.asarray(run(*batch))

    def judged(states: np.ndarray) -> Judged:
        if region == _RESPONSE:
            return response_error(region, extremes(REGIONS[region], states[0])[1])
        return error_of(region, states)

    return Contender("attractors", region, name, f"rtol={rtol:g}", DIFFRAX_LANES, prepared, judged)


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions."""
    found = []
    for region in _QUICK if quick else REGIONS:
        if region == _RESPONSE:
            found += [responses(region, "exact", f"rtol={r:g}", rtol=r) for r in ((1e-9,) if quick else (1e-6, 1e-10))]
            counts = (15,) if quick else (15, 60)
            found += [responses(region, "harmonic_balance", f"{n} harmonics", harmonics=n) for n in counts]
        else:
            found += [steady_state(region, rtol) for rtol in ((1e-9,) if quick else (1e-6, 1e-10))]
        for rtol in (1e-10,) if quick else (1e-6, 1e-10):
            found += [by_diffrax(region, events, rtol) for events in (True, False)]
            found += [by_scipy(region, events, rtol) for events in (True, False)]
    return found, ["rivals: the time of the transient only, not of finding the largest displacement"]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_attractors", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
