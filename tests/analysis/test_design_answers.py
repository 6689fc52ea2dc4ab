"""Growth and separation margins against closed forms and printed values."""

from __future__ import annotations

import numpy as np

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds.margins import required_margin
from drivetrain_jax.analysis.floquet.growth import growth


def test_growth_follows_an_exponential():
    """x = exp(a t) with a = 0.7 and -0.7 1/s, multiplier over a period of 0.3 s, a turn of 0.6 s."""
    a, period, turn = np.array([0.7, -0.7]), 0.3, 0.6
    found = growth(np.exp(a * period), period, turn)
    np.testing.assert_allclose(found.rate, a, rtol=1e-14)
    np.testing.assert_allclose(found.per_turn, np.exp(a * turn), rtol=1e-14)
    np.testing.assert_allclose(np.exp(a[0] * found.time_to_double[0]), 2.0, rtol=1e-14)
    np.testing.assert_allclose(np.exp(a[1] * found.time_to_halve[1]), 0.5, rtol=1e-14)
    np.testing.assert_allclose(found.turns_to_double[0] * turn, found.time_to_double[0], rtol=1e-14)
    assert np.isinf(found.time_to_double[1]) and np.isinf(found.turns_to_halve[0])


def test_neither_growth_nor_an_immediate_end_divides_by_zero():
    found = growth([1.0, 0.0, np.nan], 1.0, 1.0)
    assert np.isinf(found.time_to_double[0]) and np.isinf(found.time_to_halve[0]) and found.time_to_halve[1] == 0.0
    assert np.isnan(found.rate[2]) and np.isnan(found.time_to_double[2]) and np.isnan(found.turns_to_halve[2])


def test_required_margin_of_api_617():
    """None below 2.5; from there 17 (1 - 1/(AF - 1.5)) percent, and 10 more above the range; at most 16 and 26."""
    factors = np.array([1.0, 2.49, 2.5, 3.5, 1e9])
    np.testing.assert_allclose(required_margin(2999.0, 3000.0, factors), [0, 0, 0, 0.085, 0.16], atol=1e-9)
    np.testing.assert_allclose(required_margin(8000.0, 3000.0, factors), [0, 0, 0.1, 0.185, 0.26], atol=1e-9)


def test_margins_of_a_stepped_shaft():
    """The critical speeds 3646, 8088 rpm against 3000-4500 rpm: the first is within."""
    shaft = dt.Bicardan(
        length=(0.3, 1.2, 0.3), EI=(133596.0, 210268.0, 133596.0), rhoA=(22.2, 8.48, 22.2), k_A=5e6, k_D=5e6
    )
    outputs = ["critical_speed", "separation_margin", "required_margin"]
    options = {"operating_min": 3000.0, "operating_max": 4500.0, "amplification": 10.0, "modes": 2}
    found = dt.critical_speeds(shaft, outputs=outputs, **options)
    assert 3000 < found.critical_speed[0] < 4500 < found.critical_speed[1]
    np.testing.assert_allclose(found.separation_margin, [0.0, found.critical_speed[1] / 4500 - 1], rtol=1e-14)
    np.testing.assert_allclose(found.required_margin, 0.25, rtol=1e-14)
    # Without damping the largest margins are required.
    del options["amplification"]
    undamped = dt.critical_speeds(shaft, outputs="required_margin", **options)
    np.testing.assert_allclose(undamped.required_margin, 0.26, rtol=1e-14)
