"""A second smooth analysis in an unchanged atlas: the Krylov determinant over frequency and support stiffness.

The determinant Psi(q, k) (docs/theory/bicardan.md), q = sqrt(p), grows like exp(phase), phase = q sum of
l (rhoA/EI)^(1/4). Psi exp(-phase) is a smooth function of the phase and of ln k, where k is the stiffness of both supports.
The determinant comes from the compound form, because the plain product of transfer matrices loses a factor exp(phase) in
accuracy. The zeros of the atlas along the phase are the natural frequencies for any k.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from drivetrain_jax.analysis.critical_speeds.compound import planes
from drivetrain_jax.analysis.critical_speeds.frequency_roots import determinant as plain_determinant
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots
from drivetrain_jax.analysis.critical_speeds.segments import Scales
from drivetrain_jax.atlas import Atlas, Domain, Quantity, construct, run, values_at
from drivetrain_jax.systems import Coordinate, Shaft, get_system

TOLERANCE = 1e-11
RANGES = {"phase": (1.0, 32.0), "k": (1e5, 1e10)}
_PRESET = get_system("bicardan").presets["paper_fitted"]


def domain(ranges: Mapping[str, tuple[float, float]] = RANGES) -> Domain:
    """The domain of the atlas: the phase, and the stiffness by its logarithm."""
    same = Coordinate("phase", np.asarray, np.asarray, lambda x: np.ones_like(np.asarray(x, float)))
    logarithm = Coordinate("ln k", np.log, np.exp, lambda k: 1 / np.asarray(k))
    lower, upper = zip(*ranges.values(), strict=True)
    return Domain(tuple(ranges), lower, upper, (same, logarithm), {})


def shaft(k: jax.Array) -> Shaft:
    """The paper's shaft on two supports of stiffness ``k`` ``(N,)``, N/m."""
    lists = {name: jnp.asarray(_PRESET[name])[:, None] for name in ("length", "EI", "rhoA")}
    return Shaft(**lists, k=jnp.stack([k, 0 * k, 0 * k, k]))


def total_length() -> float:
    """The sum of l (rhoA/EI)^(1/4) over the segments, the phase divided by q."""
    length, stiffness, mass = (np.array(_PRESET[name]) for name in ("length", "EI", "rhoA"))
    return float(np.sum(length * (mass / stiffness) ** 0.25))


@jax.jit
def _scaled(phase: jax.Array, k: jax.Array) -> jax.Array:
    bar, q = shaft(k), phase / total_length()
    _, (_, u1, _, _, u4), _, growth = planes(bar, q)
    support = k / (q**3 * Scales.of(bar).e3[-1])
    return (u4[-1] + support * u1[-1]) / (1 + support) * jnp.exp(growth[-1] - phase)


def determinant(points: np.ndarray) -> np.ndarray:
    """Psi exp(-phase) at points (phase, k), ``(N, 2) -> (N, 1)``."""
    size = -(-len(points) // 512) * 512
    padded = np.pad(points, ((0, size - len(points)), (0, 0)), mode="edge")
    return np.asarray(_scaled(padded[:, 0], padded[:, 1]))[: len(points), None]


def phases(atlas: Atlas, k: float) -> np.ndarray:
    """Zeros of the atlas along the phase at one stiffness."""
    line = np.linspace(atlas.lower[0], atlas.upper[0], 2001)

    def value(phase: float) -> float:
        return float(values_at(atlas, np.array([[phase, k]]))[0][0, 0])

    values = values_at(atlas, np.stack([line, np.full(line.shape, k)], axis=-1))[0][:, 0]
    return np.array([brentq(value, line[i], line[i + 1], xtol=1e-14) for i in np.flatnonzero(np.diff(values > 0))])


def natural_frequencies(atlas: Atlas, k: float) -> np.ndarray:
    """Angular frequencies in rad/s from the zeros of the atlas."""
    return (phases(atlas, k) / total_length()) ** 2


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
