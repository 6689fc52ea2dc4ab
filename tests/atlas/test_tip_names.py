"""Names of tips along a parameter that moves the resonances, against pairs of multipliers followed by direct solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.atlas import tips as naming
from drivetrain_jax.atlas.boundaries import boundaries
from drivetrain_jax.resonances import natural_frequencies
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, monodromy, propagators

BETA = np.pi / 6


@pytest.fixture(scope="module")
def stiffnesses():
    """The atlas of the part of Fig. 7 in which C+2 has a gap."""
    return cardan_atlas({"mu": (4.0, 6.5), "Omega": (0.62, 0.72)}, 1e-11, {**BASE, "beta": BETA}).atlas


def combination(mu):
    """Omega of C+2 at beta = 0."""
    return float(natural_frequencies(mu, 100.0).sum()) / 4


def meeting(beta, omega, mu, steps=13):
    """Omega at which two pairs of multipliers meet without damping, and the discriminant there.

    The point is followed from ``beta`` down to 0.04 ``beta`` in ``steps``. It is the minimum of the discriminant of
    sigma + 1/sigma, which is minus the square of the growth. The minimum comes from parabolas through direct solves.
    """
    x = np.linspace(-1, 1, 5)
    for angle in beta * np.linspace(1.0, 0.04, 13)[:steps]:
        for width in (1e-3, 2e-4):
            columns = {**BASE, "mu": mu, "zeta": 0.0, "beta": angle, "Omega": omega * (1 + width * x)}
            z = monodromy(propagators(columns, 1e-14))
            a, squares = (np.trace(m, axis1=1, axis2=2) for m in (z, z @ z))
            value, slope, bend = np.polynomial.polynomial.polyfit(x, squares / 2 - a**2 / 4 + 2, 2)
            omega *= 1 - width * slope / (2 * bend)
    return omega, value - slope**2 / (4 * bend)


@pytest.mark.full
def test_tips_over_the_stiffness_ratio_have_the_resonance_name(stiffnesses):
    """C+2 closes and opens again. Its ridge leaves the rectangle long before the least stiffness."""
    tips = naming.find_tips(stiffnesses, CARDAN, opening=False).tips
    assert [(tip.name, tip.opens) for tip in tips] == [("C+2", False), ("C+2", True)]
    assert [tip.point["mu"] for tip in tips] == pytest.approx([5.015, 6.133], abs=1e-3)
    for tip in tips:
        mu, omega = tip.point["mu"], tip.point["Omega"]
        assert meeting(BETA, omega, mu)[0] == pytest.approx(combination(mu), rel=1e-5)


def test_the_coupling_of_c2_passes_zero_within_its_gap():
    """Without damping the growth falls to 0 from both sides: at mu = 5.5 it is less than a tenth of that at 4.5 and 6.5."""
    growth = [np.sqrt(max(-meeting(BETA, combination(mu), mu, 1)[1], 0.0)) for mu in (4.5, 5.5, 6.5)]
    assert growth[1] < 0.1 * min(growth[0], growth[2])


def test_orders_suffice_for_every_resonance_of_an_atlas(stiffnesses):
    """Over the stiffness ratio the fastest resonances are at its upper end: S217 is at 4.60/33."""
    wide = replace(stiffnesses, lower=np.array([1.0, 0.139]), upper=np.array([20.0, 2.0]))
    speed = float(natural_frequencies(20.0, 100.0)[1]) / 33
    assert naming._name(wide, CARDAN, "-1", wide.to_coordinates(np.array([20.0, speed]))) == "S217"


@pytest.mark.full
def test_each_tongue_over_the_stiffness_ratio_has_one_curve(stiffnesses):
    """A curve runs from rim to rim through its tip, and seeds on the rim are recognised as its ends."""
    curves = boundaries(stiffnesses, CARDAN)
    assert sorted(float(curve.points["mu"].max()) for curve in curves) == pytest.approx([5.015, 6.5], abs=1e-3)
    for curve in curves:
        ends = np.stack([curve.points[name][[0, -1]] for name in ("mu", "Omega")], axis=-1)
        distance = np.abs(np.stack([ends - stiffnesses.lower, ends - stiffnesses.upper])).min(axis=(0, 2))
        assert distance == pytest.approx([0.0, 0.0], abs=1e-8)
