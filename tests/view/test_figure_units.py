"""Figures in the units asked for, or in those in which the scene gives its axes."""

import json

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.datasets.figure import plot
from drivetrain_jax.view.style import alike, listed
from tests.view import results
from tests.view.results import texts

TRUCK = {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4}
FIXED = {"zeta": 0.0005, "alpha": 0.408, "mu": 2 / 3, "gamma": 0.25, "beta": 0.2}


def panel(figure):
    return figure.axes[0]


def chart(**attrs):
    return results.chart().drop_vars(("resonance", "resonance_Omega")).assign_attrs(attrs)


def test_an_angle_is_drawn_in_degrees():
    plain, degrees = plot(chart()), plot(chart(), units="deg")
    assert "joint angle ($\\beta$) [deg]" in texts(degrees)
    np.testing.assert_allclose(panel(degrees).get_ylim(), np.rad2deg(panel(plain).get_ylim()), rtol=1e-12)
    np.testing.assert_array_equal(panel(degrees).get_xlim(), panel(plain).get_xlim())


@pytest.mark.full
def test_a_dimensionless_speed_is_drawn_in_rpm_with_physical_data_only():
    with pytest.raises(InputError, match=r"units = 'rpm': nothing .* expected units of rad \(a dimensionless speed"):
        plot(chart(), units="rpm")
    data = {name: {"value": value, "units": "1"} for name, value in TRUCK.items()}
    fixed = {name: {"value": value, "units": "1"} for name, value in FIXED.items()}
    given = {"physical_data": json.dumps(data), "fixed_parameters": json.dumps(fixed)}
    figure = plot(chart(system="cardan", **given), units=["rpm", "deg"])
    assert "speed of the driving shaft (speed) [rpm]" in texts(figure)
    natural = np.sqrt(6e4 / 2) * 30 / np.pi
    np.testing.assert_allclose(panel(figure).get_xlim(), natural * np.array(panel(plot(chart())).get_xlim()), rtol=1e-6)


@pytest.mark.parametrize(
    ("units", "reason"),
    [("kg", "nothing in the result measures that"), ("deg,", "not a unit"), ("deg,rad", "measures the same as deg"),
     ("degg", "not a unit")],
)  # fmt: skip
def test_a_unit_of_no_axis_is_refused(units, reason):
    with pytest.raises(InputError, match=rf"units = '.*': {reason}; expected |units = '.*': {reason}"):
        plot(chart(), units=units)


def test_axes_have_the_unit_of_the_scene():
    text = (
        '[axes]\nbeta = { start = "0 deg", stop = "30 deg", num = 9 }\nOmega = { start = 0.5, stop = 1.5, num = 11 }\n'
    )
    assert "joint angle ($\\beta$) [deg]" in texts(plot(chart(scene=text)))
    assert "joint angle ($\\beta$) [rad]" in texts(plot(chart(scene=text), units="rad"))
    scaled = text.replace("{ start", '{ scale = "linear", start')
    assert "joint angle ($\\beta$) [deg]" in texts(plot(chart(scene=scaled)))


def test_fixed_values_have_the_unit_of_the_scene_or_of_the_axes():
    entry = {"angle": {"value": 0.5, "units": "rad"}, "length": {"value": [0.3, 1.2], "units": "m"}}
    scene = '[axes]\nbeta = {}\nOmega = {}\n[fixed]\nangle = 0.5\nlength = ["300 mm", 1.2]\n'
    dataset = chart(fixed_parameters=json.dumps(entry), scene=scene)
    assert "angle = 0.5 rad, length = [300, 1200] mm" in texts(plot(dataset))
    assert "angle = 28.6479 deg, length = [300, 1200] mm" in texts(plot(dataset, units="deg"))


@pytest.mark.full
def test_angles_of_planets_have_the_unit_given_or_asked_for():
    """The angle of the second planet is an axis of one value, so it is a number of the list, too."""
    fixed = {"planet_angle": {"value": [0.0, np.pi / 2, np.pi], "units": "rad"}}
    degrees = '[axes]\nk_p = {}\nk_r = {}\n"planet_angle[1]" = ["93 deg"]\n[fixed]\nplanet_angle = ["0 deg"]\n'
    radians = '[axes]\nk_p = {}\nk_r = {}\n"planet_angle[1]" = [1.6232]\n[fixed]\nplanet_angle = [0, 1.5708, 3.1416]\n'
    about = {"units": "rad", "parameter": "planet_angle[1]", "long_name": "angle of the planet, entry 1"}
    second = xr.DataArray(np.deg2rad(93.0), attrs=about, name="planet_angle_1")
    for scene, units in ((degrees, None), (degrees, "deg"), (radians, "deg")):
        dataset = chart(fixed_parameters=json.dumps(fixed), scene=scene).assign_coords(planet_angle_1=second)
        dataset = dataset.rename(beta="k_p", Omega="k_r")
        for name in ("k_p", "k_r"):
            dataset[name].attrs["units"] = "N/m"
        assert "planet angle = [0, 93, 180] deg" in texts(plot(dataset, units=units))
    assert "planet angle = [0, 1.6232, 3.1416] rad" in texts(plot(dataset))
    with pytest.raises(InputError, match=r"units = 'kg': nothing .* N/m, .*rad"):
        plot(dataset, units="kg")


@pytest.mark.full
def test_flanks_and_phase_follow_the_units_of_their_axes():
    """A gear pair with 0.1 mm backlash: flanks at 50 micrometres from the middle, in any unit."""
    gears = dt.Rattle(omega=0.9, B0=0.05, B1=0.03, b=5e-5, c=0.05, alpha=0.25, k=1.0, I=1.0)
    history = dt.sweep(dt.history, gears, over={"omega": [0.9]}, times=np.linspace(0, 1, 5).tolist())
    along = plot(history, units="um").axes[0]
    levels = sorted({float(np.asarray(line.get_ydata())[0]) for line in along.lines[1:]})
    np.testing.assert_allclose(levels, [-50, 50], rtol=1e-12)
    assert along.get_ylabel() == "$u$ [µm]"


def test_a_section_has_both_components_converted():
    state = [
        {"name": n, "units": u, "long_name": n, "symbol": "", "scale": 1.0} for n, u in (("phi", "rad"), ("v", "rad/s"))
    ]
    points = np.array([[0.1, 2.0], [0.2, 3.0], [0.15, 2.5]])
    dataset = xr.Dataset(
        {
            "section": (("strobe", "state"), points, {"units": "1", "units_of_components": "rad, rad/s"}),
            "torus_residual": ("state", [1e-3, 1e-3], {"units": "1"}),
            "outcome": ((), 0),
        },
        attrs={"analysis": "poincare", "state": json.dumps(state)},
    )
    figure = plot(dataset, units="deg,rpm")
    drawn = panel(figure).collections[0].get_offsets()
    np.testing.assert_allclose(drawn, points * [180 / np.pi, 30 / np.pi], rtol=1e-12)
    assert {"phi at the strobes [deg]", "v at the strobes [rpm]"} <= set(texts(figure))
    assert any("distance from a smooth curve 1.0×10⁻³ of the largest value" in text for text in texts(figure))


def test_lists_of_units_are_checked():
    assert listed("rpm, deg") == ["rpm", "deg"] and listed(("mm",)) == ["mm"]


@pytest.mark.parametrize(
    ("periods", "label", "largest"),
    [(2, "growth per turn, ln(factor)", 2 * np.log(1.25)),
     (0, "$\\log_{10}$ of the spectral radius", np.log10(1.25))],
)  # fmt: skip
def test_growth_without_a_speed_in_rpm_is_per_turn_or_period(periods, label, largest):
    figure = plot(chart(periods_per_turn=periods))
    bar = next(axes for axes in figure.axes if axes.get_label() == "<colorbar>")
    assert bar.get_xlabel().replace("\n", " ") == label
    assert figure.axes[1].collections[0].get_array().max() == pytest.approx(largest, rel=1e-12)
    assert 0.0 in bar.get_xticks()


def test_growth_at_a_speed_in_rpm_is_per_second():
    """rho = 1.25 in half a turn at 60 rpm: twice a second."""
    dataset = chart(periods_per_turn=2)
    unstable = dataset["spectral_radius"].values == 1.25
    dataset = dataset.assign_coords(
        Omega=("Omega", 60 * dataset["Omega"].values, {"units": "rpm", "long_name": "speed"})
    )
    figure = plot(dataset, units="Hz")
    assert "rate of growth [1/s]" in [axes.get_xlabel() for axes in figure.axes]
    hertz = np.broadcast_to(dataset["Omega"].values / 60, unstable.shape)
    found = figure.axes[1].collections[0].get_array()
    np.testing.assert_allclose(found[unstable], 2 * np.log(1.25) * hertz[unstable], rtol=1e-12)
    curve = plot(dataset.isel(beta=-1)).axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(curve[unstable[-1]], (2 * np.log(1.25) * hertz)[-1][unstable[-1]], rtol=1e-12)


def test_results_on_shared_axes_have_the_units_of_the_first():
    """Prefixes follow the values of each result, and axes the text of each scene."""

    def result(unit, axis, values):
        x = ("x", np.array([1.0, 2.0]), {"units": axis})
        return xr.Dataset({"u": ("x", np.array(values), {"units": unit}), "v": ("x", np.array(values))}, {"x": x})

    first, second = result("um", "rpm", [1.0, 2.0]), result("mm", "Hz", [0.5, 3.0])
    shown = alike(second, first)
    assert shown.u.values.tolist() == [500.0, 3000.0] and shown.x.values.tolist() == [60.0, 120.0]
    assert (shown.u.attrs["units"], shown.x.attrs["units"]) == ("um", "rpm")
    xr.testing.assert_identical(shown.v.drop_vars("x"), second.v.drop_vars("x"))
