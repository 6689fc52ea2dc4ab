"""Rotary inertia of discs, rotational springs and clamped ends, and segments without mass, against finite elements, closed
forms and transfer matrices in 60 digits."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.critical_speeds.analysis import VARIABLES
from drivetrain_jax.analysis.critical_speeds.compound import characteristic
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots, relative_error
from drivetrain_jax.analysis.critical_speeds.mechanisms import number_of_modes, zero_modes
from drivetrain_jax.systems import Shaft
from tests.analysis.test_critical_speeds import check_identities
from tests.analysis.test_shaft_shapes import everything, exact_node, exact_segment, random_discs
from tests.oracles.bicardan_reference import complete, finite_elements, matrices
from tests.sizes import full_after

INF = math.inf
MODES = 8
BAR = {"length": (1.0,), "EI": (1.0,), "rhoA": (1.0,), "k_A": 0.0, "k_D": 0.0}
# sqrt of the frequencies of a bar: cos z ch z = -1, cos z ch z = 1, tan z = th z.
CLAMPED_FREE = (1.8751040687119611, 4.694091132974175, 7.854757438237613, 10.995540734875467)
CLAMPED_CLAMPED = (4.730040744862704, 7.853204624095838, 10.995607838001671, 14.137165491257464)
CLAMPED_PINNED = (3.926602312047919, 7.068582745628732, 10.210176122813031, 13.351768777754093)
ENDS = {
    "cantilever": ({"k_A": INF, "k_rot_A": INF}, CLAMPED_FREE),
    "cantilever at D": ({"k_D": INF, "k_rot_D": INF}, CLAMPED_FREE),
    "clamped at both ends": ({"k_A": INF, "k_rot_A": INF, "k_D": INF, "k_rot_D": INF}, CLAMPED_CLAMPED),
    "free": ({}, (0.0, 0.0, *CLAMPED_CLAMPED)),
    "clamped and pinned": ({"k_A": INF, "k_D": INF, "k_rot_D": INF}, CLAMPED_PINNED),
    "guided ends": ({"k_rot_A": INF, "k_rot_D": INF}, (0.0, *(math.pi * n for n in range(1, 5)))),
    "guided at A, free at D": ({"k_rot_A": INF}, (0.0, *(x / 2 for x in CLAMPED_CLAMPED[::2]))),
}
TWO_DISCS = {"length": (0.3, 0.5, 0.4), "EI": (2e4,) * 3, "k_A": 4e5, "k_D": 7e5, "m_joint": (20.0, 35.0)}
SHAFT = {"length": (0.4, 0.5, 0.6), "EI": (5e4, 6e4, 3e4), "rhoA": (15.0, 2.8, 5.5), "k_A": 1e6, "k_D": 5e6}
DISCS = SHAFT | {"I_A": 0.3, "I_joint": (0.5, 0.1), "I_D": 0.2, "m_joint": (10.0, 3.0)}
SHEAR = {"kGA": (1e7, 2e7, 1e7), "rhoI": (1e-2, 2e-2, 1e-2)}
CASES = {
    "discs": DISCS,
    "discs at elastic joints": DISCS | {"k_hinge": (1e4, 0.0)},
    "rotational springs": DISCS | {"k_rot_A": 1e5, "k_rot_D": 3e4},
    "clamped, elastic joints": DISCS | {"k_A": INF, "k_rot_A": INF, "k_hinge": (1e4, 2e5)},
    "a light segment": DISCS | {"rhoA": (15.0, 0.0, 5.5)},
    "one segment with mass": DISCS | {"rhoA": (0.0, 3.0, 0.0), "k_hinge": (1e4, INF)},
    "two discs, no other mass": TWO_DISCS | {"rhoA": (0.0,) * 3, "I_joint": (0.4, 0.9)},
    "two masses, no other mass": TWO_DISCS | {"rhoA": (0.0,) * 3},
    "no mass but discs at elastic joints": DISCS | {"rhoA": (0.0,) * 3, "k_hinge": (1e4, 0.0)},
    "no mass but discs, free": DISCS | {"rhoA": (0.0,) * 3, "k_A": 0.0, "k_D": 0.0},
    "shear": DISCS | SHEAR | {"k_rot_D": INF},
    "shear, a light segment": DISCS | SHEAR | {"rhoA": (15.0, 0.0, 5.5), "rhoI": (1e-2, 0.0, 1e-2)},
}


@jax.jit
def solve(shaft: Shaft) -> tuple:
    shaft = shaft.arrays()
    roots = find_roots(shaft, MODES)
    return roots.q, roots.certified, relative_error(shaft, roots), zero_modes(shaft), number_of_modes(shaft)


def bar(values: Mapping) -> Shaft:
    # Without joints.
    return everything(BAR | values)._replace(k_hinge=None)


@jax.jit
def counted(shaft: Shaft, q: jax.Array) -> jax.Array | None:
    return characteristic(shaft.arrays(), q).count


@pytest.mark.parametrize("name", full_after(0, ENDS))
def test_ends_of_a_uniform_bar(name):
    values, expected = ENDS[name]
    q, certified, _, zeros, _ = solve(bar(values))
    assert np.all(certified) and zeros == expected.count(0.0) == np.count_nonzero(q == 0.0)
    np.testing.assert_allclose(q[: len(expected)], expected, rtol=1e-15)


def exact_frequency(v: Mapping, p: float) -> mp.mpf:
    """The zero of the determinant of plain transfer matrices next to ``p``."""

    def determinant(p: mp.mpf) -> mp.mpf:
        state = exact_node(v, 0, p)[:, :2]
        for i, length in enumerate(v["length"]):
            state = exact_node(v, i + 1, p) * (exact_segment(v, i, p, mp.mpf(length)) * state)
        return mp.det(state[2:, :])

    ends = (mp.mpf(p) * (1 - mp.mpf("1e-14")), mp.mpf(p) * (1 + mp.mpf("1e-14")))
    return mp.findroot(determinant, ends, verify=False)


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_discs_springs_and_segments_without_mass(name):
    """Finite elements give the number of frequencies and their values, transfer matrices in 120 digits their digits."""
    values = CASES[name]
    q, certified, error, zeros, count = (np.asarray(x) for x in solve(everything(values)))
    p, K_and_M = q**2, matrices(values, 16)
    rank = np.linalg.matrix_rank(K_and_M[1]) if not any(values["rhoA"]) else INF
    present = min(MODES, rank)
    assert count == rank and certified.all() and np.all(np.isinf(p[present:])) and np.all(np.isfinite(p[:present]))
    elements = finite_elements(values, int(present), 16)
    assert np.count_nonzero(p == 0) == zeros and np.all(elements[:zeros] < 1e-6 * elements[-1])
    np.testing.assert_allclose(p[zeros:present], elements[zeros:], rtol=1e-10)
    with mp.workdps(120):
        exact = [exact_frequency(complete(values), each) for each in p[zeros:present]]
        distance = np.array([abs(float(a / b - 1)) for a, b in zip(p[zeros:present], exact, strict=True)])
    assert np.all(distance <= 1e-14) and np.all(distance <= error[zeros:present])


@pytest.mark.full
def test_a_disc_in_closed_form():
    """One on a cantilever without mass: (p^2 m - 12 EI/l^3)(p^2 I - 4 EI/l) = (6 EI/l^2)^2."""
    EI, length, mass, inertia = 3e3, 0.7, 12.0, 0.35
    values = {"length": (length,), "EI": (EI,), "rhoA": (0.0,), "k_A": INF, "k_rot_A": INF}
    q, *_ = solve(bar(values | {"m_D": mass, "I_D": inertia}))
    K = EI / length**3 * np.array([[12, -6 * length], [-6 * length, 4 * length**2]])
    scale = np.diag([mass**-0.5, inertia**-0.5])
    np.testing.assert_allclose(np.asarray(q[:2]) ** 4, np.linalg.eigvalsh(scale @ K @ scale), rtol=1e-14)
    assert np.all(np.isinf(q[2:]))


@pytest.mark.full
def test_no_root_is_missed_or_false():
    rng = np.random.default_rng(3)
    for _ in range(50):
        values = random_discs(rng, 3)
        q, certified, _, zeros, count = (np.asarray(x) for x in solve(everything(values)))
        present = int(min(MODES, count))
        assert certified.all() and np.all(np.isinf(q[present:]))
        elements = finite_elements(values, present, 24)
        near = np.abs(q[zeros:present] ** 2 - elements[zeros:]) <= 1e-6 * elements[zeros:] + 1e-7 * elements[-1]
        assert near.all() and np.all(elements[:zeros] <= 1e-4 * elements[-1]), (values, q**2, elements)


@pytest.mark.full
def test_count_steps_by_one_at_every_frequency():
    for name in ("discs at elastic joints", "clamped, elastic joints", "no mass but discs, free", "shear"):
        shaft = everything(CASES[name])
        q = solve(shaft)[0][2:6]
        below, above = (np.asarray(counted(shaft, q * x)) for x in (1 - 1e-13, 1 + 1e-13))
        assert np.all(above - below == 1) and np.all(np.diff(below) == 1), name


@pytest.mark.full
@pytest.mark.parametrize("large", [1e100, 1e30, 1e12])
def test_limits_are_reached(large):
    """A stiff rotational spring clamps. A large inertia does so as well, apart from its own low frequency."""
    clamped = solve(everything(SHAFT | {"k_rot_A": INF, "k_D": INF, "k_rot_D": INF}))[0]
    stiff = solve(everything(SHAFT | {"k_rot_A": large * 1e6, "k_D": INF, "k_rot_D": INF}))[0]
    np.testing.assert_allclose(stiff, clamped, rtol=max(1e-15, 10 / large))
    heavy, certified, *_ = solve(everything(SHAFT | {"I_A": large, "k_D": INF, "k_rot_D": INF}))
    assert np.all(certified)
    np.testing.assert_allclose(heavy[1:], clamped[:-1], rtol=max(1e-15, 1e6 / large))
    # A static deflection: the ends of the shaft turn against its bending and its support at A.
    assert 0 < heavy[0] < 1e3 * large**-0.25


@pytest.mark.full
@pytest.mark.parametrize("rhoA", [1e-6, 1e-20])
def test_frequencies_are_continuous_at_a_segment_without_mass(rhoA):
    for values in (DISCS, TWO_DISCS | {"I_joint": (0.4, 0.9), "rhoA": (0.0,) * 3}):
        without = solve(everything(values | {"rhoA": (0.0, values["rhoA"][1], 0.0)}))[0]
        light = solve(everything(values | {"rhoA": (rhoA, max(values["rhoA"][1], rhoA), rhoA)}))[0]
        present = np.isfinite(without)
        np.testing.assert_allclose(light[present], without[present], rtol=max(1e-14, rhoA))
        assert np.all(light[~present] > 1e3)


def test_a_part_without_mass_that_moves_freely_has_no_frequency():
    """The bar behind a hinge turns about it: without mass there it has no equation of motion."""
    loose = DISCS | {"rhoA": (15.0, 2.8, 0.0), "k_hinge": (INF, 0.0), "k_D": 0.0, "I_joint": 0.0, "I_D": 0.0}
    found = dt.critical_speeds(dt.Bicardan(**loose))
    assert found.outcome == Outcome.NOT_FINITE
    assert np.isnan(found.critical_speed).all() and not np.any(found.count_certified)
    held = dt.critical_speeds(dt.Bicardan(**loose | {"I_D": 0.1}))
    assert held.outcome == 0 and held.critical_speed[0] == 0.0


ARGUMENTS = {
    "length": jnp.array([0.4, 0.5, 0.6]),
    "EI": jnp.array([5e4, 6e4, 3e4]),
    "rhoA": jnp.array([15.0, 0.0, 5.5]),
    "k": jnp.array([1e6, 2e6, 0.0, 5e6]),
    "m": jnp.array([1.0, 10.0, 3.0, 0.0]),
    "k_hinge": jnp.array([3e4, 1e5]),
    "k_rot": jnp.array([2e4, 0.0]),
    "inertia": jnp.array([0.3, 0.5, 0.0, 0.2]),
}


def angular_frequencies(arguments: Mapping[str, jax.Array]) -> jax.Array:
    lists = {name: tuple(x) for name, x in arguments.items()}
    for kind, name in (("k", "k"), ("m", "m"), ("inertia", "I")):
        first, *inner, last = lists.pop(kind)
        lists |= {f"{name}_A": first, f"{name}_joint": tuple(inner), f"{name}_D": last}
    lists["k_rot_A"], lists["k_rot_D"] = lists.pop("k_rot")
    return dt.critical_speeds(dt.Bicardan(**lists), outputs="angular_frequency", modes=5).angular_frequency


@pytest.fixture(scope="module")
def jacobians() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    rows, p = jax.jit(jax.jacrev(lambda a: (angular_frequencies(a),) * 2, has_aux=True))(ARGUMENTS)
    return np.asarray(p), {name: np.asarray(row) for name, row in rows.items()}


@pytest.mark.full
def test_gradients_obey_the_sum_identities(jacobians):
    p, rows = jacobians
    check_identities(p, rows, ARGUMENTS)


@pytest.mark.full
def test_gradients_against_finite_differences(jacobians):
    """Fourth order in the logarithm; one-sided, from small steps, where a parameter is 0: a mass, a spring, an inertia."""
    p, rows = jacobians
    h, multiples = 1e-3, np.array([-2, -1, 1, 2])
    steps = {"rhoA": 1e-4, "k": 1e2, "m": 1e-4, "k_rot": 1e1, "inertia": 1e-5}
    places = [(name, e) for name, x in ARGUMENTS.items() for e in range(len(x))]
    columns = {name: np.repeat(np.asarray(x)[:, None], 4 * len(places), axis=1) for name, x in ARGUMENTS.items()}
    for number, (name, e) in enumerate(places):
        here = slice(4 * number, 4 * number + 4)
        absent = float(ARGUMENTS[name][e]) == 0
        columns[name][e, here] = (
            steps[name] * np.arange(1, 5) if absent else columns[name][e, here] * np.exp(h * multiples)
        )
    many = jax.jit(jax.vmap(angular_frequencies, -1, -1))
    found = np.asarray(many({name: jnp.asarray(column) for name, column in columns.items()})).reshape(5, -1, 4)
    for number, (name, e) in enumerate(places):
        value = float(ARGUMENTS[name][e])
        if value:
            slopes = np.log(found[:, number]) @ np.array([1, -8, 8, -1]) / (12 * h)
            np.testing.assert_allclose(rows[name][:, e] * value / p, slopes, atol=3e-11, err_msg=f"{name}[{e}]")
        else:
            slopes = (found[:, number] @ np.array([4, -3, 4 / 3, -1 / 4]) - 25 / 12 * p) / steps[name]
            size = np.abs(slopes).max()
            np.testing.assert_allclose(rows[name][:, e], slopes, atol=1e-6 * size, err_msg=f"{name}[{e}]")


@pytest.mark.full
def test_an_infinite_frequency_and_a_held_zero_mode_have_no_derivative():
    """Two masses on a massless shaft without supports: two zero modes, no third frequency."""
    values = TWO_DISCS | {"rhoA": (0.0,) * 3, "k_A": 0.0, "k_D": 0.0}
    slopes = jax.jacfwd(lambda s: dt.critical_speeds(s, modes=3).critical_speed)(dt.Bicardan(**values)).values
    for name in ("k_A", "k_rot_A", "m_A", "I_joint", "EI"):
        for entry in jax.tree.leaves(slopes.get(name)):
            assert np.isnan(entry[2]), name
            assert np.isnan(entry[:2]).all() if name.startswith("k_") else np.all(entry[:2] == 0), name


@pytest.mark.full
def test_results_obey_their_rules(tmp_path):
    """Masses swept to zero with every result asked for: `verify` finds nothing."""
    scene = {
        "system": "bicardan",
        "analysis": "critical_speeds",
        "outputs": [v.name for v in VARIABLES],
        "axes": {"rhoA[0]": [0.0, 1.0], "I_A": [0.0, 0.3], "k_rot_A": [0.0, 1e4, INF]},
        "fixed": {k: list(v) if isinstance(v, tuple) else v for k, v in DISCS.items() if k != "I_A"}
        | {"rhoA": [1.0, 0.0, 0.0]},
        "options": {"operating_max": 3000.0},
    }
    result = dt.run(scene, out=tmp_path / "discs.nc")
    assert np.all(result.outcome == 0)
    assert (
        np.isinf(result.angular_frequency.isel(rhoA_0=0)).any()
        and not np.isinf(result.angular_frequency.isel(rhoA_0=1)).any()
    )
    assert dt.open_result(tmp_path / "discs.nc").drivetrain.verify().problem == ""


def test_frequencies_at_the_ends_of_the_range_follow_the_scaling_law():
    """Frequencies go with sqrt(EI/rhoA)/length^2."""
    names = "length[0]", "length[1]", "EI[0]", "EI[1]", "rhoA[0]", "rhoA[1]"
    ends = [(1.0, 1.0, 1.0), *itertools.product((1e-29, 1e29), (1e-59, 1e59), (1e-59, 1e59))]
    columns = np.array([(2 * x, x, 3 * y, y, 5 * z, z) for x, y, z in ends]).T.tolist()
    fixed = {"length": [1.0] * 2, "EI": [1.0] * 2, "rhoA": [1.0] * 2, "k_A": INF, "k_D": INF}
    scene = {"system": "bicardan", "analysis": "critical_speeds", "outputs": ["natural_frequency"], "fixed": fixed}
    with warnings.catch_warnings(action="ignore"):
        found = dt.run(scene | {"points": dict(zip(names, columns, strict=True))})
    law = np.array([math.sqrt(y) / math.sqrt(z) / x**2 for x, y, z in ends])[:, None]
    first = found.natural_frequency.values[0]
    np.testing.assert_allclose(
        found.natural_frequency.values / law, np.broadcast_to(first, (9, len(first))), rtol=1e-12
    )


@pytest.mark.full
def test_a_vanishing_mass_of_the_segments_changes_nothing_until_it_is_refused():
    shaft = {"length": (0.25,) * 4, "EI": (6e4, 12e4, 12e4, 6e4), "k_A": INF, "k_D": INF}
    shaft |= {"m_joint": (0.0, 400 / 9.81, 0.0), "outputs": ["critical_speed"]}
    for mass in (1e-9, 1e-30, 1e-60, 0.0):
        found = dt.point("bicardan", "critical_speeds", **shaft, rhoA=(mass,) * 4)
        assert found.critical_speed[0] == pytest.approx(3383.848186, rel=1e-9)
    with pytest.raises(
        dt.InputError, match=r"rhoA\[0\] = 1e-180: expected 1e-60 <= rhoA\[i\] <= 1e\+60, or 0, in kg/m"
    ):
        dt.point("bicardan", "critical_speeds", **shaft, rhoA=(1e-180,) * 4)
