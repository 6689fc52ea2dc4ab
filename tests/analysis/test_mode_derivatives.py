"""Derivatives of the natural frequencies against differences of the 50-digit oracle and against identities."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from tests.oracles.planetary_reference import TABLE_2, exact_frequencies

ANGLES = (0.1, 1.5, 3.0, 4.9)
UNEQUAL = TABLE_2 | {"planet_angle": ANGLES, "m_p": (0.6, 0.66, 0.7, 0.75), "k_sp": (4e8, 5e8, 6e8, 5.5e8)}
EQUAL = TABLE_2 | {"planet_angle": tuple(i * np.pi / 2 for i in range(4))}
STIFFNESSES = [name for name in TABLE_2 if name.startswith("k_")]
NAMES = [*STIFFNESSES, "m_p", "m_s", "I_c", "pressure_angle", "planet_angle"]


def twice(gear):
    f = dt.modes(gear, outputs="natural_frequency").natural_frequency
    return f, f


reversed_jacobian = jax.jit(jax.jacrev(twice, has_aux=True))


@pytest.fixture(scope="module")
def reverse():
    """Derivatives of a gear whose planets differ, by reverse mode, and its frequencies."""
    rows, f = reversed_jacobian(dt.Planetary(**UNEQUAL))
    return rows.values, f


@pytest.fixture(scope="module")
def jacobian(reverse):
    return reverse[0]


@pytest.fixture(scope="module")
def frequencies(reverse):
    return np.asarray(reverse[1])


def moved(p: dict, name: str, entry: int | None, step: float) -> dict:
    if entry is None:
        return p | {name: p[name] + step}
    return p | {name: tuple(x + step * (i == entry) for i, x in enumerate(p[name]))}


def difference(p: dict, name: str, entry: int | None) -> np.ndarray:
    """Central difference of the oracle, with an error of at most 1e-9."""
    value = p[name] if entry is None else p[name][entry]
    step = 1e4 if value == 0 else 1e-6 * max(abs(value), 1.0 if "angle" in name else 0.0)
    if value == 0:
        low, middle, high = (np.array(exact_frequencies(moved(p, name, entry, i * step))) for i in range(3))
        return (-3 * low + 4 * middle - high) / (2 * step)
    low, high = (np.array(exact_frequencies(moved(p, name, entry, s * step))) for s in (-1, 1))
    return (high - low) / (2 * step)


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_against_differences(jacobian, name):
    entry = 1 if isinstance(UNEQUAL[name], tuple) else None
    ours = np.asarray(jacobian[name] if entry is None else jacobian[name][entry])
    exact = difference(UNEQUAL, name, entry)
    # The rigid mode becomes a spring-mass mode, f = sqrt(k)/..., which has no derivative at k = 0.
    np.testing.assert_allclose(ours[1:], exact[1:], rtol=2e-6, atol=2e-7 * np.abs(exact[1:]).max())


@pytest.mark.full
def test_planets_that_differ_slightly():
    """Planet modes are 1.5e-7 apart, more than the width of a cluster: each has its own value and derivative."""
    listed = tuple(1e8 * (1 + 1e-5 * x) for x in (0, 0.3, -0.5, 0.9, -0.2, 0.6))
    p = TABLE_2 | {"planet_angle": tuple(2 * np.pi * i / 6 for i in range(6)), "k_p": listed}
    rows, value = reversed_jacobian(dt.Planetary(**p))
    value, ours = np.asarray(value), np.asarray(rows.k_p[1])
    low, here, high = (np.array(exact_frequencies(moved(p, "k_p", 1, step))) for step in (-0.1, 0.0, 0.1))
    np.testing.assert_allclose(value[1:], here[1:], rtol=1e-13)
    gaps = np.diff(here, prepend=-np.inf, append=np.inf) / here.clip(1)[np.r_[0 : here.size, -1]]
    alone = np.minimum(gaps[:-1], gaps[1:]) > 6e-8
    alone[0] = False
    close = alone & (np.minimum(gaps[:-1], gaps[1:]) < 5e-7)
    assert close.sum() > 3
    np.testing.assert_allclose(ours[alone], ((high - low) / 0.2)[alone], rtol=1e-3, atol=1e-10)


@pytest.mark.full
def test_scaling_of_all_stiffnesses(jacobian, frequencies):
    """f is homogeneous of degree 1/2 in the stiffnesses: sum k df/dk = f/2."""
    total = sum(
        np.tensordot(np.atleast_1d(UNEQUAL[name]), np.asarray(jnp.stack(jax.tree.leaves(jacobian[name]))), 1)
        for name in STIFFNESSES
    )
    np.testing.assert_allclose(total[1:], frequencies[1:] / 2, rtol=1e-11)


@pytest.mark.full
def test_masses_of_a_stiff_gear():
    """Derivatives by a mass with nearly rigid springs, whose forces cancel."""
    stiff = UNEQUAL | {"k_rp": 1e20}
    rows, frequency = reversed_jacobian(dt.Planetary(**stiff))
    frequency, slope = np.asarray(frequency), np.asarray(rows.m_r)
    assert frequency[-1] / frequency[1] > 1e6
    soft = slice(1, 12)
    exact = difference(stiff, "m_r", None)[soft]
    np.testing.assert_allclose(slope[soft], exact, rtol=0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.full
def test_turning_the_gear_changes_nothing(jacobian, frequencies):
    total = np.asarray(sum(jacobian["planet_angle"]))
    assert np.abs(total).max() < 1e-9 * frequencies.max()


@pytest.mark.full
def test_only_a_parameter_splitting_a_doublet_has_no_derivative():
    """With equal spacing the common bearing of planets keeps the translational doublets; an angle splits all six."""
    rows, f = reversed_jacobian(dt.Planetary(**EQUAL))
    near = np.diff(np.asarray(f)) < 1e-6 * np.asarray(f)[1:]
    doublets = np.r_[near, False] | np.r_[False, near]
    assert doublets.sum() == 12
    for slope in rows.planet_angle:
        np.testing.assert_array_equal(np.isnan(np.asarray(slope)), doublets)
    exact = difference(EQUAL, "k_p", None)
    np.testing.assert_allclose(np.asarray(rows.k_p)[1:], exact[1:], rtol=2e-6, atol=2e-7 * np.abs(exact[1:]).max())


@pytest.mark.full
def test_a_rigid_mode_stays_but_for_a_spring_that_would_hold_it(jacobian):
    """For such a spring the frequency grows like sqrt(k); all other modes have derivatives."""
    for name in NAMES:
        slopes = np.stack(jax.tree.leaves(jacobian[name]))
        assert np.isfinite(slopes[:, 1:]).all()
        assert np.isnan(slopes[:, 0]).all() if name in ("k_su", "k_cu") else (slopes[:, 0] == 0).all(), name


def test_one_mass_on_one_spring():
    chain = dt.Driveline(speed=100.0, k=[1e4], c=[1.0], J=[0.1])
    f, slope = jax.value_and_grad(lambda s: dt.modes(s, outputs="natural_frequency").natural_frequency[0])(chain)
    assert slope.k[0] == pytest.approx(f / 2e4) and slope.J[0] == pytest.approx(-f / 0.2)
    assert dt.modes(chain, outputs="multiplicity").multiplicity.tolist() == [1]
