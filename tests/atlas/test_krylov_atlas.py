"""A second smooth analysis in an unchanged atlas: the Krylov determinant over frequency and support stiffness."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.krylov_atlas import RANGES, TOLERANCE, determinant, domain, natural_frequencies, shaft, total_length
from drivetrain_jax.analysis.critical_speeds.frequency_roots import determinant as plain_determinant
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots
from drivetrain_jax.atlas import Quantity, construct, run, values_at

SHORT = {**RANGES, "phase": (1.0, 14.0)}


@pytest.fixture(scope="module")
def atlas():
    return run(construct(domain(SHORT), Quantity(1), TOLERANCE), determinant)


def sample(ranges, count):
    rng = np.random.default_rng(0)
    (low, high), (soft, hard) = ranges.values()
    return np.stack([rng.uniform(low, high, count), np.exp(rng.uniform(np.log(soft), np.log(hard), count))], axis=-1)


def check_errors(atlas, points):
    exact, (found, bound) = determinant(points), values_at(atlas, points)
    error = np.abs(found - exact)[:, 0]
    assert not atlas.gaps
    assert error.max() < TOLERANCE * np.abs(exact).max() and (error <= bound).all()


def test_error_lies_within_tolerance_and_bound(atlas):
    check_errors(atlas, sample(SHORT, 2000))
    assert atlas.solves < 8000


@pytest.mark.full
def test_the_atlas_agrees_with_the_determinant_of_the_paper(atlas):
    """The determinants differ by factors of the supports and a power of the frequency, from the units of the states."""
    phase, k = np.array([1.5, 2.6, 4.1, 5.2]), np.full(4, 2e7)
    bar, q = shaft(jnp.array(k)), phase / total_length()
    plain = np.asarray(plain_determinant(bar, jnp.array(q))) * np.exp(-phase)
    values = values_at(atlas, np.stack([phase, k], axis=-1))[0][:, 0]
    EI, b = np.asarray(bar.EI), (np.asarray(bar.rhoA) / np.asarray(bar.EI)) ** 0.25
    shares = [1 + k / (q**3 * (EI * b**3)[end]) for end in (0, -1)]
    ratio = np.abs(plain / values / (shares[0] * shares[1]))
    power = np.diff(np.log(ratio)) / np.diff(np.log(phase))
    assert power == pytest.approx(np.full(3, round(power[0])), abs=1e-6)


@pytest.mark.full
def test_zeros_of_the_atlas_are_the_natural_frequencies(atlas):
    stiffness = np.array([1e5, 2e7, 1e10])
    expected = np.asarray(find_roots(shaft(jnp.array(stiffness)), 4).q) ** 2
    for k, frequencies in zip(stiffness, expected.T, strict=True):
        assert natural_frequencies(atlas, k)[:4] == pytest.approx(frequencies, rel=1e-10)


@pytest.mark.full
def test_ten_modes():
    atlas = run(construct(domain(), Quantity(1), TOLERANCE), determinant)
    check_errors(atlas, sample(RANGES, 10_000))
