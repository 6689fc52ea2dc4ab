"""Numbers with units, wherever a number is expected."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pint
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._units import UnitError, misread, number
from drivetrain_jax.runs.scene import load_scene

BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}


@pytest.mark.parametrize(
    ("text", "units", "value"),
    [
        ("18 deg", "rad", math.radians(18)),
        ("18deg", "rad", math.radians(18)),
        ("-18°", "rad", -math.radians(18)),
        ("3000 rpm", "rad/s", 100 * math.pi),
        ("3000 rpm", "Hz", 50.0),
        ("50 Hz", "rad/s", 100 * math.pi),
        ("3000 U/min", "rpm", 3000.0),
        ("0.1 mm", "m", 1e-4),
        ("2e5 N/mm", "N/m", 2e8),
        ("1 kNm/deg", "N m/rad", 180e3 / math.pi),
        ("6e4 N m", "N m/rad", 6e4),
        ("10 g cm2", "kg m2", 1e-6),
        ("5 kg·m²", "kg m2", 5.0),
        ("2 m s-2", "m/s2", 2.0),
        ("7.85 g/cm3", "kg/m3", 7850.0),
        ("2 %", "1", 0.02),
        ("inf N/m", "N/m", math.inf),
        ("1 lbf in", "N m", 4.4482216152605 * 0.0254),
        ("1 slug ft2", "kg m2", 4.4482216152605 * 0.3048),
        ("1 lb in s2", "kg m2", 4.4482216152605 * 0.0254),
        ("1 lb ft2", "kg m2", 0.45359237 * 0.3048**2),
    ],
)
def test_numbers(text, units, value):
    assert number(text, units) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "remark"),
    [
        ("1,425 rpm", "did you mean 1425 or 1.425?"),
        ("12,5 mm", "did you mean 12.5?"),
        ("0,425 mm", "did you mean 0.425?"),
        ("1,425,000 N", "write digits without commas"),
    ],
)
def test_a_comma_is_explained(text, remark):
    """Three digits after a comma are thousands to some and thousandths to others, so none is assumed."""
    assert misread(text) == f" ({remark})"


@pytest.mark.parametrize(
    ("text", "units"),
    [
        ("18 kg", "rad"),
        ("18 angle", "rad"),
        ("18 Grad", "rad"),
        ("18 DEG", "rad"),
        ("3000 speed", "rad/s"),
        ("50 1/s", "rad/s"),
        ("50 rad", "Hz"),
        ("50 rad", "1"),
        ("3000 rpm", "1"),
        ("1 m/rad", "N m"),
        ("1 N m", "kg m2"),
        ("1 (", "m"),
        ("1_ deg", "rad"),
        ("1 2 m", "m"),
        ("1 m**1e9", "m"),
        ("deg", "rad"),
        ("18", "rad"),
        ("", "rad"),
    ],
)
def test_what_measures_something_else_is_refused(text, units):
    with pytest.raises(UnitError):
        number(text, units)
    with pytest.raises(ValueError, match=r"^x = ") as error:
        Parameter("x", units, "a number").check(text)
    assert "\n" not in str(error.value)


def test_a_scene_with_units_is_the_one_without():
    axes = {"beta": {"start": "0 deg", "stop": "18 deg", "num": 4}, "Omega": ["1 1", 1.2]}
    written = load_scene({"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": BASE | {"zeta": "0.1 %"}})
    assert written.fixed["zeta"] == 0.001 and written.axes[0].dim == "beta"
    assert np.array_equal(written.axes[0].values, np.linspace(0, math.radians(18), 4))
    points = {"beta": ["18 deg", 0.2], "Omega": [1.4, 1.5]}
    columns = load_scene({"system": "cardan", "analysis": "floquet", "points": points, "fixed": BASE}).axes
    assert columns[0].values.tolist() == [math.radians(18), 0.2]
    options = load_scene(
        {
            "system": "bicardan",
            "analysis": "critical_speeds",
            "fixed": {"length": ["300 mm"], "EI": [1e4], "rhoA": [15.0], "k_A": "inf N/m", "k_D": "20 kN/mm"},
            "options": {"operating_max": "50 Hz"},
        }
    )
    assert options.fixed["length"] == (0.3,) and options.fixed["k_D"] == 2e7
    assert options.request.options["operating_max"] == 3000.0


@pytest.mark.full
def test_a_sweep_takes_units():
    shaft = dt.Cardan(beta="18 deg", Omega=1.4, **BASE)
    chart = dt.sweep(dt.floquet, shaft, over={"beta": ["9 deg", "18 deg"]}, outputs=["verdict"])
    assert chart.beta.values.tolist() == [math.radians(9), math.radians(18)] and chart.beta.attrs["units"] == "rad"
    doubled = dt.sweep(lambda s: 2 * s.beta, shaft, over={"beta": ["9 deg", 0.1]})
    assert doubled.beta.values.tolist() == [math.radians(9), 0.1]


@pytest.mark.full
@pytest.mark.parametrize(
    "bring",
    [
        lambda values: xr.DataArray(values, attrs={"units": "deg"}),
        lambda values: pint.application_registry.Quantity(values, "deg"),
        lambda values: pint.UnitRegistry().Quantity(values, "degree"),
    ],
)
def test_values_bring_their_units(bring):
    """A coordinate of a dataset and a quantity of pint are not taken for numbers in the unit of the parameter."""
    one, two = bring(9.0), bring(np.array([9.0, 18.0]))
    shaft = dt.Cardan(beta=one, Omega=1.4, **BASE)
    assert shaft.beta == math.radians(9)
    expected = [math.radians(9), math.radians(18)]
    assert dt.Cardan(beta=two, Omega=1.4, **BASE).beta.tolist() == expected
    swept = dt.sweep(dt.floquet, shaft, over={"beta": two}, outputs=["verdict"])
    scene = {"system": "cardan", "analysis": "floquet", "axes": {"beta": two}, "outputs": ["verdict"]}
    run = dt.run(scene | {"fixed": {"Omega": 1.4, **BASE}})
    assert swept.beta.values.tolist() == run.beta.values.tolist() == expected
    assert dt.point("cardan", "floquet", beta=one, Omega=1.4, **BASE).parameters["beta"] == expected[0]


def test_degrees_without_a_unit_are_refused_with_a_question():
    with pytest.raises(dt.InputError, match=r'^beta = 18: expected .*, in rad; did you mean "18 deg"\?$'):
        dt.Cardan(beta=18, Omega=1.4, **BASE)
    with pytest.raises(dt.InputError, match=r"^beta = 95: expected .*, in rad$"):
        dt.Cardan(beta=95, Omega=1.4, **BASE)


def test_pint_is_imported_for_units_alone():
    code = (
        "import sys, drivetrain_jax as dt; from drivetrain_jax.runs.scene import load_scene; load_scene('quickstart');"
        "print('pint' in sys.modules); dt.Cardan(beta='3 deg', Omega=1, zeta=0, alpha=1, mu=1, gamma=1);"
        "print('pint' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True"]
