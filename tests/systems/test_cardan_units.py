"""Physical data of a shaft against the nondimensional parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from drivetrain_jax import InputError
from drivetrain_jax.systems.cardan import PHYSICAL, Cardan
from tests.oracles.cardan_reference import monodromy

DATA = {"J1": 0.5, "J2": 3.0, "k1": 2e4, "k2": 5e3, "c1": 3.0, "c2": 1.5, "speed": 1500.0, "angle": 35.0}


def converted(data):
    """The parameters that follow from ``data``, without the initial state."""
    return {name: x for name, x in Cardan.from_physical(**data).values.items() if not name.endswith("_0")}


def test_values():
    found = converted(DATA)
    assert found == pytest.approx(
        {"beta": math.radians(35), "Omega": 50 * math.pi / 200, "zeta": 3 / 200, "alpha": 0.5, "mu": 0.25, "gamma": 6.0}
    )


def test_labelled_arrays_keep_their_dimensions():
    """Otherwise an atlas would answer pairs of angles and speeds on the outer product of both."""
    arrays = {name: xr.DataArray([1.0, 2.0], dims="run") for name in ("speed", "angle", "c2")}
    found = PHYSICAL.converted(DATA | arrays)
    assert {found[name].dims for name in ("Omega", "beta", "alpha")} == {("run",)}


def test_multipliers_are_those_of_the_equations_in_seconds():
    """Reference: eqs (2)-(3) linearised in SI units and integrated over half a revolution of the flywheel."""
    j1, j2, k1, k2, c1, c2 = (DATA[name] for name in ("J1", "J2", "k1", "k2", "c1", "c2"))
    speed, angle = DATA["speed"] * 2 * math.pi / 60, math.radians(DATA["angle"])

    def ratio(phi):
        c, s = math.cos(angle), math.sin(angle)
        d = 1 - s**2 * math.sin(phi) ** 2
        first = c * s**2 * math.sin(2 * phi) / d**2
        second = c * s**2 * (2 * math.cos(2 * phi) / d**2 + 2 * s**2 * math.sin(2 * phi) ** 2 / d**3)
        return c / d, first, second

    def field(t, y):
        x = y.reshape(4, 4)
        eta, first, second = ratio(speed * t)
        torque1, torque2 = k1 * x[0] + c1 * x[2], k2 * x[1] + c2 * x[3]
        acceleration1 = (eta * torque2 - torque1) / j1
        drive = second * speed**2 * x[0] + 2 * first * speed * x[2] + eta * acceleration1
        return np.stack([x[2], x[3], acceleration1, -drive - torque2 / j2]).reshape(-1)

    z = solve_ivp(field, (0, math.pi / speed), np.eye(4).reshape(-1), rtol=1e-10, atol=1e-12).y[:, -1].reshape(4, 4)
    expected = np.poly(np.linalg.eigvals(z)).real
    found = np.poly(np.linalg.eigvals(monodromy(converted(DATA)))).real
    assert found == pytest.approx(expected, rel=1e-7)


def test_way_back():
    found = converted(DATA)
    for parameter, quantity in {"Omega": "speed", "beta": "angle", "zeta": "c1", "mu": "k2", "gamma": "J2"}.items():
        described, back = PHYSICAL.back(parameter, DATA)
        assert described.name == quantity and back(found[parameter]) == pytest.approx(DATA[quantity])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"J1": 0.0}, "J1 = 0.0: expected 0 < J1"),
        ({"angle": 90.0}, "angle = 90.0: expected -90 < angle < 90"),
        ({"speed": -1.0}, "speed = -1.0: expected 0 < speed"),
        ({"c1": 0.0}, "c2 = 1.5: expected 0 if c1 = 0"),
        ({"k2": math.nan}, "k2 = nan: expected"),
    ],
)
def test_wrong_input(change, message):
    with pytest.raises(InputError) as error:
        converted({**DATA, **change})
    assert str(error.value).startswith(message) and "\n" not in str(error.value)


def test_undamped():
    assert converted({**DATA, "c1": 0.0, "c2": 0.0})["zeta"] == 0.0
