"""The stepped shaft by the rivals of the benchmarks, and in 40 digits, against the stored reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.oracles.bicardan_precise_reference import precise_frequencies
from tests.oracles.bicardan_rivals import count_below, dynamic_stiffness_frequencies, hermite_frequencies

CASES = json.loads((Path(__file__).parents[1] / "reference" / "bicardan.json").read_text())
NAMES = {"length": "l", "EI": "EI", "rhoA": "rhoA", "k_A": "kA", "k_D": "kD"}


def case(name: str) -> tuple[dict, np.ndarray]:
    """Parameters, and the first four frequencies, with zeros for zero modes."""
    given = CASES[name]
    zeros = given["zero_modes"]
    values = [float(given["p_rad_per_s"][str(k)]) for k in range(zeros + 1, 5)]
    return {ours: given[theirs] for ours, theirs in NAMES.items()}, np.array([0.0] * zeros + values)


def test_elements_converge_with_their_fourth_power():
    shaft, exact = case("paper_real_exactI")
    coarse, fine = (np.abs(hermite_frequencies(shaft, 4, n) / exact - 1).max() for n in (8, 16))
    assert fine < 1e-5
    assert coarse / fine == pytest.approx(16, rel=0.15)


def test_free_elements_have_two_zero_modes():
    shaft, exact = case("free_free_3seg")
    found = hermite_frequencies(shaft, 4, 16)
    assert found[:2].max() < 1e-3 * exact[2]
    np.testing.assert_allclose(found[2:], exact[2:], rtol=1e-5)


@pytest.mark.parametrize("name", ["paper_real_exactI", "five_seg", "slender_Ld1000"])
def test_dynamic_stiffness(name):
    shaft, exact = case(name)
    np.testing.assert_allclose(dynamic_stiffness_frequencies(shaft, 4, 1e-13), exact, rtol=1e-11)
    q = np.sqrt(exact)
    np.testing.assert_array_equal(count_below(shaft, q * (1 + 1e-6)), [1, 2, 3, 4])
    np.testing.assert_array_equal(count_below(shaft, q * (1 - 1e-6)), [0, 1, 2, 3])


def test_many_shafts_together():
    shaft, exact = case("paper_real_exactI")
    both = {name: [np.array([x, 4 * x]) for x in value] if name == "EI" else value for name, value in shaft.items()}
    both |= {name: np.array([1.0, 4.0]) * shaft[name] for name in ("k_A", "k_D")}
    found = dynamic_stiffness_frequencies(both, 4, 1e-13)
    np.testing.assert_allclose(found, np.stack([exact, 2 * exact], axis=1), rtol=1e-11)


@pytest.mark.parametrize("name", ["paper_real_exactI", "near_pinned_k1e14", "near_free_k1"])
def test_forty_digits(name):
    shaft, exact = case(name)
    found, distance = precise_frequencies(shaft, (1, 2, 3, 4), bubbles=14)
    np.testing.assert_allclose([float(value) for value in found], exact, rtol=1e-15)
    # The elements lose the digits by which the stiffness of the supports is below that of the shaft.
    assert distance < 1e-6
