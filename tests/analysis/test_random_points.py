"""Bounds and verdicts at 50,000 random points of every system, against certified counts and sharper results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import mpmath
import numpy as np
import pytest

from benchmarks.measure import columns_scene, engine_job
from drivetrain_jax.analysis import Outcome
from tests.analysis.test_floquet import assert_bound_holds
from tests.oracles import ball_arithmetic
from tests.oracles.ball_arithmetic import Ball, ball
from tests.oracles.bicardan_count import frequencies_below
from tests.oracles.certified_counts import Count, gear_frequencies_below, shaft_frequencies_below
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies
from tests.oracles.rattle_reference import extended_motion

POINTS = 50_000
# Points at a time: the matrices of their balls take 100 MB.
_PART = 4096
Columns = dict[str, np.ndarray]
Below = Callable[[Ball, Columns], Count]


def decades(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Random numbers, uniform in their logarithm."""
    return np.exp(rng.uniform(math.log(low), math.log(high), count))


def random_gears(count: int, planets: int) -> Columns:
    """Masses and stiffnesses over four decades, planets at any angles."""
    rng = np.random.default_rng(planets)
    columns = {name: value * decades(rng, count, 0.01, 100.0) for name, value in TABLE_2.items()}
    columns["pressure_angle"] = rng.uniform(0.2, 0.6, count)
    return columns | {f"planet_angle[{i}]": rng.uniform(0, 2 * math.pi, count) for i in range(planets)}


def gear(columns: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the gears with their angles as a list."""
    angles = [x for name, x in columns.items() if name.startswith("planet_angle")]
    return {name: columns[name] for name in TABLE_2} | {"planet_angle": angles}


def random_shafts(count: int) -> Columns:
    """Three segments, each parameter of each segment on its own."""
    rng = np.random.default_rng(13)
    ranges = {"length": (0.05, 2.0), "EI": (1e2, 1e6), "rhoA": (0.1, 100.0)}
    columns = {f"{name}[{i}]": decades(rng, count, *ends) for name, ends in ranges.items() for i in range(3)}
    return columns | {name: decades(rng, count, 1e2, 1e10) for name in ("k_A", "k_D")}


def shaft(columns: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of the shafts with those of their segments as lists."""
    lists = {name: [columns[f"{name}[{i}]"] for i in range(3)] for name in ("length", "EI", "rhoA")}
    return lists | {name: columns[name] for name in ("k_A", "k_D")}


def rows(columns: Columns, which: Any) -> Columns:
    return {name: column[which] for name, column in columns.items()}


def outside(
    below: Below, columns: Columns, number: np.ndarray, frequency: np.ndarray, error: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flags of points whose frequency of this ``number`` (from 0) is not within ``error``, and of undecided points."""
    broken, undecided = np.zeros((2, number.size), bool)
    for begin in range(0, number.size, _PART):
        part = slice(begin, begin + _PART)
        centre, distance, own = ball(frequency[part]), ball(error[part]), rows(columns, part)
        (low, clear), (high, sure) = (below(end, own) for end in (centre - distance, centre + distance))
        undecided[part] = ~(clear & sure)
        broken[part] = clear & sure & ~((low <= number[part]) & (number[part] < high))
    return broken, undecided


def gear_recheck(columns: Columns, number: int, frequency: float, error: float) -> bool:
    """True if the frequency is not within ``error``, by eigenvalues in 50 digits."""
    exact = exact_frequencies(gear({name: float(x) for name, x in columns.items()}))[number]
    return abs(exact - frequency) > error


def shaft_recheck(columns: Columns, number: int, frequency: float, error: float) -> bool:
    """True if the frequency is not within ``error``, by a count in 250 digits."""
    one = shaft({name: float(x) for name, x in columns.items()})
    with mpmath.workdps(50):
        low, high = (frequencies_below(mpmath.mpf(frequency) + side * mpmath.mpf(error), one) for side in (-1, 1))
    return not low <= number < high


def assert_bounds_hold(below: Below, recheck: Callable[..., bool], columns: Columns, *values: np.ndarray) -> None:
    """The mode that was chosen of each point is within its error; undecided points, at most 1 %, by ``recheck``.

    ``values``: number, frequency, error.
    """
    broken, undecided = outside(below, columns, *values)
    assert np.mean(undecided) < 0.01
    for i in np.flatnonzero(undecided):
        broken[i] = recheck(rows(columns, i), *(x[i] for x in values))
    assert not broken.any(), [(rows(columns, i), *(x[i] for x in values)) for i in np.flatnonzero(broken)[:3]]
    # The comparison is sharp: a thousandth of the errors is too small for most points.
    number, frequency, error = (x[:1000] for x in values)
    broken, undecided = outside(below, rows(columns, slice(1000)), number, frequency, 1e-3 * error)
    assert np.mean(broken | undecided) > 0.5 and np.mean(broken) > 0.1


def test_balls_contain_the_exact_numbers():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-60, 60, 40), decades(rng, 40, 1e-9, 1e9)
    a, b = ball(x) / 3, ball(y) / 7
    found = (a + b, a - b, a * b, a / b, ball_arithmetic.sin(a), ball_arithmetic.cos(a), ball_arithmetic.exp(a))
    for i in range(x.size):
        with mpmath.workdps(60):
            u, v = mpmath.mpf(x[i]) / 3, mpmath.mpf(y[i]) / 7
            exact = (u + v, u - v, u * v, u / v, mpmath.sin(u), mpmath.cos(u), mpmath.exp(u), mpmath.sqrt(v))
            for own, number in zip((*found, ball_arithmetic.sqrt(b)), exact, strict=True):
                assert abs(mpmath.mpf(own.high[i]) + mpmath.mpf(own.low[i]) - number) <= own.radius[i]
                assert own.radius[i] <= 1e-28 * (abs(own.high[i]) + 20)


def test_certified_counts_rise_at_every_frequency():
    """A few gears against eigenvalues in 50 digits, a few shafts against counts in 250 digits."""
    gears, shafts = random_gears(3, 4), random_shafts(3)
    exact = np.array([exact_frequencies(gear({name: float(x[i]) for name, x in gears.items()})) for i in range(3)])
    for number, side in ((1, 1), (20, -1)):
        count, clear = gear_frequencies_below(ball(exact[:, number] * (1 + side * 1e-13)), gear(gears))
        assert clear.all() and (count == number + (side > 0)).all()
    for frequency in (1.0, 100.0, 1e4):
        count, clear = shaft_frequencies_below(ball(np.full(3, frequency)), shaft(shafts))
        own = [shaft({name: float(x[i]) for name, x in shafts.items()}) for i in range(3)]
        assert clear.all() and count.tolist() == [frequencies_below(frequency, one) for one in own]


def computed(system: str, analysis: str, outputs: list[str], columns: Columns, **fixed: Any) -> dict[str, np.ndarray]:
    found = engine_job(columns_scene(system, analysis, outputs, columns, fixed=fixed))()
    assert (found["outcome"] == Outcome.SUCCESS).all()
    return found


@pytest.mark.full
@pytest.mark.parametrize("planets", [3, 4, 5, 6])
def test_errors_of_gears_hold_at_random_points(planets):
    columns = random_gears(POINTS // 4, planets)
    outputs = ["natural_frequency", "natural_frequency_error"]
    found = computed("planetary", "modes", outputs, columns, planet_angle=[0.0] * planets)
    frequency, error = (found[name] for name in outputs)
    # Nothing holds carrier and sun in rotation: the first frequency is exactly zero.
    assert (frequency[:, 0] <= error[:, 0]).all()
    number = np.random.default_rng(1).integers(1, frequency.shape[1], len(frequency))
    frequency, error = (np.take_along_axis(x, number[:, None], 1)[:, 0] for x in (frequency, error))

    def below(end: Ball, part: Columns) -> Count:
        count, clear = gear_frequencies_below(end, gear(part))
        rest = np.flatnonzero(~clear)
        if rest.size:
            few = Ball(*(x[rest] for x in (end.high, end.low, end.radius)))
            count[rest], clear[rest] = gear_frequencies_below(few, gear(rows(part, rest)), planets_first=False)
        return count, clear

    assert_bounds_hold(below, gear_recheck, columns, number, frequency, error)


@pytest.mark.full
def test_errors_of_shafts_hold_at_random_points():
    columns = random_shafts(POINTS)
    outputs = ["angular_frequency", "relative_error", "count_certified"]
    lists = {name: [1.0] * 3 for name in ("length", "EI", "rhoA")}
    found = computed("bicardan", "critical_speeds", outputs, columns, **lists)
    assert (found["count_certified"] == 1).all()
    frequency, error = (found[name] for name in outputs[:2])
    number = np.random.default_rng(1).integers(0, frequency.shape[1], len(frequency))
    frequency, error = (np.take_along_axis(x, number[:, None], 1)[:, 0] for x in (frequency, error))

    def below(end: Ball, part: Columns) -> Count:
        return shaft_frequencies_below(end, shaft(part))

    assert_bounds_hold(below, shaft_recheck, columns, number, frequency, error * frequency)


@pytest.mark.full
@pytest.mark.parametrize("element", ["input", "output"])
def test_error_bound_of_the_tripod_holds_at_random_points(element):
    rng, count = np.random.default_rng(12), POINTS // 2
    columns = {
        "beta": rng.uniform(0.0, 1.4, count),
        "zeta": decades(rng, count, 1e-4, 1.0),
        "excitation_frequency": decades(rng, count, 100.0, 20_000.0),
        # From about 0.47 on the stiffness vanishes at an angle, and there is no equation.
        "chi_n": decades(rng, count, 1e-4, 0.4),
    }
    outputs = ["spectral_radius", "spectral_radius_error", "verdict"]
    scene = columns_scene("tripod", "floquet", outputs, columns, fixed={"element": element})
    found, sharp = (engine_job(scene | {"options": {"method": "direct", "rtol": rtol}})() for rtol in (1e-10, 1e-13))
    assert_bound_holds(found, sharp)


def random_rattle(count: int, seed: int) -> Columns:
    """Moderate damping; a twentieth of the gears have no spring in the gap."""
    rng = np.random.default_rng(seed)
    return {
        "omega": decades(rng, count, 0.2, 5.0),
        "B0": rng.uniform(-0.1, 0.3, count),
        "B1": rng.uniform(0.0, 0.5, count),
        "b": rng.uniform(0, 1, count) ** 2,
        "c": decades(rng, count, 0.05, 1.0),
        "alpha": rng.uniform(0, 1, count) * (rng.random(count) > 0.05),
        "k": decades(rng, count, 1.0, 100.0),
        "I": np.ones(count),
        "u0": rng.uniform(-1, 1, count),
        "v0": rng.uniform(-0.5, 0.5, count),
    }


def distance_and_radius(values: Mapping[str, float], state: np.ndarray, periods: int) -> tuple[float, float]:
    """Distance in u of the exact orbit from ``state``, by one step of Newton's method, and its spectral radius."""
    *end, _, exact = extended_motion(values, *state, periods)
    matrix, back = exact.astype(float), (np.array(end) - state).astype(float)
    return abs(np.linalg.solve(np.eye(2) - matrix, back)[0]), np.abs(np.linalg.eigvals(matrix)).max()


@pytest.mark.full
@pytest.mark.parametrize("seed", [15, 16, 17, 18])
def test_orbits_of_rattle_hold_at_random_points(seed):
    """Every orbit returns to its state in extended precision within its error, and attracts as its multipliers say."""
    columns = random_rattle(POINTS // 4, seed)
    outputs = ["orbit_state", "state_error", "spectral_radius", "period_multiple"]
    found = engine_job(columns_scene("rattle", "steady_state", outputs, columns, options={"most_periods": 400}))()
    periodic = np.flatnonzero(found["period_multiple"] > 0)
    assert np.mean(found["outcome"] == Outcome.SUCCESS) > 0.98 and periodic.size > 0.9 * len(found["outcome"])
    exact = [
        distance_and_radius(
            {name: float(x[i]) for name, x in columns.items()}, found["orbit_state"][i], found["period_multiple"][i]
        )
        for i in periodic
    ]
    away, radius = np.array(exact).T
    error, own = (found[name][periodic] for name in ("state_error", "spectral_radius"))
    wrong = np.flatnonzero((away > error) | (radius > 1 + 1e-6))
    assert not wrong.size, [(rows(columns, periodic[i]), away[i], error[i], own[i], radius[i]) for i in wrong[:3]]
    np.testing.assert_allclose(own, radius, rtol=0, atol=1e-6)
    # An error must be small, and larger than nothing.
    assert np.median(error) < 1e-12 and np.mean(away > 1e-3 * error) > 0.5
