"""The analysis through the engine: methods on the same axes, order of the path, results that a method lacks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.systems.rattle import PRESETS

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "rattle.json").read_text())
STEADY = {case["name"]: case for case in REFERENCE["steady"]}
# Neither rising nor falling.
OMEGAS = [0.8, 0.6, 0.7, 0.9]


def run(method: str, omegas=OMEGAS, outputs=("u_max", "u_min", "regime"), **options):
    scene = {"system": "rattle", "analysis": "frequency_response", "outputs": list(outputs)}
    return dt.run(
        scene
        | {"axes": {"omega": {"values": omegas}}, "fixed": PRESETS["table1"], "options": {"method": method} | options}
    )


def test_exact_sweeps_meet_the_reference():
    exact = run("exact")
    for name, omega, direction in (
        ("T1 w.8 high", 0.8, "up"), ("T1 w.8 low", 0.8, "down"), ("T1 w.7 double-sided", 0.7, "up"),
    ):  # fmt: skip
        at = exact.sel(omega=omega, sweep_direction=direction)
        assert float(at.u_max) == pytest.approx(STEADY[name]["max"], abs=1e-9)
        assert float(at.u_min) == pytest.approx(STEADY[name]["min"], abs=1e-9)
    assert (exact.outcome == 0).all()


def test_order_of_the_path_does_not_matter():
    given = run("describing_function")
    rising = run("describing_function", sorted(OMEGAS))
    np.testing.assert_array_equal(given.u_max.sortby("omega").values, rising.u_max.values)
    assert given.u_max.dims == ("omega", "sweep_direction")
    assert given.regime.sel(omega=0.8).values.tolist() == [2, 1]


def test_a_range_that_is_given_is_kept():
    found = run("multiple_scales", outputs=("fit_range", "peak_frequency"), fit_range=1.0)
    np.testing.assert_array_equal(found.fit_range.values, 1.0)
    np.testing.assert_allclose(found.peak_frequency.values, 0.8729, atol=5e-5)


@pytest.mark.parametrize(
    ("method", "output", "allowed"),
    [
        ("exact", "fold_frequency", "multiple_scales, describing_function"),
        ("harmonic_balance", "fit_range", "multiple_scales"),
        ("describing_function", "period_multiple", "exact"),
    ],
)
def test_results_that_a_method_lacks_are_refused(method, output, allowed):
    with pytest.raises(InputError, match=f"method {method} does not give {output}; allowed for it is {allowed}"):
        run(method, outputs=(output,))


def test_options_of_another_method_are_refused():
    with pytest.raises(InputError, match=r"options.fit_range = 1.0: not used by method harmonic_balance"):
        run("harmonic_balance", fit_range=1.0)
