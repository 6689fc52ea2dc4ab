"""The driveshaft against the independently computed reference values: states, Floquet multipliers, stability."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import drivetrain_jax as dt
from tests.sizes import full_after

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "tripod.json").read_text())
NINE_DEGREES = math.radians(9)
ELEMENT = {"25": "input", "29": "input", "26": "output", "30": "output"}
FLOQUET = {key: case for key, case in REFERENCE["floquet_vs_benettin"].items() if not key.startswith("est")}


@pytest.mark.full
@pytest.mark.parametrize("equation", ["25", "30", "26", "29"])
def test_states(equation):
    """phi and V agree with every reference history to 1e-8 of their scale."""
    cases = [case for case in REFERENCE["states"] if case["eq"] == equation]
    times = sorted({case["t"] for case in cases})
    columns = {"zeta": "zeta", "chi_n": "chi", "excitation_frequency": "eta_Hz", "phi0": "phi0", "velocity0": "V0"}
    ds = dt.run(
        {
            "system": "tripod",
            "analysis": "history",
            "points": {name: [float(case[key]) for case in cases] for name, key in columns.items()},
            "fixed": {"element": ELEMENT[equation], "equation": equation, "beta": NINE_DEGREES},
            "options": {"times": times, "rtol": 1e-10},
        }
    )
    for i, case in enumerate(cases):
        k = times.index(case["t"])
        scale = max(abs(case["phi"]), case["phi0"], 1e-6)
        assert float(ds.phi[i, k]) == pytest.approx(case["phi"], abs=1e-8 * scale)
        assert float(ds.velocity[i, k]) == pytest.approx(case["V"], abs=1e-8 * max(abs(case["V"]), scale))


@pytest.fixture(scope="module", params=full_after(1, ["29", "30"]))
def floquet(request):
    """The cases of one element with the computed result."""
    cases = {key: case for key, case in FLOQUET.items() if key.startswith(request.param)}
    points = {
        "excitation_frequency": [float(key.split("_")[1]) for key in cases],
        "zeta": [float(key.split("_")[2]) for key in cases],
        "chi_n": [case["chi"] for case in cases.values()],
    }
    fixed = {"element": ELEMENT[request.param], "beta": NINE_DEGREES}
    outputs = ["floquet_multiplier", "floquet_exponent", "spectral_radius", "spectral_radius_error", "verdict"]
    outputs.append("liouville_residual")
    scene = {"system": "tripod", "analysis": "floquet", "outputs": outputs, "points": points, "fixed": fixed}
    return list(cases.values()), dt.run(scene)


def test_spectral_radii(floquet):
    cases, ds = floquet
    rho = np.array([case["rho"] for case in cases])
    np.testing.assert_allclose(ds.spectral_radius, rho, rtol=0, atol=1e-10)
    assert (np.abs(ds.spectral_radius - rho) <= ds.spectral_radius_error).all()
    assert (ds.verdict == 0).all()


def test_exponents_and_their_sum(floquet):
    cases, ds = floquet
    exponents = np.array([sorted(case["exps"], reverse=True) for case in cases])
    np.testing.assert_allclose(ds.floquet_exponent, exponents, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ds.floquet_exponent.sum("multiplier"), exponents.sum(axis=1), rtol=1e-11)
    assert np.abs(ds.liouville_residual).max() < 1e-13


def test_multipliers(floquet):
    cases, ds = floquet
    for case, found in zip(cases, ds.floquet_multiplier.values, strict=True):
        expected = np.array([complex(text.strip("()")) for text in case["mult"]])
        np.testing.assert_allclose(np.poly(found), np.poly(expected), rtol=0, atol=1e-12)


@pytest.mark.full
def test_no_instability_in_the_range_of_the_paper():
    """zeta, frequency and chi_n (derived, as printed, stated) of the paper: the largest exponent is far below zero."""
    axes = {
        "excitation_frequency": {"values": sorted([*np.linspace(2950, 3200, 51).tolist(), 3066.5])},
        "zeta": {"values": [0.0016, 0.0073, 0.0318]},
        "chi_n": {"values": [0.00038577909059134334, 0.0017535413208697424, 0.0026]},
    }
    outputs = ["floquet_exponent", "verdict"]
    fixed = {"element": "input", "beta": NINE_DEGREES}
    scene = {"system": "tripod", "analysis": "floquet", "outputs": outputs, "axes": axes, "fixed": fixed}
    ds = dt.run(scene)
    assert (ds.verdict == 0).all()
    assert -13.3 < float(ds.floquet_exponent.max()) < -13.1


@pytest.mark.full
def test_critical_nonuniformity_separates_stable_from_unstable():
    """Just below the tip no frequency is unstable; just above the tip its frequency is unstable."""
    case = REFERENCE["critical_chi_n"][0]
    tip = {"zeta": case["zeta"], "excitation_frequency": case["excitation_frequency_Hz"]}
    columns = {"chi_n": [case["chi_n"] - 1e-7, case["chi_n"] + 1e-7]}
    fixed = {"element": "input", "beta": NINE_DEGREES} | tip
    scene = {"system": "tripod", "analysis": "floquet", "outputs": ["verdict"], "points": columns, "fixed": fixed}
    assert dt.run(scene).verdict.values.tolist() == [0, 1]
    around = {"excitation_frequency": {"start": 3040.0, "stop": 3090.0, "num": 201}}
    fixed = {"element": "input", "beta": NINE_DEGREES, "zeta": case["zeta"], "chi_n": case["chi_n"] - 1e-6}
    scene = {"system": "tripod", "analysis": "floquet", "outputs": ["verdict"], "axes": around, "fixed": fixed}
    assert (dt.run(scene).verdict == 0).all()
