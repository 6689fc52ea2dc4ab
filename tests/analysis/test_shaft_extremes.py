"""Shafts whose segments, supports and masses differ by many powers of ten: counts and stated errors are never wrong."""

from __future__ import annotations

import jax
import mpmath
import numpy as np
import pytest

import drivetrain_jax as dt
from tests.oracles.bicardan_count import frequencies_below

MODES = 6
USUAL = {"length": 0.3, "EI": 2e4, "rhoA": 5.0}
NODES = {"k_A": 5e7, "k_D": 5e7, "m_A": 1.0, "m_D": 1.0}
JOINTS = {"k_joint": 1e7, "m_joint": 1.0, "k_hinge": 1e5}
ENDS = {"k_rot_A": 1e5, "k_rot_D": 1e5, "I_A": 1e-2, "I_D": 1e-2}


def shafts(rng, count, decades, segments, massless, more):
    """Parameters of random shafts, log-uniform over ``2 decades`` powers of ten about usual ones."""

    def spread(usual, *shape):
        return usual * 10.0 ** rng.uniform(-decades, decades, (*shape, count))

    found = {name: spread(x, segments) for name, x in USUAL.items()} | {name: spread(x) for name, x in NODES.items()}
    for name in ("k_A", "k_D"):
        found[name][rng.random(count) < 0.1] = 0.0
    found["rhoA"][rng.random((segments, count)) < massless] = 0.0
    return found | {n: spread(JOINTS[n], segments - 1) if n in JOINTS else spread(ENDS[n]) for n in more}


def certify(points):
    """Check every certified mode against the count to 250 digits; returns the number of checks."""
    entries = {name: tuple(x) if x.ndim > 1 else x for name, x in points.items()}
    outputs = ["angular_frequency", "relative_error", "count_certified"]
    solve = jax.jit(
        jax.vmap(lambda own: dt.critical_speeds(dt.Bicardan(**own), outputs=outputs, modes=MODES).variables)
    )
    found = {name: np.asarray(x) for name, x in solve(entries).items()}
    certified = found["count_certified"] == 1
    assert certified[found["outcome"] == 0].all()
    checked = 0
    # Zero modes count below every other.
    p = found["angular_frequency"]
    for i, mode in zip(*np.nonzero(certified & np.isfinite(p) & (p > 0)), strict=True):
        error = found["relative_error"][i, mode]
        shaft = {name: x[..., i].tolist() for name, x in points.items()}
        with mpmath.workdps(40):
            low, high = (mpmath.mpf(p[i, mode]) * (1 + sign * mpmath.mpf(error)) for sign in (-1, 1))
        assert frequencies_below(high, shaft) > mode, (shaft, mode)
        assert low <= 0 or frequencies_below(low, shaft) <= mode, (shaft, mode)
        checked += 1
    return checked


# Their long segments without mass had waves: three modes of frequencies as 1:4:9, and one of 2e9 Hz.
WAVES = {
    "length": [[3.2e-5, 1.17e-10, 8.9e6], [16.9, 3.7e-7, 1.94e-8], [2.57e19, 1.06e10, 8.23e6]],
    "EI": [[3.01e14, 1.3e-9, 1.2e5], [0.0957, 3.94e-13, 5.34], [3.43e3, 2.2e4, 7.6e6]],
    "rhoA": [[2.69e-11, 0.0, 0.0], [9.4e3, 0.0, 4.4e-6], [0.0, 0.0, 0.0]],
    "m_joint": [[1.8e-8, 6e13, 1.7e-3], [985.0, 1.15e-13, 4.9e5]],
    "k_A": [0.0, 3.36e6, 5.9e5],
    "k_D": [0.0, 6.76e-3, 9.9e6],
    "m_A": [4.6e15, 1.84e6, 6.4e-7],
    "m_D": [4.1e11, 2.0, 8.1e9],
}


@pytest.mark.full
def test_a_long_segment_without_mass_has_no_waves():
    assert certify({name: np.array(x) for name, x in WAVES.items()}) >= 10


KINDS = (
    (3, 0.0, ()),
    (4, 0.0, ("m_joint", "k_joint")),
    (3, 0.0, ("k_hinge",)),
    (3, 0.3, ("m_joint",)),
    (3, 0.3, tuple(ENDS)),
)


@pytest.mark.full
@pytest.mark.parametrize("decades", [2, 6, 10, 20])
@pytest.mark.parametrize("kind", KINDS)
def test_counts_and_errors_of_extreme_shafts(decades, kind):
    assert certify(shafts(np.random.default_rng(decades), 40, decades, *kind)) > 150
