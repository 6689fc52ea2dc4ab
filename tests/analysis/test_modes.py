"""The analysis ``modes`` of planetary gears: counts, labels, tracking and degenerate gears."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.optimize import brentq

import drivetrain_jax as dt
from drivetrain_jax.analysis.modes import SYMMETRIC, follow
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies, matrices, natural_frequencies

RIGID, ROTATIONAL, TRANSLATIONAL, PLANET, COUPLED = range(5)
MODES = ["natural_frequency", "mode_type", "participation"]


def run_angles(angles: np.ndarray, outputs: list[str], method: str = "auto", **fixed):
    """Modes of one point per row of ``angles`` (points, N); sets with the same number of planets share a kernel."""
    columns = {f"planet_angle[{i}]": angles[:, i].tolist() for i in range(angles.shape[1])}
    return dt.run(
        {
            "system": "planetary",
            "analysis": "modes",
            "outputs": outputs,
            "points": columns,
            "fixed": {"planet_angle": angles[0].tolist(), **fixed},
            "options": {"method": method},
        }
    )


def random_angles(rng: np.random.Generator, count: int, n: int) -> np.ndarray:
    return np.sort(rng.uniform(0, 2 * math.pi, (count, n)), axis=1)


@pytest.mark.full
@pytest.mark.parametrize("n", range(3, 13))
def test_random_spacings_have_the_right_count_of_planet_modes(n):
    """There are three planet modes N - 3 times and one rigid rotation."""
    count = 30
    ds = run_angles(random_angles(np.random.default_rng(n), count, n), MODES)
    types, frequency = ds.mode_type.values, ds.natural_frequency.values
    assert ((types == PLANET).sum(1) == 3 * (n - 3)).all()
    assert ((types == RIGID).sum(1) == 1).all() and (types[:, 0] == RIGID).all()
    assert (frequency[:, 0] < 1e-9).all()
    if n > 3:
        alone = np.sort(frequency[types == PLANET].reshape(count, 3, n - 3), axis=1)
        np.testing.assert_allclose(
            alone, np.broadcast_to(np.array([1808.18102, 5963.76033, 6981.70503])[:, None], alone.shape), rtol=1e-6
        )


@pytest.mark.full
def test_labels_of_five_planets():
    """Random changes of 1e-9 to 1e-12 rad around equal and around balanced unequal spacing flip no label.

    The paper's odd claim is false both ways: modes are coupled where it claims rotational ones, and five unequally spaced
    planets have the rotational modes of equal spacing.
    """
    rng = np.random.default_rng(5)
    equal, balanced, unequal = np.radians([[0, 72, 144, 216, 288], [0, 30, 120, 210, 240], [0, 72, 144, 252, 324]])
    spacings = np.array([equal, balanced])
    shifts = rng.uniform(-1, 1, (2, 12, 5)) * np.logspace(-9, -12, 12)[None, :, None]
    angles = (spacings[:, None] + shifts).reshape(-1, 5)
    c1 = np.abs(np.exp(1j * angles).mean(1))
    assert (c1 < SYMMETRIC).all() and c1.max() > 1e-11
    ds = run_angles(np.concatenate([spacings, angles, [unequal]]), MODES)
    types, frequency = ds.mode_type.values, ds.natural_frequency.values
    counts = [[(row == kind).sum() for kind in range(5)] for row in types]
    assert counts[:-1] == [[1, 5, 12, 6, 0]] * 26
    for first, rest in zip(types[:2], types[2:-1].reshape(2, 12, -1), strict=True):
        assert (rest == first).all()
    assert counts[-1][COUPLED] == 17 and not counts[-1][ROTATIONAL] and not counts[-1][TRANSLATIONAL]
    rotational = [frequency[i][types[i] == ROTATIONAL] for i in (0, 1)]
    np.testing.assert_allclose(rotational[1], rotational[0], rtol=1e-12)


@pytest.mark.full
def test_labels_at_an_accidental_crossing_of_families():
    """If a rotational and a translational frequency agree to 1e-7, a change of 1e-9 rad mixes the vectors but not the
    labels."""
    base = TABLE_2 | {"planet_angle": tuple(np.radians([0, 80, 180, 260]))}

    def distance(k_cu: float) -> float:
        """Distance of the rising rotational frequency from a target 1e-7 below the translational frequency."""
        below, above = natural_frequencies(base | {"k_cu": k_cu})[2:4]
        other = 1084.96362568457
        return (below if abs(above - other) < abs(below - other) else above) - other * (1 - 1e-7)

    k_cu = brentq(distance, 1e9, 1e10, rtol=1e-14)
    angles = np.radians([0, 80, 180, 260]) + np.array([[0, 0, 0, 0], [0, 1e-9, 0, -1e-9], [0, 1e-12, 1e-12, 0]])
    ds = run_angles(angles, MODES, k_cu=k_cu)
    types, frequency = ds.mode_type.values, ds.natural_frequency.values
    assert 0.9e-7 < frequency[0, 3] / frequency[0, 2] - 1 < 1.1e-7
    assert all((np.sort(row) == np.sort(types[0])).all() for row in types)
    assert COUPLED not in types


LISTS = {"m_p": [0.6, 0.66, 0.7], "k_p": [1e8, 2e8, 1.5e8], "k_rp": [4e8, 5e8, 6e8]}


@pytest.fixture(scope="module")
def shapes():
    """Shapes, participation and energies of a gear with three different planets, by the full system."""
    fixed = {"planet_angle": [0.0, 1.9, 4.0], **LISTS}
    outputs = ["natural_frequency", "mode_shape", "kinetic_energy", "mode_type", "participation"]
    return dt.run({"system": "planetary", "analysis": "modes", "outputs": outputs, "fixed": fixed})


def test_different_planets_against_the_oracle(shapes):
    exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": (0.0, 1.9, 4.0), **LISTS}))
    np.testing.assert_allclose(shapes.natural_frequency.values[1:], exact[1:], rtol=1e-12)


def test_shapes_solve_the_equations_of_motion(shapes):
    mass, stiffness = matrices(TABLE_2 | {"planet_angle": (0.0, 1.9, 4.0), **LISTS})
    q, square = shapes.mode_shape.values, (2 * math.pi * shapes.natural_frequency.values) ** 2
    np.testing.assert_allclose(q * np.array(mass) @ q.T, np.eye(18), atol=1e-13)
    residual = np.array(stiffness) @ q.T - np.array(mass)[:, None] * q.T * square
    assert np.abs(residual).max() < 1e-6 * np.abs(np.array(stiffness) @ q.T).max()


SIX = tuple(2 * math.pi * i / 6 for i in range(6))
FULL = ["natural_frequency", "natural_frequency_error", "mode_shape", "mode_type"]


def nearly_equal(name: str, spread: float) -> dict:
    """Parameters of six equally spaced planets that differ in the parameter ``name``."""
    listed = tuple(TABLE_2[name] * (1 + spread * x) for x in (0, 0.3, -0.5, 0.9, -0.2, 0.6))
    return TABLE_2 | {"planet_angle": SIX, name: listed}


def assert_modes(p: dict, frequency: np.ndarray, bound: np.ndarray, shapes: np.ndarray) -> None:
    """Assert that frequencies agree with the 50-digit oracle within their bound, that shapes solve the equations of motion,
    and that well-separated shapes agree with an independent eigensolution."""
    assert (np.abs(frequency - np.array(exact_frequencies(p))) <= bound).all()
    mass, stiffness = (np.array(x, float) for x in matrices(p))
    vectors = shapes.T * np.sqrt(mass)[:, None]
    scaled = stiffness / np.sqrt(np.outer(mass, mass))
    values, exact = np.linalg.eigh(scaled)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(mass)), atol=1e-13)
    assert np.abs(scaled @ vectors - vectors * values).max() < 1e-12 * values[-1]
    gaps = np.diff(values, prepend=-np.inf, append=np.inf)
    alone = np.minimum(gaps[:-1], gaps[1:]) > 1e-9 * values[-1]
    mac = np.sum(vectors * exact, axis=0) ** 2
    assert alone.sum() > 4 and (mac[alone] > 1 - 1e-8).all()


@pytest.mark.full
@pytest.mark.parametrize("name", ["k_p", "m_p", "k_sp"])
def test_planets_that_differ_slightly_have_modes_of_their_own(name):
    """Planet modes are split by less than 5e-5; rotated towards their family they would no longer be modes."""
    gears = [nearly_equal(name, spread) for spread in (1e-3, 1e-5, 1e-7)]
    columns = {f"{name}[{i}]": [gear[name][i] for gear in gears] for i in range(6)}
    scene = {"system": "planetary", "analysis": "modes", "points": columns}
    fixed = {"fixed": {"planet_angle": list(SIX), name: list(gears[0][name])}}
    ds = dt.run(scene | fixed | {"outputs": FULL})
    alone = dt.run(scene | fixed | {"outputs": FULL[:2]})
    np.testing.assert_array_less(
        np.abs(ds.natural_frequency.values - alone.natural_frequency.values), alone.natural_frequency_error.values
    )
    for i, gear in enumerate(gears):
        assert_modes(gear, *(ds[key].values[i] for key in FULL[:3]))
    # With a spread of 1e-5 the share outside the family is below the square of the spread.
    assert [(ds.mode_type.values[1:] == kind).sum(1).tolist() for kind in (PLANET, RIGID)] == [[9, 9], [1, 1]]


@pytest.mark.full
def test_followed_frequencies_are_those_of_each_point():
    """The path leads from equal planets to one planet that differs by 1e-5."""
    scene = {
        "system": "planetary",
        "analysis": "modes",
        "outputs": ["natural_frequency", "natural_frequency_error", "branch", "mac"],
        "axes": {"k_p[1]": {"values": [1e8, 1.00001e8]}},
        "fixed": {"planet_angle": list(SIX), "k_p": [1e8] * 6},
        "options": {"track": "k_p[1]"},
    }
    ds = dt.run(scene)
    for i, k_p in enumerate((1e8, 1.00001e8)):
        exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": SIX, "k_p": (1e8, k_p, *[1e8] * 4)}))
        assert (np.abs(ds.natural_frequency.values[i] - exact) <= ds.natural_frequency_error.values[i]).all()


def test_energies_and_participation_are_shares(shapes):
    np.testing.assert_allclose(shapes.kinetic_energy.values.sum(-1), 1, rtol=1e-12)
    np.testing.assert_allclose(shapes.participation.values.sum(-1), 1, rtol=1e-12)
    planets = [i for i, name in enumerate(shapes.body.values) if str(name).startswith("planet")]
    assert (shapes.kinetic_energy.values[:, planets].sum(-1) > 0).all()


def test_rigid_rotation_turns_everything_alike(shapes):
    """No central body moves sideways in the rigid rotation."""
    assert int(shapes.mode_type[0]) == RIGID
    q = shapes.mode_shape.values[0]
    assert np.abs(q[[0, 1, 3, 4, 6, 7]]).max() < 1e-9 * np.abs(q).max()


def test_fixed_angles_that_do_not_balance_are_not_taken_apart():
    """Fixed angles decide before compilation if rotation and translation are separate problems."""
    angles = np.radians([0, 60, 180, 270])
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["natural_frequency"]}
    found = dt.run(scene | {"fixed": {"planet_angle": angles.tolist()}}).natural_frequency.values
    exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": tuple(angles)}))
    np.testing.assert_allclose(found[1:], exact[1:], rtol=1e-12)


@pytest.mark.full
def test_equal_lists_are_numbers():
    angles = np.radians([[0, 80, 180, 260]])
    listed = run_angles(angles, ["natural_frequency"], k_p=[1e8] * 4).natural_frequency.values
    single = run_angles(angles, ["natural_frequency"], k_p=1e8).natural_frequency.values
    np.testing.assert_array_equal(listed, single)


@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.full)])
def test_few_planets(n):
    angles = random_angles(np.random.default_rng(1), 3, n)
    found = run_angles(angles, ["natural_frequency"]).natural_frequency.values
    for row, line in zip(angles, found, strict=True):
        exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": tuple(row)}))
        still = exact < 1e-9 * exact[-1]
        np.testing.assert_allclose(line[~still], exact[~still], rtol=1e-12)
        assert (line[still] < 1e-6).all()


@pytest.mark.full
def test_a_planet_without_bearing_turns_no_frequency():
    """The bidiagonal form has exact zeros, and entries that are only their substitutes."""
    angles = np.linspace(0, 3, 301)[:, None]
    ds = run_angles(angles, ["natural_frequency", "natural_frequency_error"], k_p=0.0)
    exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": (0.0,), "k_p": 0.0}))
    moving = exact > 1e-9 * exact[-1]
    np.testing.assert_allclose(ds.natural_frequency.values[:, moving], exact[moving] + 0 * angles, rtol=1e-12)
    assert (ds.outcome.values == 0).all()


@pytest.mark.full
def test_coincident_planets_and_no_stiffness_at_all():
    angles = np.array([[0.3, 0.3, 0.3, 2.0], [0.3, 0.3, 0.3, 0.3], [0, 0.5, 2.0, 3.0]])
    found = run_angles(angles, ["natural_frequency"]).natural_frequency.values
    for row, line in zip(angles, found, strict=True):
        exact = np.array(exact_frequencies(TABLE_2 | {"planet_angle": tuple(row)}))
        still = exact < 1e-9 * exact[-1]
        np.testing.assert_allclose(line[~still], exact[~still], rtol=1e-12)
        assert (line[still] < 1e-6).all()
    springs = {name: 0.0 for name in TABLE_2 if name.startswith("k_")}
    ds = run_angles(angles, MODES, **springs)
    assert (ds.natural_frequency.values == 0).all() and (ds.mode_type.values == RIGID).all()
    assert (ds.outcome.values == 0).all()


@pytest.mark.full
def test_twenty_planets_and_huge_contrasts():
    rng = np.random.default_rng(2)
    angles = random_angles(rng, 3, 20)
    extreme = {"k_sp": 1e16, "k_rp": 1e16, "k_cu": 1e16, "k_s": 1e4, "k_su": 1e2}
    for springs in ({}, extreme):
        ds = run_angles(angles, ["natural_frequency", "natural_frequency_error"], **springs)
        for row, line, bound in zip(
            angles, ds.natural_frequency.values, ds.natural_frequency_error.values, strict=True
        ):
            exact = np.array(exact_frequencies(TABLE_2 | springs | {"planet_angle": tuple(row)}))
            assert (np.abs(line - exact) <= bound).all()
            # Orthogonal transformations have errors of the rounding of the largest frequency, 3e6 times the smallest.
            assert np.abs(line - exact).max() < 40 * np.finfo(float).eps * exact[-1]
            assert springs or np.abs(line[1:] / exact[1:] - 1).max() < 1e-11


@pytest.fixture(scope="module")
def tracked():
    scene = {
        "system": "planetary",
        "analysis": "modes",
        "outputs": ["natural_frequency", "mode_type", "branch", "mac"],
        "axes": {"k_p": {"values": [1e8, 1.1e8]}, "k_cu": {"start": 1e8, "stop": 1e10, "num": 41, "scale": "log"}},
        "fixed": {"planet_angle": np.radians([0, 80, 180, 260]).tolist()},
        "options": {"track": "k_cu"},
    }
    return dt.run(scene)


@pytest.mark.full
@pytest.mark.parametrize("order", [[3, 0, 6, 1, 5, 2, 4], [0, 1, 2, 3, 4, 6, 5]])
def test_tracks_follow_neighbours_in_any_order_of_points(order):
    stiffness = np.geomspace(1e8, 1e11, 7)
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["branch", "mac"], "options": {"track": "k_cu"}}
    rising = dt.run(scene | {"axes": {"k_cu": {"values": stiffness}}})
    listed = dt.run(scene | {"axes": {"k_cu": {"values": stiffness[order]}}})
    xr.testing.assert_allclose(rising[["branch", "mac"]], listed[["branch", "mac"]].sortby("k_cu"), rtol=1e-12)


@pytest.mark.full
def test_branches_keep_their_type_where_frequencies_cross(tracked):
    """The rotational mode of the held carrier crosses translational modes; every branch keeps its type."""
    types, branch = tracked.mode_type.values, tracked.branch.values
    for line_types, line_branch in zip(types, branch, strict=True):
        order = np.argsort(line_branch, axis=1)
        followed = np.take_along_axis(line_types, order, axis=1)
        assert (followed == followed[0]).all()
        assert (np.sort(line_branch, axis=1) == np.arange(1, 22)).all()
    assert not (branch == np.arange(1, 22)).all()


@pytest.mark.full
def test_mac_is_high_and_frequencies_stay_rising(tracked):
    assert (tracked.mac.values > 0.9).all() and (tracked.mac.values <= 1).all()
    assert (tracked.mac.values[:, 0] == 1).all()
    assert (np.diff(tracked.natural_frequency.values, axis=-1) >= 0).all()
    assert tracked.natural_frequency.dims == ("k_p", "k_cu", "mode")
    assert tracked["mode"].values.tolist() == list(range(1, 22))


@pytest.mark.full
def test_rigid_modes_are_followed_as_one_space():
    """A gear without bearings has 13 rigid modes; their vectors are arbitrary at each point, but the space moves little."""
    free = dict.fromkeys(("k_p", "k_s", "k_r", "k_c", "k_su", "k_ru", "k_cu"), 0.0)
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["mode_type", "branch", "mac"]}
    angles = {"pressure_angle": {"start": 0.1, "stop": 1.2, "num": 9}}
    fixed = free | {"planet_angle": [0.0, 1.5, 3.1, 4.7]}
    ds = dt.run(scene | {"axes": angles, "fixed": fixed, "options": {"track": "pressure_angle"}})
    assert ((ds.mode_type.values == RIGID).sum(1) == 13).all()
    assert ds.mac.values[:, :13].min() > 0.95


def refusal(**changes) -> str:
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["natural_frequency"], "fixed": {}} | changes
    with pytest.raises(dt.InputError) as error:
        dt.run(scene)
    return str(error.value)


def test_refusals():
    assert "track" in refusal(outputs=["branch"])
    assert "entries" in refusal(fixed={"m_p": [0.6, 0.7]})
    assert "k_sp" in refusal(fixed={"k_sp": -1.0})
    assert "m_p[1]" in refusal(fixed={"m_p": [0.6, 0.0, 1.0, 1.0]})
    assert "not an axis" in refusal(options={"track": "planet_angle[1]"})


@pytest.mark.full
def test_a_path_begins_where_there_are_shapes():
    """Without vectors at the first point the path begins at the second, where the MAC is 1."""
    vectors = np.stack([np.full((2, 2), np.nan), np.eye(2), np.full((2, 2), np.nan), np.eye(2)[:, ::-1]])
    same = np.broadcast_to(np.eye(2, dtype=bool), (4, 2, 2))
    branch, mac = (np.asarray(x) for x in follow(jnp.asarray(vectors), jnp.asarray(same)))
    np.testing.assert_array_equal(mac, [[np.nan] * 2, [1, 1], [np.nan] * 2, [1, 1]])
    np.testing.assert_array_equal(branch, [[1, 2], [1, 2], [1, 2], [2, 1]])
