"""The equation of rattle is homogeneous in its lengths, and so are the results for any size of lengths."""

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.systems.rattle import PRESETS
from tests.sizes import full_after

TABLE1 = PRESETS["table1"]


def of_size(size):
    return TABLE1 | {name: TABLE1[name] * size for name in ("b", "B0", "B1")}


def run(analysis, size, outputs, **scene):
    return dt.run({"system": "rattle", "analysis": analysis, "fixed": of_size(size), "outputs": outputs} | scene)


def assert_homogeneous(found, expected, size, lengths):
    for name in expected.data_vars:
        scale = size if name in lengths else 1.0
        wanted = expected[name].values
        assert np.isfinite(wanted).any(), name
        # Near zeros of a motion rounding is relative to the size of the motion.
        np.testing.assert_allclose(
            found[name].values / scale, wanted, rtol=1e-12, atol=1e-14 * np.nanmax(np.abs(wanted)), err_msg=name
        )


# Lengths from picometres to millions of kilometres.
SIZES = [2.0**-40, 2.0**30]


@pytest.mark.full
@pytest.mark.parametrize("size", SIZES)
def test_a_steady_state(size):
    lengths = ["u_max", "u_min", "u_mean", "u_rms", "impact_velocity", "orbit_state", "u_history", "v_history"]
    outputs = [*lengths, "phase", "period_multiple", "spectral_radius", "regime", "impacts", "contact_fraction"]
    found, expected = (run("steady_state", s, outputs, axes={"omega": {"values": [0.45, 0.8]}}) for s in (size, 1.0))
    assert_homogeneous(found, expected, size, lengths)


@pytest.mark.full
def test_a_response_and_its_branch():
    lengths = ["u_max", "u_min", "u_rms", "branch_u_max", "branch_u_min"]
    scene = {"axes": {"omega": {"start": 0.7, "stop": 0.9, "num": 3}}, "options": {"method": "exact"}}
    outputs = [*lengths, "phase", "regime", "fold_frequency"]
    found, expected = (run("frequency_response", size, outputs, **scene) for size in (SIZES[1], 1.0))
    assert_homogeneous(found, expected, SIZES[1], lengths)


@pytest.mark.parametrize("size", full_after(1, SIZES))
@pytest.mark.parametrize(
    ("method", "options", "own"),
    full_after(
        1,
        [
            ("multiple_scales", {}, ["peak_frequency", "fold_frequency"]),
            ("multiple_scales", {"fit_range": 1.0}, ["peak_frequency", "fold_frequency"]),
            ("describing_function", {}, ["peak_frequency", "fold_frequency"]),
            ("harmonic_balance", {"harmonics": 3}, []),
        ],
        several=True,
    ),
)
def test_an_approximate_response(method, options, own, size):
    lengths = ["u_max", "u_min", "u_rms", "residual", "branch_u_max", "branch_u_min"]
    lengths += ["peak_amplitude", "backbone_amplitude"] if own else []
    lengths += ["fit_range"] if method == "multiple_scales" else []
    outputs = [*lengths, *own, "phase", "spectral_radius", "regime", "stability"]
    axes = {"omega": {"start": 0.7, "stop": 0.9, "num": 9}}

    def response(size):
        given = {"fit_range": size * options["fit_range"]} if "fit_range" in options else {}
        return run("frequency_response", size, outputs, axes=axes, options={"method": method} | options | given)

    assert_homogeneous(response(size), response(1.0), size, lengths)


@pytest.mark.full
def test_basins():
    lengths, outputs = ["attractor_u_max", "attractor_u_min"], ["basin_fraction", "attractor_multiple"]
    found, expected = (
        run(
            "basins", size, lengths + outputs, axes={"omega": {"values": [0.8]}},
            options={"samples": 64, "reach_u": size, "reach_v": size},
        )
        for size in (SIZES[1], 1.0)
    )  # fmt: skip
    assert_homogeneous(found, expected, SIZES[1], lengths)
