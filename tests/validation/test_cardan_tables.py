"""Natural frequencies and resonance speeds of the cardan paper, eqs (23)-(26) and Tables 1-2: exact beside printed."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.systems import cardan
from tests.oracles.cardan_paper import PRINTED_FREQUENCIES, PRINTED_SPEEDS, natural_frequencies, predicted_speeds

EXACT = (0.070622235012, 1.415984639720)
# The two printed speeds that the printed frequencies do not give: .072/2 = .036 and 1.422/2 = .711.
MISPRINTS = {"H11", "H21"}


def ours() -> dict[str, float]:
    return dict(zip(cardan.Cardan.resonances.labels, cardan.resonance_speeds({"mu": 1.0, "gamma": 100.0}), strict=True))


def test_natural_frequencies():
    np.testing.assert_allclose(cardan.natural_frequencies(1.0, 100.0), EXACT, rtol=0, atol=5e-13)


@pytest.mark.parametrize(("mu", "gamma"), [(1.0, 100.0), (20.0, 100.0), (1e4, 1e-3), (0.05, 3.0)])
def test_natural_frequencies_are_those_of_the_stiffness_matrix(mu, gamma):
    np.testing.assert_allclose(cardan.natural_frequencies(mu, gamma), natural_frequencies(mu, gamma), rtol=1e-9)


def test_natural_frequencies_for_stiff_driven_shaft():
    one, two = cardan.natural_frequencies(20.0, 100.0)
    assert (round(one, 4), round(two, 3)) == (0.0972, 4.603)


def test_printed_frequencies_are_not_the_exact_ones():
    assert [round(w, 3) for w in EXACT] == [0.071, 1.416]
    assert PRINTED_FREQUENCIES == (0.072, 1.422)


def test_resonance_speeds_are_those_of_the_exact_frequencies():
    expected = predicted_speeds(EXACT)
    speeds = ours()
    assert set(expected) == set(PRINTED_SPEEDS)
    for name, value in expected.items():
        assert speeds[name] == pytest.approx(value, abs=1e-12), name


@pytest.mark.parametrize("name", sorted(set(PRINTED_SPEEDS) - MISPRINTS))
def test_printed_speeds_follow_from_the_printed_frequencies(name):
    assert predicted_speeds(PRINTED_FREQUENCIES)[name] == pytest.approx(PRINTED_SPEEDS[name], abs=0.00051)


@pytest.mark.parametrize("name", sorted(MISPRINTS))
def test_printed_speeds_that_the_printed_frequencies_do_not_give(name):
    assert abs(predicted_speeds(PRINTED_FREQUENCIES)[name] - PRINTED_SPEEDS[name]) > 0.00051


def test_our_speeds_differ_from_the_printed_ones_by_the_rounding_of_the_frequencies():
    speeds = ours()
    assert max(abs(speeds[name] / printed - 1) for name, printed in PRINTED_SPEEDS.items()) < 0.03
