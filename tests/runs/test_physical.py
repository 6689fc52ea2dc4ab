"""Physical data in scenes: axes, points and fixed values, of every system."""

from __future__ import annotations

import json
import math
import re

import jax
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.runs.physical import in_parameters
from drivetrain_jax.runs.scene import load_scene

# A truck's propeller shaft.
TRUCK = {"J1": 2, "J2": 0.5, "k1": "6e4 N m/rad", "k2": 4e4, "c1": 0.3464, "c2": 0.1414}
GEARS = {
    **{"J_x": 0.02, "J_y": 0.08, "r_x": "50 mm", "r_y": "100 mm", "torque_mean": 50, "torque_amplitude": 30},
    **{"order": 2, "backlash": "0.1 mm", "mesh_stiffness": 2e8, "damping_ratio": 0.05, "alpha": 0},
}
SHAFT = {
    **{"length": ["300 mm", "1200 mm", "300 mm"], "outer_diameter": ["60 mm", "90 mm", "60 mm"]},
    **{"inner_diameter": [0, "82 mm", 0], "material": "steel", "k_A": 5e6, "k_D": 5e6},
}


TRACED = {
    dt.Cardan: {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "c1": 0.3464, "c2": 0.1414, "angle": 12.0, "speed": 1425.0},
    dt.Rattle: GEARS | {"r_x": 0.05, "r_y": 0.1, "backlash": 1e-4, "speed": 900.0},
    dt.Bicardan: {
        "outer_diameter": [0.06, 0.09], "inner_diameter": [0.0, 0.082], "E": 2.1e11, "G": 8e10, "density": 7850.0,
        "length": [0.3, 1.2], "k_A": 5e6, "k_D": 5e6,
    },
    dt.Planetary: {"teeth": [20, 26, 72], "planet_angle": [0.0, 1.3, 2.4, 4.1]},
}  # fmt: skip


def cardan(analysis="floquet", **tables):
    return {"system": "cardan", "analysis": analysis, **tables}


def refused(scene):
    with pytest.raises(dt.InputError) as error:
        load_scene(scene)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("system", TRACED)
def test_traced_data_give_the_same_parameters_and_their_slopes(system):
    data = {n: jax.tree.map(float, v) for n, v in TRACED[system].items() if n != "teeth"}
    words = {"teeth": TRACED[system]["teeth"]} if system is dt.Planetary else {}

    def parameters(data):
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves(system.from_physical(**words, **data))])

    def traced(data):
        return jax.tree.leaves(system.from_physical(**words, **data))

    expected = parameters(data)
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in jax.jit(traced)(data)]), expected, rtol=1e-14)
    leaves, tree = jax.tree.flatten(data)
    directions = np.random.default_rng(0).normal(size=len(leaves))
    step = [1e-6 * x * d for x, d in zip(leaves, directions, strict=True)]
    up, down = (tree.unflatten([x + sign * h for x, h in zip(leaves, step, strict=True)]) for sign in (1, -1))
    slope = jax.jvp(traced, (data,), (tree.unflatten(step),))[1]
    change = (parameters(up) - parameters(down)) / 2
    np.testing.assert_allclose(np.concatenate([np.ravel(x) for x in slope]), change, rtol=1e-6, atol=1e-12)


def test_a_scene_is_not_traced():
    for call in (
        lambda x: dt.point("cardan", "floquet", **TRUCK, angle=x, speed=1425.0),
        lambda x: dt.run(cardan(fixed=TRUCK | {"angle": x, "speed": 1425.0})),
    ):
        with pytest.raises(
            dt.InputError, match=r"^scene: does not work under jax\.jit, jax\.grad or jax\.vmap; expected"
        ):
            jax.jit(call)(12.0)


def test_a_chart_in_rpm_and_degrees(tmp_path):
    edges = [1421, 1422, 1429, 1430, 2270, 2271, 2288, 2289, 3126, 3127, 3142, 3143]
    scene = cardan(axes={"angle": ["12 deg"], "speed": {"values": edges}}, fixed=TRUCK)
    dt.run(scene, out=tmp_path / "r.nc")
    chart = xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf")
    assert chart.verdict.dims == ("angle", "speed") and chart.speed.attrs["units"] == "rpm"
    assert chart.verdict.values[0].tolist() == [0, 1, 1, 0] * 3
    assert chart.Omega.dims == ("speed",) and chart.beta.dims == ("angle",)
    assert chart.Omega.values == pytest.approx(np.array(edges) * math.pi / 30 * math.sqrt(2 / 6e4), rel=1e-14)
    assert json.loads(chart.attrs["roles"]) == {"speed": "speed", "angle": "angle", "damping": "zeta"}
    assert json.loads(chart.attrs["physical_data"])["J2"]["value"] == 0.5
    again = dt.run(scene, out=tmp_path / "r.nc")
    assert again.attrs["digest"] == chart.attrs["digest"]


def test_an_axis_keeps_the_unit_in_which_it_is_given():
    scene = load_scene(
        cardan(axes={"speed": {"start": "10 Hz", "stop": "3000 rpm", "num": 3}}, fixed=TRUCK | {"angle": 12})
    )
    (axis,) = scene.axes
    assert axis.shown.values.tolist() == [10, 30, 50] and axis.shown.parameter.units == "Hz"
    assert axis.values == pytest.approx(np.array([10, 30, 50]) * 2 * math.pi * math.sqrt(2 / 6e4), rel=1e-14)


def test_a_unit_without_its_radian_is_known_on_an_axis():
    """The tables of a scene write the radian or not, as fixed values do."""
    fixed = {name: value for name, value in TRUCK.items() if name != "k1"} | {"angle": 12, "speed": 1000}
    written, bare = (
        load_scene(cardan(axes={"k1": [f"50 {unit}", f"60 {unit}"]}, fixed=fixed)).axes[0]
        for unit in ("kN m/rad", "kN m")
    )
    np.testing.assert_array_equal(written.values, bare.values)
    assert bare.shown.values.tolist() == [50, 60] and bare.shown.parameter.units == "kN m"


@pytest.mark.full
def test_a_range_of_the_physical_speed_has_the_tongues_of_the_parameter():
    """C+ is a fifteen-thousandth of the range wide: only its prediction tells where to look."""
    shaft = {"J1": 2, "J2": 200.0, "k1": 6e4, "k2": 6e4, "c1": 0.02, "c2": 0.02, "angle": 8}
    said = dt.point("cardan", "floquet", speed=("496.196 rpm", "3638.77 rpm"), **shaft).sentence
    assert said.startswith("Unstable at speed = 1229.38 to 1229.46 (C+1), 2336.32 to 2347.77 (S21) rpm; the rest")


@pytest.mark.full
def test_one_quantity_may_change_several_parameters():
    scene = cardan("forced", axes={"J1": [1.0, 2.0]}, fixed=TRUCK | {"angle": 12, "speed": 1000}, outputs=["amplitude"])
    del scene["fixed"]["J1"]
    found = dt.run(scene)
    assert found.amplitude.dims == ("J1", "shaft")
    assert all(found[name].dims == ("J1",) for name in ("Omega", "zeta", "gamma"))
    for i, inertia in enumerate((1.0, 2.0)):
        alone = dt.forced(
            dt.Cardan.from_physical(**TRUCK | {"J1": inertia}, angle=12, speed=1000), outputs=["amplitude"]
        )
        assert found.amplitude.values[i] == pytest.approx(np.asarray(alone.amplitude), rel=1e-9)


@pytest.mark.full
def test_points_may_vary_any_data():
    points = {"speed": [1425, 1000], "J1": [2.0, 1.0], "angle": ["12 deg", 10]}
    fixed = {name: value for name, value in TRUCK.items() if name != "J1"}
    found = dt.run(cardan(points=points, fixed=fixed, outputs=["spectral_radius"]))
    assert found.spectral_radius.dims == ("point",) and found.J1.values.tolist() == [2.0, 1.0]
    assert found.angle.attrs["units"] == "deg" and found.gamma.values.tolist() == [0.25, 0.5]
    one = dt.point("cardan", "floquet", **fixed, J1=1.0, speed=1000, angle=10).spectral_radius
    assert found.spectral_radius.values[1] == pytest.approx(one, rel=1e-9)


def test_what_is_wrong_with_data_of_a_scene():
    speed = {"speed": [100, 200]}
    assert refused(cardan(axes=speed, fixed={"angle": 3})).startswith(
        "J1: missing; Omega = speed sqrt(J1/k1) needs J1 and"
    )
    both = refused(
        cardan(axes=speed | {"J1": [1, 2]}, fixed={n: v for n, v in TRUCK.items() if n != "J1"} | {"angle": 3})
    )
    assert both == "axes.J1: changes Omega together with speed; expected one of them as an axis, or both in [points]"
    assert "expected one of the two" in refused(cardan(axes=speed, fixed=TRUCK | {"angle": 3, "beta": 0.1}))
    unused = {"beta": 0.1, "Omega": 1.0, "zeta": 0.0, "alpha": 1.0, "mu": 1.0, "gamma": 1.0, "J1": 2}
    assert refused(cardan(axes={}, fixed=unused)).startswith("J1: nothing follows from it (Omega needs speed, J1, k1;")
    assert "or physical data: angle" in refused(cardan(axes=speed, fixed=TRUCK))
    ranges = {"c1": {"start": 0.1, "stop": 1}}
    fixed = {name: value for name, value in TRUCK.items() if name != "c1"} | {"angle": 3, "speed": 100}
    assert refused(cardan("atlas", axes=ranges, fixed=fixed)).startswith(
        "axes.c1: changes zeta and alpha together; expected an atlas over one of them: fix alpha in place of the data behind"
    )
    with pytest.raises(dt.InputError, match=r"axes\.c1 changes zeta, alpha together; expected auto and direct"):
        dt.run(cardan(axes={"c1": [0.1, 0.2]}, fixed=fixed, options={"method": "atlas"}))


@pytest.mark.full
def test_gears_rest_where_the_mean_torque_presses_them():
    """Without a harmonic torque: u = b + T/(r_x k). The parameters: two rigid gears, the load balances the mean torque."""
    gears = dt.Rattle.from_physical(**GEARS, speed=3000)
    assert gears.omega == pytest.approx(2 * 100 * math.pi) and gears.b == pytest.approx(5e-5)
    assert 1 / gears.I == pytest.approx(0.05**2 / 0.02 + 0.1**2 / 0.08)
    assert gears.B1 == pytest.approx(30 * 0.05 / 0.02) and gears.c == pytest.approx(2 * 0.05 * math.sqrt(2e8 * gears.I))
    found = dt.point(
        "rattle", "steady_state", **GEARS | {"torque_amplitude": 0}, speed=3000, outputs=["u_max", "u_min"]
    )
    assert [found.u_max, found.u_min] == pytest.approx([5e-5 + 50 / (0.05 * 2e8)] * 2, rel=1e-9)


def test_two_gears_move_as_the_oscillator():
    """The accelerations of both gears in contact, from Newton's law with the load torque on the driven one."""
    gears, u, v = dt.Rattle.from_physical(**GEARS, speed=3000), 7e-5, 1e-3
    force = 2e8 * (u - 5e-5) + gears.c * v
    t, load = 0.3, 50 * 0.1 / 0.05
    driving = (50 + 30 * math.cos(gears.omega * t) - 0.05 * force) / 0.02
    driven = (0.1 * force - load) / 0.08
    found = gears.vector_field(t, np.array([u, v]))
    assert float(found[1]) == pytest.approx(0.05 * driving - 0.1 * driven, rel=1e-12)


@pytest.mark.full
def test_tubes_are_stiffnesses_and_turns_excite_twice():
    tube = [math.pi / 32 * 2.1e11 / 2.6 * (0.09**4 - 0.08**4) / length for length in (1.2, 0.8)]
    data = {name: value for name, value in TRUCK.items() if name not in ("k1", "k2")} | {"angle": 12.0, "speed": 2000.0}
    tubes = {"outer_diameter": "90 mm", "inner_diameter": "80 mm", "length": ["1200 mm", 0.8], "material": "steel"}
    found = dt.Cardan.from_physical(**data, **tubes).values
    exact = dt.Cardan.from_physical(**data, k1=tube[0], k2=tube[1]).values
    assert found == pytest.approx(exact, rel=1e-14)
    scene = load_scene(
        cardan(axes={"outer_diameter[1]": ["85 mm", "90 mm"]}, fixed=data | tubes | {"outer_diameter": [0.09, 0.09]})
    )
    assert scene.axes[0].name == "mu" and scene.axes[0].values[1] == pytest.approx(1.5, rel=1e-14)
    assert scene.data["length"] == (1.2, 0.8) and "k2" not in scene.data
    given, values = in_parameters(dt.Cardan, {"speed": 1000.0}, load_scene(cardan(axes={}, fixed=data | tubes)).data)
    assert given.quantity("mu", 1.5)[1] == pytest.approx(tube[1], rel=1e-14)
    assert values["Omega"] == pytest.approx(exact["Omega"] / 2, rel=1e-14)
    with pytest.raises(dt.InputError, match="length: got 3 shafts; expected two, the driving and the driven one"):
        dt.Cardan.from_physical(**data, **tubes | {"length": [1.0, 1.0, 1.0]})
    shaft = dt.Tripod.from_physical(element="input", beta=0.157, zeta=0.002, speed=1200.0)
    assert shaft.excitation_frequency == 40.0


def test_a_frequency_response_over_the_speed():
    scene = {"system": "rattle", "analysis": "frequency_response", "fixed": GEARS, "outputs": ["u_max"]}
    (axis,) = load_scene({**scene, "axes": {"speed": {"start": 600, "stop": 6000, "num": 5}}}).axes
    assert (axis.name, axis.shown.parameter.name) == ("omega", "speed")
    assert axis.values == pytest.approx(np.linspace(600, 6000, 5) * 2 * math.pi / 30, rel=1e-14)
    message = refused({**scene, "axes": {"k": [1e8, 2e8]}, "fixed": GEARS | {"speed": 600}})
    assert message == "k = axis k: given besides mesh_stiffness; expected one of the two"


def test_a_stepped_steel_shaft():
    found = dt.point("bicardan", "critical_speeds", **SHAFT, modes=3, outputs=["critical_speed"])
    assert found.critical_speed == pytest.approx([3646, 8088, 13019], rel=2e-4)
    shaft = dt.Bicardan.from_physical(**SHAFT)
    second = math.pi / 64 * (0.09**4 - 0.082**4)
    assert shaft.EI[1] == pytest.approx(2.1e11 * second) and shaft.rhoI[1] == pytest.approx(7850 * second)
    assert shaft.rhoA[0] == pytest.approx(7850 * math.pi / 4 * 0.06**2)
    # Cowper: 6 (1 + nu)/(7 + 6 nu) of a solid circle.
    assert shaft.kGA[0] == pytest.approx(7.8 / 8.8 * 2.1e11 / 2.6 * math.pi / 4 * 0.06**2)
    euler = dt.Bicardan.from_physical(**{n: v for n, v in SHAFT.items() if n != "material"}, E="210 GPa", density=7850)
    assert euler.kGA == () and euler.rhoI == () and euler.EI == pytest.approx(shaft.EI)


@pytest.mark.full
def test_one_diameter_may_vary():
    scene = {"system": "bicardan", "analysis": "critical_speeds", "axes": {"outer_diameter[1]": ["90 mm", "100 mm"]}}
    found = dt.run({**scene, "fixed": SHAFT, "options": {"modes": 1}, "outputs": ["critical_speed"]})
    assert found.critical_speed.dims == ("outer_diameter_1", "mode") and found.outer_diameter_1.values.tolist() == [
        90,
        100,
    ]
    assert found.EI_1.dims == ("outer_diameter_1",) and found.EI_1.attrs["parameter"] == "EI[1]"
    wide = dt.point("bicardan", "critical_speeds", **SHAFT | {"outer_diameter": [0.06, 0.1, 0.06]}, modes=1)
    assert found.critical_speed.values[1] == pytest.approx(wide.critical_speed, rel=1e-9)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (
            {"inner_diameter[1]": [0, 0.04]},
            "fixed.inner_diameter = 0.0: inner_diameter[1] varies one entry; expected a list",
        ),
        ({"outer_diameter[5]": [0.04, 0.05]}, "varies one entry; expected outer_diameter[0] to outer_diameter[2]"),
        (
            {"outer_diameter[1]": [0.04, 0.05], "EI[1]": [1e4, 9e4]},
            "axes.EI[1]: follows from outer_diameter[1], given too",
        ),
    ],
)
def test_every_axis_of_physical_data_has_an_effect(axes, message):
    fixed = SHAFT | {"inner_diameter": 0, "outer_diameter": [0.06, 0.1, 0.06]}
    with pytest.raises(dt.InputError, match=re.escape(message)):
        dt.run({"system": "bicardan", "analysis": "critical_speeds", "axes": axes, "fixed": fixed})


def every_door(given, modes):
    """The critical speeds [rpm] of a shaft from a point, a run and the module; ``dt.run`` is ``drivetrain run``."""
    scene = {"system": "bicardan", "analysis": "critical_speeds", "outputs": ["critical_speed"]}
    return [
        dt.point("bicardan", "critical_speeds", **given, modes=modes, outputs=["critical_speed"]).critical_speed,
        dt.run({**scene, "fixed": given, "options": {"modes": modes}}).critical_speed.values,
        dt.critical_speeds(dt.Bicardan.from_physical(**given), outputs="critical_speed", modes=modes).critical_speed,
    ]


UNIFORM = {"length": ["750 mm", "750 mm"], "outer_diameter": "90 mm", "k_A": 1e8, "k_D": 1e8}


@pytest.mark.full
def test_one_diameter_stands_for_all_segments():
    for found in every_door(UNIFORM | {"material": "steel"}, 2):
        assert found == pytest.approx([4671.14, 16452.8], rel=1e-6)
    lists = UNIFORM | {"material": "steel", "outer_diameter": np.array([0.09, 0.09])}
    assert dt.Bicardan.from_physical(**lists) == dt.Bicardan.from_physical(**UNIFORM, material="steel")
    axes = {"outer_diameter": ["80 mm", "90 mm"]}
    fixed = {name: value for name, value in UNIFORM.items() if name != "outer_diameter"} | {"material": "steel"}
    scene = load_scene({"system": "bicardan", "analysis": "critical_speeds", "axes": axes, "fixed": fixed})
    assert [part.name for part in scene.axes[0].together] == [
        f"{name}[{i}]" for name in ("EI", "rhoA", "kGA", "rhoI", "rhoIp") for i in (0, 1)
    ]


@pytest.mark.full
@pytest.mark.parametrize("mass", [{"density": 0}, {"rhoA": [0, 0]}])
def test_a_shaft_without_mass_has_a_diameter(mass):
    """The mass vibrates on the spring of its support and, in series, of the bent shaft and of the ends."""
    given = UNIFORM | {"E": 2.1e11, "k_joint": [1e6], "m_joint": [10.0]} | mass
    bent = 48 * 2.1e11 * math.pi / 64 * 0.09**4 / 1.5**3
    speed = math.sqrt((1 / (1 / bent + 1 / 2e8) + 1e6) / 10) * 30 / math.pi
    for found in every_door(given, 1):
        assert found == pytest.approx([speed], rel=1e-9)


def test_mass_is_given_once():
    steel = dt.Bicardan.from_physical(**UNIFORM, material="steel", rhoA=[10, 0])
    assert steel.rhoA == (10, 0) and steel.rhoI == pytest.approx((10 * 0.09**2 / 16, 0)) and steel.kGA[0] > 0
    twice = UNIFORM | {"E": 2.1e11, "density": 7850, "rhoA": [10, 10]}
    with pytest.raises(dt.InputError, match=r"^density: nothing follows from it \(rhoA needs"):
        dt.Bicardan.from_physical(**twice)
    assert "density: nothing follows from it" in refused(
        {"system": "bicardan", "analysis": "critical_speeds", "fixed": twice}
    )


def test_a_length_that_looks_like_millimetres_is_warned_of():
    with pytest.warns(UserWarning, match=r'^length\[1\] = 900 m: more than 100 m; is "900 mm" meant\?$'):
        dt.Bicardan(length=[0.3, 900], EI=[1e4, 1e4], rhoA=[15, 15], k_A=1e6, k_D=1e6)


def test_one_number_of_teeth_may_vary():
    gear = {"system": "planetary", "analysis": "modes", "fixed": {"teeth": [20, 26, 72], "planet_angle": [0, 2, 4]}}
    axis = load_scene(gear | {"axes": {"teeth[0]": [18, 20]}}).axes[0]
    assert "phase_s[2]" in [part.name for part in axis.together]
    for planets in ({}, {"planet_angle": [0, 2, 4]}):
        without = gear | {"fixed": {"teeth": [20, 26, 72]} | planets, "axes": {"teeth[1]": [26, 28]}}
        assert refused(without) == "axes.teeth[1]: no parameter follows from it in this scene; leave it out"


@pytest.mark.full
def test_teeth_give_orders_and_phases():
    found = dt.run(
        {"system": "planetary", "analysis": "modes", "fixed": {"teeth": [20, 26, 72]}, "axes": {"k_sp": [5e8]}}
    )
    data = json.loads(found.attrs["physical_data"])
    assert data["carrier_order"]["value"] == 72 and data["sun_order"]["value"] == pytest.approx(72 * 20 / 92)
    angles = [0.0, 1.0, 2.1, 4.4]
    gear = dt.Planetary.from_physical(teeth=[20, 26, 72], planet_angle=angles)
    turns = np.array([np.exp(1j * np.array(gear.phase_s)), np.exp(1j * np.array(gear.phase_r))])
    assert turns == pytest.approx(np.exp(1j * np.outer([-20, 72], angles)))
    assert "teeth = [20, 60, 72]" in refused(
        {"system": "planetary", "analysis": "modes", "fixed": {"teeth": [20, 60, 72]}, "axes": {"k_sp": [5e8]}}
    )
