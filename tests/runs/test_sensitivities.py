"""Sensitivities in physical units, sorted, and what a verdict means, against direct solves of changed shafts."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import brentq

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.runs import atlas_answers
from tests.atlases import stored_atlas
from tests.sizes import full_after

DATA = {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "c1": 0.3464, "c2": 0.1414, "angle": 12.0}
SCENE = {"system": "cardan", "analysis": "atlas", "fixed": DATA}


@pytest.fixture(scope="module")
def atlas():
    return stored_atlas(SCENE | {"axes": {"speed": {"start": "3080 rpm", "stop": "3200 rpm"}}})


def radius(data: dict) -> float:
    return float(dt.floquet(dt.Cardan.from_physical(**data), outputs="spectral_radius").spectral_radius)


def boundary(data: dict, near: float) -> float:
    """The speed [rpm] at which the spectral radius is 1, from solves without an atlas."""
    return brentq(lambda speed: radius(data | {"speed": speed}) - 1, near - 2, near + 2, xtol=1e-9)


@pytest.mark.full
def test_limits_move_as_those_of_changed_shafts(atlas):
    found = atlas_answers.speed_windows(atlas, {})
    window = found.data["windows"][0]
    effects = {each["name"]: each for each in window["sensitivities"][1]}
    assert list(effects) == sorted(effects, key=lambda name: -abs(effects[name]["percent"])) and len(effects) == 7
    limit = window["physical"]["speed"]["value"][1]
    for name in ("k2", "J1", "angle", "c1"):
        up, down = (boundary(DATA | {name: DATA[name] * (1 + h)}, limit) for h in (1e-4, -1e-4))
        assert effects[name]["percent"] == pytest.approx((up - down) / 2e-4 / 100, rel=1e-4), name
        assert effects[name]["slope"] * DATA[name] == pytest.approx(100 * effects[name]["percent"], rel=1e-12)
    # Twice the stiffness and the damping of both shafts, and twice the inertia, cancel.
    assert sum(each["percent"] for each in effects.values() if each["name"] != "angle") == pytest.approx(0, abs=1e-6)
    assert f"at the upper end: +1 % of a value changes speed by [rpm]: {next(iter(effects))} +" in str(found)


@pytest.mark.full
def test_limits_move_in_the_unit_of_their_answer(atlas):
    hertz = np.sqrt(DATA["k1"] / DATA["J1"]) / (2 * np.pi)
    found = atlas_answers.speed_windows(
        atlas, {}, show=lambda name, x: ("speed", x * hertz, "Hz") if name == "Omega" else (name, x, "1")
    )
    first = found.data["windows"][0]["sensitivities"][1][0]
    said = f"+1 % of a value changes speed by [Hz]: {first['name']} {first['percent'] / 60:+.3g}, "
    assert first["name"] == "k2" and said in str(found)


@pytest.mark.full
def test_sensitivities_of_the_radius_are_sorted_and_physical(atlas):
    found = atlas_answers.query(atlas, {"speed": 3130.0})
    effects = {each["name"]: each for each in found.data["sensitivities"]}
    assert effects.keys() == {*DATA, "speed"} and effects["speed"]["units"] == "rpm"
    sizes = [abs(each["percent"]) for each in found.data["sensitivities"]]
    assert sizes == sorted(sizes, reverse=True)
    for name, value in (DATA | {"speed": 3130.0}).items():
        up, down = (radius(DATA | {"speed": 3130.0} | {name: value * (1 + h)}) for h in (1e-5, -1e-5))
        assert effects[name]["percent"] == pytest.approx((up - down) / 2e-5 / 100, rel=1e-3, abs=1e-8), name
    assert "largest effect of 1 % first" in str(found)


@pytest.mark.full
def test_without_physical_data_the_parameters_are_sorted():
    fixed = {"beta": 0.3, "zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    scene = {"system": "cardan", "analysis": "atlas", "fixed": fixed, "axes": {"Omega": {"start": 1.4, "stop": 1.43}}}
    found = atlas_answers.query(stored_atlas(scene), {"Omega": 1.416}).data
    assert {each["name"]: each["slope"] for each in found["sensitivities"]} == pytest.approx(
        found["gradient"], rel=1e-9
    )


def test_a_verdict_at_a_point_says_what_it_means():
    found = dt.point("cardan", "floquet", **DATA, speed="3130 rpm")
    rate = np.log(found.spectral_radius) * 2 * 3130 / 60
    assert found.growth["rate"] == pytest.approx(rate, rel=1e-12)
    assert found.growth["per_turn"] == pytest.approx(found.spectral_radius**2, rel=1e-12)
    way = "double" if rate > 0 else "halve"
    assert found.growth[f"time_to_{way}"] == pytest.approx(np.log(2) / abs(rate), rel=1e-12)
    assert f"{way}s in" in repr(found) and json.loads(found.to_json())["growth"]["rate"] == pytest.approx(rate)
    # A speed in another unit is the same speed.
    assert dt.point("cardan", "floquet", **DATA, speed="52.1666666666667 Hz").growth["rate"] == pytest.approx(
        rate, rel=1e-9
    )


@pytest.mark.full
def test_a_system_in_seconds_has_a_rate():
    found = dt.point("tripod", "floquet", element="input", beta=0.1, zeta=0.01, excitation_frequency=50.0)
    assert found.growth["rate"] == pytest.approx(np.log(found.spectral_radius) * 50, rel=1e-12)
    assert found.growth.keys() == {"rate", "time_to_halve"} and "per turn" not in repr(found)


def test_undecided_says_what_to_do():
    """Two multipliers are -1 at the foot of an undamped tongue."""
    undamped = {"beta": 0.0, "Omega": 1.41598463971976, "zeta": 0.0, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    found = dt.point("cardan", "floquet", **undamped)
    assert found.verdict == 2 and found.growth == {}
    assert "a smaller rtol than 1e-10 may decide" in repr(found)


def test_a_point_without_result_has_no_sensitivities():
    lost = dt.point(
        "cardan", "floquet", beta=0.3, Omega=1e-300, zeta=0.1, alpha=1.0, mu=1.0, gamma=1e9, sensitivities=True
    )
    assert lost.outcome.name == "STEP_LIMIT" and lost.sensitivities == []
    assert "undecided" in repr(lost) and "spectral radius is 1" not in repr(lost)


@pytest.mark.full
def test_a_point_gives_sensitivities_by_its_physical_data_when_asked(capsys):
    point = DATA | {"speed": 3130.0}
    words = [f"{name}={value}" for name, value in point.items()]
    command = ["point", "cardan", "floquet", *words, "outputs=spectral_radius", "--sensitivities"]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["sensitivities"]
    assert {each["name"] for each in found} == point.keys()
    sizes = [abs(each["percent"]) for each in found]
    assert sizes == sorted(sizes, reverse=True)
    for each in found:
        up, down = (radius(point | {each["name"]: point[each["name"]] * (1 + h)}) for h in (1e-5, -1e-5))
        assert each["percent"] == pytest.approx((up - down) / 2e-5 / 100, rel=1e-3, abs=1e-8), each["name"]
    assert main(command) == 0
    assert f"  {found[0]['name']}" in capsys.readouterr().out.split("largest effect of 1 % first\n")[1].splitlines()[0]
    assert dt.point("cardan", "floquet", **point).sensitivities is None


LINE = {"speed": 100.0, "k": [1e4, 2e4], "c": [0.1, 0.1], "J": [0.1, 1.0]}
SHAFT = {"length": [0.3, 0.9], "outer_diameter": [0.06, 0.08], "inner_diameter": [0.0, 0.07], "material": "steel"}
OF_ANALYSES = [
    ("driveline", "modes", "natural_frequency", LINE, ("k[1]", "J[0]")),
    (
        *("bicardan", "critical_speeds", "critical_speed", SHAFT | {"k_A": 5e6, "k_D": 5e6, "modes": 2}),
        ("outer_diameter[1]", "length[0]", "k_A"),
    ),
    ("cardan", "forced", "amplitude", DATA | {"speed": 1200.0}, ("angle", "speed", "k2")),
    ("rattle", "steady_state", "u_max", dt.Rattle.presets["table1"] | {"omega": 0.7}, ("omega", "B1")),
]


@pytest.mark.parametrize(("system", "analysis", "output", "given", "names"), full_after(1, OF_ANALYSES, several=True))
def test_sensitivities_of_any_result_are_central_differences(system, analysis, output, given, names):
    def changed(name, step):
        name, _, entry = name.partition("[")
        value = given[name]
        if entry:
            value = [x * (1 + step) if k == int(entry[:-1]) else x for k, x in enumerate(value)]
        else:
            value *= 1 + step
        return np.asarray(dt.point(system, analysis, outputs=[output], **given | {name: value})[output])

    found = dt.point(system, analysis, outputs=[output], sensitivities=True, **given)
    effects = {effect.name: effect for effect in found.sensitivities}
    assert {effect.output for effect in found.sensitivities} == {output} and list(found) == [output]
    for name in names:
        difference = (changed(name, 1e-5) - changed(name, -1e-5)) / 2e-3
        np.testing.assert_allclose(effects[name].percent, difference, rtol=1e-5, atol=1e-9 * np.max(found[output]))
    told = f"change of {output}" if np.ndim(found[output]) else f"gradient of {output}"
    assert told in repr(found) and json.loads(found.to_json())["sensitivities"][0]["output"] == output


@pytest.mark.parametrize(
    ("analysis", "options", "message"),
    [
        ("lyapunov", {}, "sensitivities: lyapunov has no derivatives; expected floquet or history or forced"),
        ("floquet", {"outputs": ["verdict"]}, r"outputs = \['verdict'\]: without sensitivities; expected one of"),
    ],
)
def test_sensitivities_without_a_derivative_are_refused(analysis, options, message):
    with pytest.raises(dt.InputError, match=f"^{message}"):
        dt.point("cardan", analysis, **DATA, speed=1200.0, sensitivities=True, **options)
