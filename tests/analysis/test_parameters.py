"""Constants of the elements as a sweep."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._quantities import Variable
from drivetrain_jax.analyses import analyse
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.invariants import check
from drivetrain_jax.systems import System, get_system, parameter, serves

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "tripod.json").read_text())


def test_every_constant_over_the_joint_angle():
    rows = REFERENCE["omega_vs_beta"]
    outputs = [variable.name for variable in get_system("tripod").models["parameters"].results]
    axes = {"beta": {"values": [math.radians(row["beta"]) for row in rows]}}
    ds = dt.run(
        {
            "system": "tripod",
            "analysis": "parameters",
            "outputs": outputs,
            "axes": axes,
            "fixed": {"element": "output"},
            "options": {"modes": 5},
        }
    )
    np.testing.assert_allclose(ds.natural_angular_frequency, [row["Omega3"] for row in rows], rtol=1e-12)
    np.testing.assert_allclose(ds.resonance_frequency, [row["eta3_Hz"] for row in rows], rtol=1e-12)
    np.testing.assert_allclose(ds.mean_inertia, [row["Ibar3"] for row in rows], rtol=1e-12)
    expected = REFERENCE["elements9"]["3"]
    np.testing.assert_allclose(ds.torsional_stiffness[9], expected["kt"], rtol=1e-12)
    # The midshaft frequency does not depend on the joint angle, but has a row for each angle.
    assert ds.midshaft_frequency.dims == ("beta", "mode")
    np.testing.assert_allclose(ds.midshaft_frequency, np.tile(REFERENCE["nu_k_Hz"], (10, 1)), rtol=1e-12)
    assert ds["mode"].values.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(ds.torque_acceleration[9], -4300.254483961879, rtol=1e-12)
    assert (ds.outcome == 0).all()


class Spring(System):
    """A system with results of its own, one of them by mode; its parameters may be traced."""

    name = "spring"
    title = "Spring"
    k: float = parameter("N/m", "stiffness", lower=0.0)

    @serves(
        "parameters", results=(Variable("period", "s", "period", lower=0.0), Variable("tone", "Hz", "tone", ("mode",)))
    )
    def constants(self):
        return {"period": 2 * math.pi / self.k**0.5, "tone": lambda mode: mode * self.k}


def test_a_system_declares_its_results():
    analysis = get_analysis("parameters").for_system(Spring)
    assert analysis.default_outputs == ("period", "tone") and analysis.methods == {"exact": ("modes",)}
    found = analyse("parameters", Spring(k=4.0), None, {"modes": 2})
    assert found.period == pytest.approx(math.pi) and found.tone.tolist() == [4.0, 8.0]
    slope = jax.grad(lambda spring: analyse("parameters", spring, ["period"], {}).period)(Spring(k=4.0))
    assert slope.k == pytest.approx(-math.pi / 8)


def test_a_model_without_a_declared_result_is_refused():
    body = {"name": "idle", "title": "idle", "__annotations__": {"k": float}, "k": parameter("1", "k")}
    declared = serves("parameters", results=(Variable("period", "s", "period"),))
    idle = type("Idle", (System,), body | {"constants": declared(lambda self: {"perod": self.k})})
    with pytest.raises(dt.InputError, match=r"^Idle: its model of parameters has perod, not period; expected period"):
        analyse("parameters", idle(k=1.0), None, {})


def test_a_value_below_its_valid_range_breaks_a_rule():
    ds = dt.point("tripod", "parameters", element="input", beta=0.1)
    chart = dt.run({"system": "tripod", "analysis": "parameters", "fixed": {"element": "input", "beta": 0.1}})
    assert chart.mean_inertia.attrs["valid_min"] == 0 and float(chart.mean_inertia) == ds.mean_inertia
    assert not any(finding.broken for finding in check(chart))
    assert [f.rule for f in check(chart.assign(mean_inertia=-chart.mean_inertia)) if f.broken] == ["0 <= mean_inertia"]


def test_one_point():
    point = dt.point("tripod", "parameters", element="input", beta=math.radians(9), modes=2)
    assert np.isclose(point.natural_angular_frequency, 9633.726700903984, rtol=1e-12)
    assert len(point.midshaft_frequency) == 2


@pytest.mark.parametrize("swept", ["axes", "points"])
def test_a_parameter_that_varies_is_a_coordinate_and_no_result(swept):
    values = [0.1, 0.2]
    scene = {"system": "tripod", "analysis": "parameters", "fixed": {"element": "input", "beta": 0.1, "zeta": 0.01}}
    scene[swept] = {"chi_n": {"values": values} if swept == "axes" else values}
    ds = dt.run(scene)
    assert ds.chi_n.values.tolist() == values and "c_inertia" in ds.data_vars and "chi_n" not in ds.data_vars
    with pytest.raises(dt.InputError, match="outputs: 'chi_n' varies in this scene"):
        dt.run(scene | {"outputs": ["chi_n", "c_inertia"]})


def test_at_a_point_a_given_parameter_is_a_result_too():
    assert dt.point("tripod", "parameters", element="input", beta=0.1, zeta=0.01, chi_n=0.3).chi_n == 0.3
