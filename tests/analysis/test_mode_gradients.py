"""Derivatives of the natural frequencies against differences of the 50-digit oracle, and identities they obey."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.planetary_reference import TABLE_2, exact_frequencies
from drivetrain_jax.analysis.spectra.mode_gradients import directional_derivatives, natural_frequencies
from drivetrain_jax.systems.planetary import Planetary

ANGLES = (0.1, 1.5, 3.0, 4.9)
UNEQUAL = TABLE_2 | {"planet_angle": ANGLES, "m_p": (0.6, 0.66, 0.7, 0.75), "k_sp": (4e8, 5e8, 6e8, 5.5e8)}
EQUAL = TABLE_2 | {"planet_angle": tuple(i * np.pi / 2 for i in range(4))}
STIFFNESSES = [name for name in TABLE_2 if name.startswith("k_")]
K_P = jnp.array([1e7, 1e8, 1e9])
NAMES = [*STIFFNESSES, "m_p", "m_s", "I_c", "pressure_angle", "planet_angle"]


def twice(p):
    f = natural_frequencies(Planetary.models["modes"].build, p)
    return f, f


@pytest.fixture(scope="module")
def reverse():
    """Derivatives of a gear whose planets differ, by reverse mode, and its frequencies."""
    return jax.jit(jax.jacrev(twice, has_aux=True))(UNEQUAL)


@pytest.fixture(scope="module")
def jacobian(reverse):
    return reverse[0]


@pytest.fixture(scope="module")
def frequencies(reverse):
    return np.asarray(reverse[1])


@pytest.fixture(scope="module")
def forward():
    """Frequencies of equally spaced planets in three lanes of k_p, and their derivatives along (k_p, planet_angle)."""

    @jax.jit
    def along(k_p, angles):
        def moving(k, psi):
            return natural_frequencies(Planetary.models["modes"].build, EQUAL | {"k_p": k, "planet_angle": psi})

        return jax.jvp(moving, (K_P, EQUAL["planet_angle"]), (k_p, angles))

    return lambda rate, angles: tuple(np.asarray(x) for x in along(rate * jnp.ones(3), angles))


def moved(p: dict, name: str, entry: int | None, step: float) -> dict:
    if entry is None:
        return p | {name: p[name] + step}
    return p | {name: tuple(x + step * (i == entry) for i, x in enumerate(p[name]))}


def difference(p: dict, name: str, entry: int | None) -> np.ndarray:
    """Central difference of the oracle, of error 1e-9 and less."""
    value = p[name] if entry is None else p[name][entry]
    step = 1e4 if value == 0 else 1e-6 * max(abs(value), 1.0 if "angle" in name else 0.0)
    if value == 0:
        low, middle, high = (np.array(exact_frequencies(moved(p, name, entry, i * step))) for i in range(3))
        return (-3 * low + 4 * middle - high) / (2 * step)
    low, high = (np.array(exact_frequencies(moved(p, name, entry, s * step))) for s in (-1, 1))
    return (high - low) / (2 * step)


@pytest.mark.parametrize("name", NAMES)
def test_against_differences(jacobian, name):
    entry = 1 if isinstance(UNEQUAL[name], tuple) else None
    ours = np.asarray(jacobian[name] if entry is None else jacobian[name][entry])
    exact = difference(UNEQUAL, name, entry)
    # The rigid mode turns into a spring-mass mode, f = sqrt(k)/..., of which there is no derivative at k = 0.
    np.testing.assert_allclose(ours[1:], exact[1:], rtol=2e-6, atol=2e-7 * np.abs(exact[1:]).max())


def test_planets_that_differ_slightly():
    """Planet modes 1.5e-7 apart, more than a cluster is wide: value and derivative of each are its own."""
    listed = tuple(1e8 * (1 + 1e-5 * x) for x in (0, 0.3, -0.5, 0.9, -0.2, 0.6))
    p = TABLE_2 | {"planet_angle": tuple(2 * np.pi * i / 6 for i in range(6)), "k_p": listed}
    rate = jax.tree.map(lambda x: 0.0, p) | {"k_p": (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)}
    slope = jax.jit(lambda q, d: jax.jvp(lambda x: natural_frequencies(Planetary.models["modes"].build, x), (q,), (d,)))
    value, ours = map(np.asarray, slope(p, rate))
    low, here, high = (np.array(exact_frequencies(moved(p, "k_p", 1, step))) for step in (-0.1, 0.0, 0.1))
    np.testing.assert_allclose(value[1:], here[1:], rtol=1e-13)
    gaps = np.diff(here, prepend=-np.inf, append=np.inf) / here.clip(1)[np.r_[0 : here.size, -1]]
    alone = np.minimum(gaps[:-1], gaps[1:]) > 6e-8
    alone[0] = False
    close = alone & (np.minimum(gaps[:-1], gaps[1:]) < 5e-7)
    assert close.sum() > 3
    np.testing.assert_allclose(ours[alone], ((high - low) / 0.2)[alone], rtol=1e-3, atol=1e-10)


def test_scaling_of_all_stiffnesses(jacobian, frequencies):
    """f is homogeneous of degree 1/2 in the stiffnesses: sum k df/dk = f/2."""
    total = sum(
        np.tensordot(np.atleast_1d(UNEQUAL[name]), np.asarray(jnp.stack(jax.tree.leaves(jacobian[name]))), 1)
        for name in STIFFNESSES
    )
    np.testing.assert_allclose(total[1:], frequencies[1:] / 2, rtol=1e-11)


def test_masses_of_a_stiff_gear():
    """Derivatives by a mass where springs are nearly rigid, whose forces cancel."""
    stiff = UNEQUAL | {"k_rp": 1e20}
    along = jax.jit(lambda p, d: jax.jvp(lambda q: natural_frequencies(Planetary.models["modes"].build, q), (p,), (d,)))
    frequency, slope = map(np.asarray, along(stiff, jax.tree.map(lambda x: 0.0, stiff) | {"m_r": 1.0}))
    assert frequency[-1] / frequency[1] > 1e6
    soft = slice(1, 12)
    exact = difference(stiff, "m_r", None)[soft]
    np.testing.assert_allclose(slope[soft], exact, rtol=0, atol=1e-8 * np.abs(exact).max())


def test_turning_the_gear_changes_nothing(jacobian, frequencies):
    total = np.asarray(sum(jacobian["planet_angle"]))
    assert np.abs(total).max() < 1e-9 * frequencies.max()


@pytest.mark.full
def test_forward_and_reverse_agree(jacobian):
    tangent = jax.tree.map(lambda x: 0.0, UNEQUAL) | {"k_p": 1.0}
    forward = jax.jit(
        lambda p, d: jax.jvp(lambda q: natural_frequencies(Planetary.models["modes"].build, q), (p,), (d,))[1]
    )
    along = forward(UNEQUAL, tangent)
    np.testing.assert_allclose(np.asarray(along), np.asarray(jacobian["k_p"]), rtol=1e-10, atol=1e-20)


def test_doublets_get_the_derivative_of_their_mean_and_split_along_the_projected_matrix(forward):
    """Moving one planet splits the translational doublets of equal spacing."""
    tangent = jax.tree.map(lambda x: 0.0, EQUAL) | {"planet_angle": (0.0, 1.0, 0.0, 0.0)}
    split = np.asarray(
        jax.jit(lambda p, d: directional_derivatives(Planetary.models["modes"].build, p, d))(EQUAL, tangent)
    )
    mean = forward(0.0, tangent["planet_angle"])[1][:, 1]
    step = 1e-5
    here = np.array(exact_frequencies(EQUAL))
    there = np.array(exact_frequencies(moved(EQUAL, "planet_angle", 1, step)))
    ahead = np.array(exact_frequencies(moved(EQUAL, "planet_angle", 1, 2 * step)))
    one_sided = (-3 * here + 4 * there - ahead) / (2 * step)
    np.testing.assert_allclose(split[1:], one_sided[1:], rtol=1e-5, atol=1e-2)
    doublets = np.flatnonzero(np.diff(here) < 1e-6 * here[1:])
    assert doublets.size == 6
    np.testing.assert_allclose(mean[doublets], (split[doublets] + split[doublets + 1]) / 2, atol=1e-6)
    np.testing.assert_allclose(mean[doublets], mean[doublets + 1], atol=1e-9)
    assert np.abs(split[doublets + 1] - split[doublets]).max() > 10


def test_lanes_and_a_rigid_mode(forward):
    value, slope = forward(1.0, (0.0,) * 4)
    assert value.shape == slope.shape == (21, 3)
    assert (slope[0] == 0).all() and (value[0] < 1e-9).all()
    for lane, k in enumerate(K_P.tolist()):
        exact = difference(EQUAL | {"k_p": k}, "k_p", None)
        np.testing.assert_allclose(slope[1:, lane], exact[1:], rtol=2e-6, atol=2e-7 * np.abs(exact[1:]).max())


def test_whole_numbers_are_numbers():
    rate = jax.tree.map(lambda x: 0, EQUAL) | {"k_p": 1}
    whole, broken = (
        directional_derivatives(Planetary.models["modes"].build, EQUAL | {"m_s": m}, rate) for m in (1, 1.0)
    )
    np.testing.assert_array_equal(np.asarray(whole), np.asarray(broken))
