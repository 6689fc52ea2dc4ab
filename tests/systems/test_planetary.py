"""The planetary gear: refused parameters, the rotational model, and parameters with derived defaults."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.scene import load_scene
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies, matrices
from tests.sizes import full_after

SCENE = {"system": "planetary", "analysis": "modes"}
LISTS = {"m_p": (0.6, 0.66, 0.7), "I_p": (0.61, 0.55, 0.5), "k_rp": (4e8, 5e8, 6e8)}
HELD = {"k_cu": 1e9, "pressure_angle_r": 0.3, "pressure_angle_s": 0.5}
EVERYTHING = ["natural_frequency", "mode_type", "multiplicity", "participation", "mode_shape", "kinetic_energy"]


def frequencies(gear: dt.Planetary) -> np.ndarray:
    return np.asarray(dt.modes(gear, outputs=["natural_frequency"]).natural_frequency)


def of_rotations(p: dict) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and mass matrix of the plane gear with eta_n = u_c and all other translations held."""
    mass, stiffness = (np.array(x, float) for x in matrices(p))
    n = len(p["planet_angle"])
    constraint = np.zeros((9 + 3 * n, 3 + n))
    constraint[[2, 5, 8], [0, 1, 2]] = 1
    constraint[10::3, 0] = 1
    constraint[11::3, 3:] = np.eye(n)
    inertia, held = (constraint.T @ x @ constraint for x in (np.diag(mass), stiffness))
    root = np.sqrt(np.diag(inertia))
    squares = np.linalg.eigvalsh(held / root / root[:, None])
    return np.sqrt(np.maximum(squares, 0)) / (2 * math.pi), inertia


def test_lists_have_one_entry_per_planet():
    scene = SCENE | {"fixed": {"m_p": [1.0, 2.0]}, "axes": {"k_p": {"values": [1e8]}}}
    with pytest.raises(InputError) as refusal:
        load_scene(scene)
    said = "fixed.m_p = [1.0, 2.0]: 2 entries where planet_angle has 4; expected one number, or one entry per planet"
    assert str(refusal.value) == said


@pytest.mark.full
@pytest.mark.parametrize("angles", [(0.0, 0.0, 2.0), (0.5, 2.0, 0.5 - 2 * math.pi)])
def test_planets_in_one_place_are_warned_of(angles):
    with pytest.warns(UserWarning, match=r"^planet_angle = \[.*\]: several planets are in one place$"):
        load_scene(SCENE | {"fixed": {"planet_angle": list(angles)}})


def test_planets_that_are_all_in_one_place_are_refused():
    message = r"planet_angle = \[0.0, 0.0, 0.0\]: all planets are in one place; expected different angles$"
    with pytest.raises(InputError, match=f"^fixed.{message}"):
        load_scene(SCENE | {"fixed": {"planet_angle": [0.0, 0.0, 0.0]}})
    with pytest.raises(InputError, match=f"^{message}"):
        dt.Planetary(planet_angle=[0, 0.0, 0.0])


@pytest.mark.parametrize("model", full_after(1, ["rotational", "plane"]))
def test_the_vector_field_is_that_of_the_equations_of_motion(model):
    gear = dt.Planetary(planet_angle=(0.0, 1.3, 3.3), **LISTS, **HELD, k_sx=2e8, model=model)
    dofs = len(gear.springs().dofs)
    slopes = np.asarray(jax.jit(jax.jacfwd(lambda y: gear.vector_field(0.3, y)))(np.ones(2 * dofs)))
    assert np.array_equal(slopes[:dofs], np.eye(2 * dofs)[dofs:]) and not slopes[dofs:, dofs:].any()
    squares = np.sort(np.linalg.eigvals(-slopes[dofs:, :dofs]).real)
    assert np.sqrt(np.abs(squares)) / (2 * math.pi) == pytest.approx(frequencies(gear), rel=1e-9, abs=1e-3)
    if model == "plane":
        plain = dt.Planetary(planet_angle=(0.0, 1.3, 3.3), **LISTS)
        mass, stiffness = (np.array(x, float) for x in matrices(TABLE_2 | plain.values))
        y = np.random.default_rng(0).normal(size=2 * dofs)
        expected = np.concatenate([y[dofs:], -(stiffness @ y[:dofs]) / mass])
        assert np.asarray(jax.jit(plain.vector_field)(0.0, y)) == pytest.approx(expected, rel=1e-12)


def test_rotations_of_four_planets():
    """Four frequencies are distinct, and the frequency of planets alone is triple: (39), (40)."""
    found = dt.modes(dt.Planetary(model="rotational"), outputs=EVERYTHING)
    degenerate = math.sqrt(1e9 / 0.61) / (2 * math.pi)
    expected = [0, 2120.62, degenerate, degenerate, degenerate, 6635.21, 12554.33]
    np.testing.assert_allclose(found.natural_frequency, expected, atol=0.005)
    np.testing.assert_allclose(found.natural_frequency[2:5], degenerate, rtol=1e-14)
    assert found.mode_type.tolist() == [0, 1, 3, 3, 3, 1, 1]
    assert found.multiplicity.tolist() == [1, 1, 3, 3, 3, 1, 1]
    # Distinct frequencies: all bodies turn, all planets alike. Degenerate: only planets turn, and their sum is zero.
    shapes = np.asarray(found.mode_shape)
    np.testing.assert_allclose(shapes[[1, 5, 6], 3:], shapes[[1, 5, 6], 3:4] * np.ones((1, 4)), rtol=1e-9)
    assert (np.abs(shapes[[1, 5, 6]]) > 1e-2).all()
    np.testing.assert_allclose(shapes[2:5, :3], 0, atol=1e-13)
    np.testing.assert_allclose(shapes[2:5, 3:].sum(1), 0, atol=1e-13)


@pytest.mark.parametrize(
    ("count", "given", "method"),
    full_after(
        1, [(3, LISTS, "auto"), (5, HELD, "auto"), (1, {}, "auto"), (2, HELD, "full"), (5, {}, "full")], several=True
    ),
)
def test_rotations_are_the_plane_gear_with_its_centres_held(count, given, method):
    angles = (0.0, 1.9, 4.0, 4.4, 5.9)[:count]
    gear = dt.Planetary(planet_angle=angles, model="rotational", **given)
    found = dt.modes(gear, outputs=EVERYTHING, method=method)
    expected, inertia = of_rotations(TABLE_2 | given | {"planet_angle": angles})
    np.testing.assert_allclose(found.natural_frequency, expected, rtol=1e-9, atol=2e-3)
    shapes = np.asarray(found.mode_shape)
    np.testing.assert_allclose(shapes @ inertia @ shapes.T, np.eye(3 + count), atol=1e-12)
    np.testing.assert_allclose(np.sum(found.participation, axis=1), 1)
    assert (np.asarray(found.participation)[:, 1] == 0).all()


@pytest.mark.parametrize(
    "given",
    [
        {"pressure_angle_s": 0.35, "pressure_angle_r": 0.5},
        pytest.param({"pressure_angle_s": 0.35}, marks=pytest.mark.full),
        pytest.param({"k_sx": 2e8, "k_sy": 5e7, "k_rx": 3e8, "k_cy": 4e8}, marks=pytest.mark.full),
        pytest.param(
            {"k_sy": 0.0, "pressure_angle_r": 0.1, "m_p": (0.6, 0.66, 0.7, 0.5), "k_p": (1e8, 2e8, 1e8, 3e8)},
            marks=pytest.mark.full,
        ),
    ],
)
@pytest.mark.parametrize("angles", [(0.0, 1.4, 3.2, 4.5), (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)])
def test_pressure_angles_and_bearings_that_differ(angles, given):
    exact = np.array(exact_frequencies(TABLE_2 | given | {"planet_angle": angles}))
    found = frequencies(dt.Planetary(planet_angle=angles, **given))
    np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-8)


@pytest.mark.full
def test_derived_parameters_follow_until_they_are_given():
    plain = frequencies(dt.Planetary(k_s=3e8, pressure_angle=0.3))
    same = dt.Planetary(k_s=1.0, k_sx=3e8, k_sy=3e8, pressure_angle=0.4, pressure_angle_s=0.3, pressure_angle_r=0.3)
    np.testing.assert_array_equal(plain, frequencies(same))


@pytest.mark.full
def test_bearings_by_direction_split_doublets_and_keep_the_families():
    """With equal spacing k_sx splits every translational pair; rotational and planet modes do not change."""
    equal, split = (dt.modes(dt.Planetary(**more), outputs=EVERYTHING) for more in ({}, {"k_sx": 2e8}))
    assert sorted(equal.multiplicity.tolist()) == [1] * 9 + [2] * 12
    assert split.multiplicity.tolist() == [1] * 21
    np.testing.assert_array_equal(np.bincount(split.mode_type, minlength=5), [1, 5, 12, 3, 0])


@pytest.mark.full
def test_derivatives_by_the_new_parameters():
    """Central differences of the model with rotations, and of bearings by direction and both pressure angles."""
    rotational = {"model": "rotational", "pressure_angle_s": 0.4, "pressure_angle_r": 0.3, "k_cu": 1e8}
    plane = {"planet_angle": (0.0, 1.4, 3.2, 4.5), "k_sx": 2e8, "k_ry": 7e7, "pressure_angle_s": 0.4}
    for given, names in (
        (rotational, ("k_cu", "m_p", "pressure_angle_s")),
        (plane, ("k_sx", "k_ry", "pressure_angle_s")),
    ):
        gear = dt.Planetary(**given)
        slopes = jax.jacrev(lambda g: dt.modes(g, outputs=["natural_frequency"]).natural_frequency)(gear)
        for name in names:
            value = getattr(gear, name)
            up, down = (frequencies(dt.Planetary(**given | {name: value * (1 + h)})) for h in (1e-5, -1e-5))
            numeric = (up - down) / (2e-5 * value)
            slope = np.asarray(getattr(slopes, name))
            assert np.isfinite(slope).any() and np.abs(numeric).max() > 0
            known = np.isfinite(slope)
            np.testing.assert_allclose(slope[known], numeric[known], atol=1e-6 * np.abs(numeric).max())


@pytest.mark.full
def test_one_of_five_planets_3_degrees_off():
    """By the exact label nearly all modes are coupled; the dominant family and its share characterise them."""
    angles = tuple(np.radians([0, 75, 144, 216, 288]))
    found = dt.modes(dt.Planetary(planet_angle=angles))
    assert dt.Planetary(planet_angle=np.array(angles)).planet_angle == tuple(angles)
    coupled = np.asarray(found.mode_type) == 4
    assert coupled.sum() == 17
    families = np.bincount(found.dominant_family[coupled], minlength=4)
    np.testing.assert_array_equal(families, [5, 12, 0, 0])
    assert 0.9995 < found.dominant_share[coupled].min() < found.dominant_share.max() < 1 + 1e-12


@pytest.mark.parametrize("track", ["m_s", "pressure_angle", "planet_angle"])
def test_a_track_is_an_axis(track):
    with pytest.raises(InputError, match=f"options: '{track}' is not an axis of the scene; expected one of k_cu"):
        load_scene(SCENE | {"axes": {"k_cu": {"values": [1e8, 1e9]}}, "options": {"track": track}})
