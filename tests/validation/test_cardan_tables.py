"""Natural frequencies and resonance speeds of the cardan paper, eqs (23)-(26) and Tables 1-2: exact and printed values."""

from __future__ import annotations

import pytest

from drivetrain_jax import resonances
from tests.oracles.cardan_paper import PRINTED_FREQUENCIES, PRINTED_SPEEDS, predicted_speeds

EXACT = (0.070622235012, 1.415984639720)
# The two printed speeds that contradict the printed frequencies: .072/2 = .036 and 1.422/2 = .711.
MISPRINTS = {"H11", "H21"}


def parameters(one: float, two: float) -> dict[str, float]:
    """Parameters with these frequencies: ``omega1^2 omega2^2 = mu/gamma``, ``omega1^2 + omega2^2 = 1 + mu + mu/gamma``."""
    product = (one * two) ** 2
    mu = one**2 + two**2 - 1 - product
    return {"mu": mu, "gamma": mu / product}


def speeds(values: dict[str, float]) -> dict[str, float]:
    return dict(zip(resonances.CARDAN.labels, resonances.resonance_speeds(values), strict=True))


def test_natural_frequencies_for_stiff_driven_shaft():
    one, two = resonances.natural_frequencies(20.0, 100.0)
    assert (round(one, 4), round(two, 3)) == (0.0972, 4.603)


def test_parameters_have_the_printed_frequencies():
    assert resonances.natural_frequencies(**parameters(*PRINTED_FREQUENCIES)) == pytest.approx(PRINTED_FREQUENCIES)


def test_resonance_speeds_are_those_of_the_exact_frequencies():
    expected, found = predicted_speeds(EXACT), speeds({"mu": 1.0, "gamma": 100.0})
    assert set(expected) == set(PRINTED_SPEEDS)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", PRINTED_SPEEDS)
def test_printed_speeds_follow_from_the_printed_frequencies(name):
    difference = abs(speeds(parameters(*PRINTED_FREQUENCIES))[name] - PRINTED_SPEEDS[name])
    assert (difference < 0.00051) == (name not in MISPRINTS)


@pytest.mark.parametrize("name", PRINTED_SPEEDS)
def test_printed_speeds_are_within_three_per_cent(name):
    assert speeds({"mu": 1.0, "gamma": 100.0})[name] == pytest.approx(PRINTED_SPEEDS[name], rel=0.03)
