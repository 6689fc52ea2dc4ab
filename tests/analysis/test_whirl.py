"""Whirl of shafts with discs against 50-digit values, closed forms and finite elements, and its count."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds.coupled import directions
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots
from drivetrain_jax.analysis.critical_speeds.whirl import _whirl
from drivetrain_jax.resonances import orders_of
from drivetrain_jax.systems import Shaft
from tests.oracles.whirl_reference import whirl
from tests.sizes import full_after
from tests.view.results import legend, texts

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "whirl.json").read_text())
CASES = REFERENCE["closed_forms"] | REFERENCE["rotors"]
MODES, BATCH = 8, 4
DIRECTIONS = ("backward", "planar", "forward")


def parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    """The input of a reference value by the names of the package, every shaft in three segments."""
    names = {"ky_A": "k_A_y", "ky_D": "k_D_y", "ky_joint": "k_joint_y"}
    values: dict[str, Any] = {
        names.get(name, name): math.inf if value == "inf" else value
        for name, value in given.items()
        if name != "diameter"
    }
    parts = {1: (3,), 2: (2, 1), 3: (1, 1, 1)}[len(values["length"])]
    split = {}
    for name, value in values.items():
        if not isinstance(value, list):
            split[name] = value
        elif len(value) == len(parts):
            pieces = [x / n if name == "length" else x for x, n in zip(value, parts, strict=True) for _ in range(n)]
            split[name] = tuple(pieces)
        else:
            split[name] = ((0.0,) if parts == (2, 1) else ()) + tuple(value)
    return split


def spinning(values: Mapping[str, Any], speed: float = 0.0, order: float = math.inf) -> Shaft:
    """The shaft with every field that some case needs, so that all cases share one compilation; speed < 0: backward."""
    shaft = dt.Bicardan(**{**values, "speed": abs(speed)}).shaft()
    joints = jnp.zeros(4)
    none = {"m": joints, "k_rot": joints, "inertia": joints, "polar": joints, "kGA": jnp.full(3, jnp.inf)}
    none |= {"rhoI": joints[1:], "rhoIp": joints[1:], "k_hinge": jnp.full(2, jnp.inf)}
    filled = {name: x if getattr(shaft, name) is None else getattr(shaft, name) for name, x in none.items()}
    return shaft._replace(**filled, spin=jnp.array([speed, 1 / order]))


@jax.jit
def search(shaft: Shaft) -> tuple[jax.Array, ...]:
    roots = find_roots(shaft, 12)
    return roots.q**2, roots.certified


@jax.jit
def solve(shaft: Shaft) -> tuple[jax.Array, ...]:
    roots, direction = _whirl(shaft, MODES)
    return roots.q**2, roots.certified, direction


def of_all(function: Callable[[Shaft], tuple[jax.Array, ...]], shafts: list[Shaft]) -> list[np.ndarray]:
    """Results of ``function`` in batches of one size, for one compilation; the lanes are the last axis."""
    padded = shafts + shafts[:1] * (-len(shafts) % BATCH)
    batches = [padded[i : i + BATCH] for i in range(0, len(padded), BATCH)]
    found = [function(jax.tree.map(lambda *fields: jnp.stack(fields, axis=-1), *batch)) for batch in batches]
    return [np.concatenate(parts, axis=-1)[..., : len(shafts)] for parts in zip(*found, strict=True)]


ISOTROPIC = [name for name in CASES if not name.startswith("anisotropic")]
ANISOTROPIC = [name for name in CASES if name.startswith("anisotropic")]


@pytest.mark.full
def test_every_reference_value_to_rounding():
    """Brackets close at 4 units in the last place of sqrt(omega), and the inputs are rounded to 53 bits: 4e-15 together."""
    shafts, expected, labels = [], [], []
    for name in ISOTROPIC:
        values = parameters(CASES[name]["input"])
        for row in CASES[name]["whirl"]:
            signed = np.array(row["signed"] if "signed" in row else [*row["forward"], *(-x for x in row["backward"])])
            for sense in (1.0, -1.0):
                shafts.append(spinning(values, sense * row["Omega"]))
                expected.append(np.sort(np.abs(signed[signed * sense > 0])))
                labels.append((name, sense, row["Omega"]))
        for order, speeds in CASES[name].get("critical", {}).items():
            shafts.append(spinning(values, order=int(order)))
            expected.append(np.array(speeds) * abs(int(order)))
            labels.append((name, "order", order))
    p, certified = of_all(search, shafts)
    assert np.all(certified)
    for lane, (values, label) in enumerate(zip(expected, labels, strict=True)):
        np.testing.assert_allclose(p[: len(values), lane], values, rtol=4e-15, err_msg=str(label))
        massless = label[0] in ("overhung_massless", "jeffcott_offset", "jeffcott_offset_rigid")
        complete = massless or label[:2] == ("simply_supported_rayleigh", "order")
        assert np.all(np.isinf(p[len(values) :, lane]) == complete), label


@pytest.mark.full
@pytest.mark.parametrize("speeds", [(0.0, 600.0), (200.0, 1500.0)])
def test_unequal_supports_to_rounding(speeds):
    """The elimination of 28 unknowns adds some roundings to those of the segments: 2e-14."""
    rows = [(name, row) for name in ANISOTROPIC for row in CASES[name]["whirl"] if row["Omega"] in speeds]
    shafts = [spinning(parameters(CASES[name]["input"]), row["Omega"]) for name, row in rows]
    p, certified, codes = of_all(solve, shafts)
    assert np.all(certified)
    for lane, (_, row) in enumerate(rows):
        values = np.sort(row.get("frequency", row.get("signed")))
        np.testing.assert_allclose(p[: len(values), lane], values, rtol=2e-14)
        assert np.all(np.isinf(p[len(values) :, lane]))
        if "direction" in row:
            assert [DIRECTIONS[code] for code in codes[:, lane]] == [text.split()[0] for text in row["direction"]]
        else:
            # Translations are planar; tilts with Y/X < 0 whirl backward.
            assert codes[:4, lane].tolist() == ([1] * 4 if row["Omega"] == 0 else [1, 1, 0, 2])


@pytest.mark.full
def test_directions_of_unequal_supports():
    case = CASES["anisotropic"]
    shafts = [spinning(parameters(case["input"]), row["Omega"]) for row in case["whirl"]]
    (found,) = of_all(jax.jit(lambda shaft: (directions(shaft, find_roots(shaft, MODES).q),)), shafts)
    for lane, row in enumerate(case["whirl"]):
        np.testing.assert_allclose(found[:, lane], row["mass_weighted_direction"], atol=1e-9)


@pytest.mark.parametrize("order", full_after(1, (2, 1, -1)))
def test_critical_speeds_of_an_order(order):
    """An unbalance does not excite the tilt of a disc with I_p > I_d: one critical speed of order 1, but two backward."""
    case = CASES["overhung_massless"]
    rotor, outputs = (
        dt.Bicardan(**parameters(case["input"])),
        ["critical_speed", "natural_frequency", "count_certified"],
    )
    found = dt.critical_speeds(rotor, outputs=outputs, order=order, modes=3)
    speeds = case["critical"][str(order)]
    assert np.all(found.count_certified) and np.all(np.isinf(found.critical_speed[len(speeds) :]))
    np.testing.assert_allclose(found.critical_speed[: len(speeds)] * math.pi / 30, speeds, rtol=4e-15)
    np.testing.assert_allclose(found.natural_frequency * 60, found.critical_speed * abs(order), rtol=1e-15)


@pytest.mark.full
def test_a_shaft_at_rest_has_its_natural_frequencies_twice():
    rotor = dt.Bicardan(**parameters(CASES["two_discs"]["input"]))
    at_rest = dt.critical_speeds(rotor, outputs="angular_frequency", modes=4).angular_frequency
    still = dt.whirl(rotor)
    np.testing.assert_allclose(still.whirl_frequency, np.repeat(at_rest, 2), rtol=2e-15)
    assert still.whirl_direction.tolist() == [0, 2] * 4


@pytest.mark.full
@pytest.mark.parametrize("unequal", [False, True])
def test_gradients_of_an_overhung_disc(unequal):
    """From the characteristic polynomial of whirl.md, (k11 - m w^2)(k22 - I_d w^2 + I_p speed w) = k12^2."""
    case, speed = CASES["overhung_massless"], 600.0
    values = parameters(case["input"]) | ({"k_A_y": math.inf, "k_D_y": 0.0} if unequal else {})

    def polynomial(w: float, x: Mapping[str, float]) -> float:
        k = x["EI"] / 0.4**3 * np.array([12.0, -6.0 * 0.4, 4.0 * 0.4**2])
        return (k[0] - x["m_D"] * w**2) * (k[2] - x["I_D"] * w**2 + x["Ip_D"] * x["speed"] * w) - k[1] ** 2

    at = {name: float(values[name]) for name in ("m_D", "I_D", "Ip_D")} | {"EI": 3e4, "speed": speed}
    roots = sorted(next(row["signed"] for row in case["whirl"] if row["Omega"] == speed), key=abs)

    def frequencies(x: Mapping[str, jax.Array]) -> jax.Array:
        rotor = dt.Bicardan(**{**values, **x, "EI": (x["EI"],) * 3})
        return dt.whirl(rotor, modes=4).whirl_frequency

    found = jax.jit(jax.jacfwd(frequencies))({name: jnp.asarray(x) for name, x in at.items()})
    for name, x in at.items():
        for mode, w in enumerate(roots):
            steps = [polynomial(w, at | {name: x * (1 + s)}) - polynomial(w, at | {name: x * (1 - s)}) for s in (1e-4,)]
            slope = steps[0] / 2e-4 / x
            along = (polynomial(w * (1 + 1e-6), at) - polynomial(w * (1 - 1e-6), at)) / 2e-6 / w
            expected = -np.sign(w) * slope / along
            assert found[name][mode] == pytest.approx(expected, rel=1e-7), (name, mode)


def random_rotor(rng: np.random.Generator, held: bool = True) -> dict[str, Any]:
    """A Timoshenko shaft with contrasts of hundreds, discs up to thin ones, joints and supports of every kind."""

    def each(low: float, high: float, count: int) -> np.ndarray:
        return 10 ** rng.uniform(low, high, count)

    def springs(low: float, high: float, count: int) -> tuple[float, ...]:
        return tuple(float(rng.choice([0.0, math.inf, *each(low, high, 2)])) for _ in range(count))

    rhoA, inertia = each(0, 1.7, 3), each(-3, 0, 4)
    rhoI, polar = rhoA * each(-3.4, -2, 3), inertia * rng.uniform(0, 2, 4)
    k, unequal = np.array(springs(4, 9, 4)), each(-1.5, 1.5, 4)
    k[0] = 1e6 if held else 0.0
    second = np.where(np.isfinite(k), k * unequal, k)
    values = {"k_joint": k[1:3], "k_joint_y": second[1:3], "k_hinge": springs(2, 6, 2), "m_joint": each(-1, 1.5, 2)}
    values |= {"length": each(-1, 0, 3), "EI": each(3.5, 5.5, 3), "rhoA": rhoA, "kGA": each(6, 9, 3)}
    values |= {"rhoI": rhoI, "rhoIp": 2 * rhoI, "I_joint": inertia[1:3], "Ip_joint": polar[1:3]}
    ends = {"k_A": k[0], "k_D": k[3], "k_A_y": second[0], "k_D_y": second[3], "k_rot_A": 1e5 if held else 0.0}
    ends |= {"I_A": inertia[0], "I_D": inertia[3], "Ip_A": polar[0], "Ip_D": polar[3]}
    lists = {name: tuple(np.asarray(x).tolist()) for name, x in values.items()}
    return lists | {name: float(x) for name, x in ends.items()} | {"speed": float(each(0, 4, 1)[0])}


@pytest.mark.full
def test_random_shafts_against_finite_elements_and_the_other_count():
    """No frequency is missed: finite elements find the same ones. Both counts agree on isotropic supports."""
    rng = np.random.default_rng(5)
    cases = [random_rotor(rng) for _ in range(120)]
    isotropic = [{name: x for name, x in case.items() if not name.endswith("_y")} for case in cases]
    shafts = [spinning(case, case["speed"]) for case in isotropic]
    backward = [spinning(case, -case["speed"]) for case in isotropic]
    merged = np.sort(np.concatenate([of_all(search, each)[0][:MODES] for each in (shafts, backward)]), axis=0)[:MODES]
    coupled, certified, _ = of_all(solve, [shaft._replace(k_y=shaft.k) for shaft in shafts])
    assert certified.all()
    np.testing.assert_allclose(coupled, merged, rtol=2e-13)
    found, certified, codes = of_all(solve, [spinning(case, case["speed"]) for case in cases])
    assert certified.all()
    # Finite elements lose the digits of a shaft with a free motion.
    held = np.flatnonzero((merged > 0).all(axis=0) & (found > 0).all(axis=0))
    assert held.size > 100
    for lane in held:
        for p, values in ((merged, isotropic[lane]), (found, cases[lane])):
            elements, sense = whirl(values, MODES, 14)
            np.testing.assert_allclose(p[:, lane], elements, rtol=1e-7, err_msg=str(values))
        clear = np.abs(sense) > 1e-3
        assert np.all((codes[:, lane] == 1 + np.sign(sense))[clear])


FREE = {"length": (0.3, 0.4, 0.3), "EI": (2e7,) * 3, "rhoA": (5.0,) * 3, "k_A": 0.0, "k_D": 0.0, "speed": 300.0}
FREE |= {"m_joint": (3.0, 4.0), "I_joint": (0.1, 0.2), "Ip_joint": (0.19, 0.39)}


def test_free_shafts_have_their_zero_modes():
    """Translations of both planes and one of two tilts are at rest; the other one is a slow precession."""
    shafts = [spinning(FREE, sense * 300.0) for sense in (1.0, -1.0)] + [spinning(FREE, order=1)]
    p, certified = of_all(search, shafts)
    # Order 1: the masses of the shaft keep the inertia of its tilt positive.
    assert certified.all() and np.count_nonzero(p == 0, axis=0).tolist() == [1, 2, 2]
    mass, about = 5.0 + 7.0, np.array([0.5, 0.3, 0.7])
    centre = np.array([5.0, 3.0, 4.0]) @ about / mass
    inertia = 5.0 / 12 + np.array([5.0, 3.0, 4.0]) @ (about - centre) ** 2 + 0.3
    assert p[1, 0] == pytest.approx(300.0 * 0.58 / inertia, rel=1e-4)


@pytest.mark.full
def test_free_shafts_on_unequal_supports_have_their_zero_modes():
    planes = {"k_A_y": 0.0}, {"k_A_y": 1e5}, {"k_A_y": 1e5, "k_D_y": 1e6}, {"k_A": 1e6, "k_A_y": 1e5, "k_D_y": 1e6}
    free, certified, _ = of_all(solve, [spinning(FREE | plane, 300.0) for plane in planes])
    # With a tilt that no spring holds the stiffness is singular at any speed.
    assert certified.all() and np.count_nonzero(free == 0, axis=0).tolist() == [3, 2, 2, 1]


def test_a_campbell_diagram(tmp_path):
    """The scene's curves cross the lines of their orders at the critical speeds of whirl.md."""
    scene = Path(__file__).parents[2] / "sweeps" / "bicardan_whirl.toml"
    result = dt.run(scene, out=tmp_path / "whirl.nc")
    assert np.all(result.outcome == 0) and np.all(result.whirl_count_certified == 1)
    assert result.drivetrain.verify().problem == ""
    figure = dt.plot(result)
    labels = texts(figure)
    # 230.06781739 and 688.74457908 rad/s of order 1, half of 224, 675, ... of order 2, in rpm.
    assert {"2197", "6577"} <= {*labels} and legend(figure)[:2] == ["backward", "forward"]


@pytest.mark.full
def test_a_point_begins_with_whirl_and_critical_speeds():
    """An overhung disc: of (50 EI/L^3 - m p^2) and its tilt the closed forms of docs/theory/bicardan.md."""
    disc = {"length": [0.4], "EI": [3e4], "rhoA": [0.0], "k_A": math.inf, "k_rot_A": math.inf, "k_D": 0.0, "m_D": 12.0}
    found = dt.point("bicardan", "whirl", **disc, I_D=0.09, Ip_D=0.17, speed="2000 rpm", modes=2)
    rates = {"order 1": 1.0, "order 2 (joints)": 2.0, "order -1 (backward)": -1.0}
    stiff = 3e4 * np.array([[12 / 0.4**3, -6 / 0.4**2], [-6 / 0.4**2, 4 / 0.4]])
    speeds = {}
    for name, n in rates.items():
        # The tilt turns with the vibration: its inertia is I - Ip/n.
        squares = scipy.linalg.eigvals(stiff, np.diag([12.0, 0.09 - 0.17 / n])).real
        speeds[name] = np.sqrt(squares[squares > 0].min()) / abs(n) * 30 / np.pi
        np.testing.assert_allclose(found.crossings[name], [speeds[name]], rtol=1e-10)
    turns = np.asarray(found.whirl_frequency) * 30 / np.pi
    assert found.sentence == (
        f"At 2000 rpm the shaft whirls backward at {turns[0]:.6g} rpm, forward at {turns[1]:.6g} rpm; "
        f"critical speeds {'; '.join(f'of {name}: {speed:.6g} rpm' for name, speed in speeds.items())}."
    )
    assert "with the gyroscopic effect" in repr(found)


@pytest.mark.full
def test_equal_planes_whirl_as_one():
    """At rest every frequency is double, and no sense of a pair is that of the other."""
    shaft = {
        "length": [0.3, 0.5],
        "EI": [3e3, 2e3],
        "rhoA": [2.0, 3.0],
        "k_A": 1e5,
        "k_D": 2e5,
        "Ip_A": 2e-3,
        "I_A": 1e-3,
    }
    one, two = (dt.point("bicardan", "whirl", modes=8, speed=0.0, **shaft, **more) for more in ({}, {"k_A_y": 1e5}))
    np.testing.assert_allclose(two.whirl_frequency, one.whirl_frequency, rtol=1e-12)
    np.testing.assert_array_equal(two.whirl_direction, one.whirl_direction)


def test_natural_frequencies_at_rest_are_those_of_the_first_plane():
    orders = orders_of("bicardan", {"k_A_y": 2e6, "Ip_A": 0.1})
    at_rest = "natural frequency at rest, without gyroscopic effect and in the first plane"
    assert orders is not None and orders.frequency == at_rest
    orders = orders_of("bicardan", {"k_joint_y": (0.0,)})
    assert orders is not None and orders.frequency == "natural frequency at rest, in the first plane"


@pytest.mark.full
def test_orders_meet_the_modes_of_both_planes():
    """Without discs they are the critical speeds of two shafts, one on the supports of each plane."""
    shaft = {"length": [0.5], "EI": [2e4], "rhoA": [5.0], "k_A": 1e6, "k_D": 1e6}
    first, second = (dt.critical_speeds(dt.Bicardan(**shaft | {"k_A": k}), modes=2).critical_speed for k in (1e6, 2e6))
    range_ = {"operating_min": 0.99 * second[1], "operating_max": 1.01 * second[1]}
    found = dt.point("bicardan", "critical_speeds", modes=2, **shaft, k_A_y=2e6, **range_)
    np.testing.assert_allclose(found.crossings["order 1"], np.sort([*first, *second]), rtol=1e-12)
    assert f"order 1 meets mode 4 at {second[1]:.6g} rpm" in found.sentence


def test_wrong_input_is_one_line():
    rotor = {"length": (0.5, 0.5), "EI": (1e4,) * 2, "rhoA": (1.0, 0.0), "k_A": 1e6, "k_D": 1e6}
    cases: tuple[tuple[dict[str, Any], dict[str, Any], str], ...] = (
        ({"speed": -1.0}, {}, "speed = -1.0: expected 0 <= speed < inf, in rad/s"),
        ({"rhoIp": (0.1, 0.2)}, {}, r"rhoIp\[1\] = 0.2: expected 0 for a segment without mass"),
        ({"k_joint_y": (1.0, 2.0)}, {}, r"k_joint_y = \[1.0, 2.0\]: 2 entries .* expected one per joint, 1"),
        ({"k_A_y": 1.0}, {"outputs": "mode_shape", "order": 1}, "'mode_shape' is not computed for two planes"),
        ({}, {"order": 101}, "order = 101: expected integer -100 <= order <= 100"),
    )
    for values, options, message in cases:
        with pytest.raises(dt.InputError, match=message):
            dt.critical_speeds(dt.Bicardan(**rotor | values), **options)
