"""Orders of an excitation: crossings with natural frequencies in answers, diagrams and reports, by hand formulas."""

from __future__ import annotations

import json

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.report.statements import statements
from drivetrain_jax.resonances import Orders

ANGLES = ["0 deg", "72 deg", "144 deg", "219 deg", "288 deg"]
GEAR = {"planet_angle": ANGLES, "teeth": [20, 26, 72]}
SHAFT = {"length": [0.3, 1.2, 0.3], "outer_diameter": [0.06, 0.09, 0.06], "inner_diameter": [0, 0.082, 0]}
SHAFT |= {"material": "steel", "k_A": 5e6, "k_D": 5e6}
RANGE = {"operating_min": 3000.0, "operating_max": 4500.0}


@pytest.fixture(scope="module")
def gear():
    return dt.run({"system": "planetary", "analysis": "modes", "fixed": GEAR, "title": "Five planets"})


@pytest.fixture(scope="module")
def shaft():
    options = {"modes": 3} | RANGE
    return dt.run({"system": "bicardan", "analysis": "critical_speeds", "fixed": SHAFT, "options": options})


def test_five_planets_meet_the_mesh_at_590_593_and_892_rpm():
    """A carrier at n rpm excites by 72 n/60 Hz, and its planets pass 5 times a turn."""
    found = dt.point("planetary", "modes", outputs=["natural_frequency"], **GEAR)
    first = found.crossings["mesh order 1"]
    assert np.isnan(first[0]) and np.round(first[1:4]).tolist() == [590, 593, 892]
    frequency = found.natural_frequency[1:]
    for name, times in (("mesh order 1", 72), ("mesh order 2", 144), ("mesh order 3", 216), ("planet pass", 5)):
        np.testing.assert_allclose(found.crossings[name][1:] * times / 60, frequency, rtol=1e-14)
    assert "  2     590.472" in repr(found) and "speed of the carrier at which an order meets the mode" in repr(found)
    stored = json.loads(found.to_json())["crossings"]
    assert stored["values"]["mesh order 1"][:2] == [None, pytest.approx(first[1])] and stored["units"] == "rpm"


def test_orders_meet_elastic_modes_beside_a_rigid_ring():
    """Frequencies of five planets with k_ru = 1e20 N/m, which stands for a ring that cannot turn."""
    speeds = Orders("carrier", {"mesh order 1": 72.0}).speeds([2e-7, 708.5, 9.2e8])
    np.testing.assert_allclose(speeds[:, 0], [np.nan, 708.5 * 60 / 72, 9.2e8 * 60 / 72])


@pytest.mark.full
def test_a_rigid_motion_alone_has_no_meeting():
    """Selected alone, it is its own largest frequency; computed, it is not exactly 0."""
    found = dt.run({"system": "planetary", "analysis": "modes", "fixed": {"teeth": [20, 26, 72]}})
    rigid = found.isel(mode=[0])
    assert np.isnan(rigid.assign(natural_frequency=0 * rigid.natural_frequency + 1e-7).drivetrain.orders()).all()
    assert np.isnan(rigid.drivetrain.orders()).all() and np.isfinite(found.drivetrain.orders()[1:]).all()


@pytest.mark.full
def test_joints_meet_a_critical_speed_at_half_of_it(capsys):
    words = [f"{name}={json.dumps(value)}" for name, value in (SHAFT | RANGE).items()]
    assert main(["point", "bicardan", "critical_speeds", "modes=3", *words]) == 0
    out = capsys.readouterr().out
    assert out.startswith(
        "From 3000 to 4500 rpm order 1 meets mode 1 at 3650.12 rpm; order 2 (joints) meets mode 2 at 4046.92 rpm; "
    )
    # The second critical speed, 8099.86 rpm, is out of the range, but not for the second order.


def test_no_crossing_in_the_range_is_an_answer_too():
    found = dt.point("planetary", "modes", outputs=["natural_frequency"], operating_max=50.0, **GEAR)
    assert repr(found).startswith("From 0 to 50 rpm no order meets a natural frequency.")
    with pytest.raises(dt.InputError, match="operating_max = 0: expected a speed of at least operating_min = 10"):
        dt.point("planetary", "modes", operating_min=10.0, **GEAR)


@pytest.mark.full
def test_the_diagram_crosses_every_order_with_every_mode(gear):
    axes = gear.drivetrain.plot().axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "linear"
    dots = [np.array(line.get_data()) for line in axes.lines if line.get_marker() == "o"]
    lines = [np.array(line.get_data()) for line in axes.lines if "/turn)" in str(line.get_label())]
    assert len(dots) == len(lines) == 4 and all(d.shape == (2, 23) for d in dots[:3])
    for (speeds, frequency), (ends, heights) in zip(dots, lines, strict=True):
        np.testing.assert_allclose(frequency, gear.natural_frequency[1 : 1 + speeds.size], rtol=1e-14)
        np.testing.assert_allclose((heights / ends)[1], frequency / speeds, rtol=1e-12)
    assert {"590", "593"} <= {text.get_text() for text in axes.texts}


@pytest.mark.full
def test_a_report_names_the_crossings(gear, shaft):
    (sentence,) = [s for s in statements(gear) if s.startswith("Mesh order 1 ")]
    assert sentence.startswith("Mesh order 1 meets modes at 590.472, 592.899, 892.225, ") and "carrier" in sentence
    at_rest = "From 3000 to 4500 rpm of the shaft (natural frequency at rest, without gyroscopic effect): "
    assert f"{at_rest}order 2 (joints) meets mode 2 at 4043.92 rpm." in statements(shaft)


@pytest.mark.full
def test_crossings_along_an_axis():
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["natural_frequency"], "axes": {"k_p": [1e8, 2e8]}}
    found = dt.run(scene | {"fixed": {"teeth": [20, 26, 72]}})
    speeds = found.drivetrain.orders()
    assert speeds.dims == ("k_p", "mode", "order") and speeds.attrs["units"] == "rpm"
    np.testing.assert_allclose(speeds.sel(order="planet pass", k_p=2e8)[1:] * 4 / 60, found.natural_frequency[1, 1:])
    with pytest.raises(dt.InputError, match="orders: not known"):
        dt.run(scene).drivetrain.orders()
