"""Frequencies and types of modes, and the oracle of other tests, against the reference values."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt
from tests.oracles.planetary_reference import case_parameters, exact_frequencies, natural_frequencies

CASES = json.loads((Path(__file__).parents[1] / "reference" / "planetary.json").read_text())
TYPES = {"R": "rotational", "T": "translational", "P": "planet", "X": "coupled"}
SPECTRUM = ("natural_frequency", "natural_frequency_error")
MODES = ("natural_frequency", "mode_type", "participation")


def by_count() -> dict[int, list[str]]:
    groups: dict[int, list[str]] = {}
    for name, case in CASES.items():
        groups.setdefault(len(case["psi_deg"]), []).append(name)
    return groups


def run_cases(names: list[str], outputs: tuple[str, ...], method: str = "auto"):
    """All cases with the same number of planets in one run, in which every parameter and every angle varies."""
    listed = [case_parameters(CASES[name]) for name in names]
    columns = {key: [p[key] for p in listed] for key in listed[0] if key != "planet_angle"}
    columns |= {
        f"planet_angle[{i}]": [p["planet_angle"][i] for p in listed] for i in range(len(listed[0]["planet_angle"]))
    }
    return dt.run(
        {
            "system": "planetary",
            "analysis": "modes",
            "outputs": list(outputs),
            "points": columns,
            "fixed": {"planet_angle": list(listed[0]["planet_angle"])},
            "options": {"method": method},
        }
    )


@cache
def spectra(count: int) -> dict:
    names = by_count()[count]
    ds = run_cases(names, SPECTRUM)
    return {name: ds.isel(point=i) for i, name in enumerate(names)}


def spectrum(name: str):
    return spectra(len(CASES[name]["psi_deg"]))[name]


# Cases by number of planets, which need a kernel each: the short form has one number.
NAMES = [
    pytest.param(name, marks=() if len(case["psi_deg"]) == 4 else pytest.mark.full) for name, case in CASES.items()
]


def check_frequencies(name: str, found: np.ndarray) -> None:
    exact = np.array([float(f) for f in CASES[name]["f_Hz"]])
    moving = exact > 0
    np.testing.assert_allclose(found[moving], exact[moving], rtol=1e-11)
    assert (found[~moving] < 1e-6).all()


@pytest.mark.parametrize("name", NAMES)
def test_spectrum(name):
    check_frequencies(name, spectrum(name).natural_frequency.values)
    assert int(spectrum(name).outcome) == 0


@pytest.mark.parametrize("name", NAMES)
def test_error_estimate_holds_and_is_useful(name):
    exact = np.array([float(f) for f in CASES[name]["f_Hz"]])
    bound = spectrum(name).natural_frequency_error.values
    assert (np.abs(spectrum(name).natural_frequency.values - exact) <= bound).all()
    assert (bound <= 1e-14 * exact[-1]).all()


def types_by_frequency(frequencies: list[str], types: list[str]) -> list[tuple[str, str]]:
    """Pairs in rising order of frequency and then of type, because the order within a multiple frequency is arbitrary."""
    return sorted(zip(frequencies, types, strict=True), key=lambda pair: (float(pair[0]), pair[1]))


def check_modes(names: list[str], method: str) -> None:
    ds = run_cases(names, MODES, method)
    meanings = ds.mode_type.attrs["flag_meanings"].split()
    for i, name in enumerate(names):
        check_frequencies(name, ds.natural_frequency.values[i])
        expected = [TYPES[letter] for letter in CASES[name]["types"]]
        zero = [float(f) == 0 for f in CASES[name]["f_Hz"]]
        expected = ["rigid" if still else kind for still, kind in zip(zero, expected, strict=True)]
        found, reference = [meanings[code] for code in ds.mode_type.values[i]], CASES[name]["f_Hz"]
        assert types_by_frequency(reference, found) == types_by_frequency(reference, expected), name
        np.testing.assert_allclose(ds.participation.values[i].sum(-1), 1, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("method", ["auto", "full"])
@pytest.mark.parametrize("count", by_count())
def test_types_of_every_case(count, method):
    check_modes(by_count()[count], method)


@pytest.mark.full
@pytest.mark.parametrize("names", by_count().values())
def test_spectrum_without_the_reduction(names):
    ds = run_cases(names, SPECTRUM, "full")
    for i, name in enumerate(names):
        check_frequencies(name, ds.natural_frequency.values[i])


@pytest.mark.parametrize("name", ["N4_mesh1e16", "N5_unequal_0_72_144_252_324", "N12_random"])
def test_the_oracle_itself(name):
    exact = np.array([float(f) for f in CASES[name]["f_Hz"]])
    np.testing.assert_allclose(exact_frequencies(case_parameters(CASES[name])), exact, rtol=1e-14, atol=1e-12)


def test_matrix_agrees_only_roughly_where_stiffnesses_differ():
    """Forming K loses digits, which is why the package uses singular values."""
    case = CASES["N4_mesh1e16"]
    exact = np.array([float(f) for f in case["f_Hz"]])
    assert np.abs(natural_frequencies(case_parameters(case))[1:] / exact[1:] - 1).max() > 1e-9
