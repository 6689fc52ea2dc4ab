"""Growth and separation margins against closed forms and printed values."""

from __future__ import annotations

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds.analysis import required_margin
from drivetrain_jax.runs.reply import growth_of
from tests.oracles.bicardan_reference import finite_elements


@pytest.mark.parametrize("a", [0.7, -0.7])
def test_growth_follows_an_exponential(a):
    """x = exp(a t) [1/s] of a shaft at 100 rpm: a period of 0.3 s, a turn of 0.6 s."""
    rates = growth_of(dt.Cardan, {}, {"spectral_radius": np.exp(a * 0.3)}, 100.0)
    way, factor = ("double", 2.0) if a > 0 else ("halve", 0.5)
    assert rates.keys() == {"rate", "per_turn", f"time_to_{way}", f"turns_to_{way}"}
    np.testing.assert_allclose([rates["rate"], rates["per_turn"]], [a, np.exp(a * 0.6)], rtol=1e-14)
    np.testing.assert_allclose(np.exp(a * rates[f"time_to_{way}"]), factor, rtol=1e-14)
    np.testing.assert_allclose(rates[f"turns_to_{way}"] * 0.6, rates[f"time_to_{way}"], rtol=1e-14)


def test_neither_growth_nor_an_immediate_end_divides_by_zero():
    known = [growth_of(dt.Cardan, {}, {"spectral_radius": x}, 100.0) for x in (1.0, 0.0, np.nan)]
    assert known == [{}, {"per_turn": 0.0, "time_to_halve": 0.0, "turns_to_halve": 0.0}, {}]


def test_required_margin_of_api_617():
    """None below 2.5; from there 17 (1 - 1/(AF - 1.5)) percent, and 10 more above the range; at most 16 and 26."""
    factors = np.array([1.0, 2.49, 2.5, 3.5, 1e9])
    np.testing.assert_allclose(required_margin(2999.0, 3000.0, factors), [0, 0, 0, 0.085, 0.16], atol=1e-9)
    np.testing.assert_allclose(required_margin(8000.0, 3000.0, factors), [0, 0, 0.1, 0.185, 0.26], atol=1e-9)


def test_margins_of_a_stepped_shaft():
    """The critical speeds 3646, 8088 rpm against 3000-4500 rpm: the first is within."""
    shaft = dt.Bicardan(
        length=(0.3, 1.2, 0.3), EI=(133596.0, 210268.0, 133596.0), rhoA=(22.2, 8.48, 22.2), k_A=5e6, k_D=5e6
    )
    outputs = ["critical_speed", "separation_margin", "required_margin"]
    options = {"operating_min": 3000.0, "operating_max": 4500.0, "amplification": 10.0, "modes": 2}
    found = dt.critical_speeds(shaft, outputs=outputs, **options)
    assert 3000 < found.critical_speed[0] < 4500 < found.critical_speed[1]
    np.testing.assert_allclose(found.separation_margin, [0.0, found.critical_speed[1] / 4500 - 1], rtol=1e-14)
    np.testing.assert_allclose(found.required_margin, 0.25, rtol=1e-14)
    # Without damping the largest margins are required.
    del options["amplification"]
    undamped = dt.critical_speeds(shaft, outputs="required_margin", **options)
    np.testing.assert_allclose(undamped.required_margin, 0.26, rtol=1e-14)


def test_two_discs_of_a_finite_element_model_are_point_data():
    """A 1.5 m shaft of 50 mm on 1 MN/m carries discs of 70 by 280 mm: 96.289, 296.492, 764.685 rad/s."""
    disc, shaft = np.array([0.28, 0.05]), {"E": "211 GPa", "G": "81.2 GPa", "density": 7810.0}
    mass = 7810 * 0.07 * np.pi / 4 * (disc[0] ** 2 - disc[1] ** 2)
    inertia = mass * ((disc**2).sum() / 16 + 0.07**2 / 12)
    data = shaft | {"length": ["500 mm"] * 3, "outer_diameter": ["50 mm"] * 3, "k_A": "1 MN/m", "k_D": "1 MN/m"}
    data |= {"m_joint": [mass, mass], "I_joint": [inertia, inertia], "outputs": ["angular_frequency"], "modes": 3}
    found = dt.point("bicardan", "critical_speeds", **data)
    np.testing.assert_allclose(found.angular_frequency, [96.289, 296.492, 764.685], atol=6e-4)
    given = {name: value for name, value in found.parameters.items() if value != ()}
    np.testing.assert_allclose(finite_elements(given, 3), found.angular_frequency, rtol=1e-9)


def test_two_discs_on_segments_without_mass_in_closed_form():
    """Discs alike at a third of a simply supported shaft: the even and the odd motion, two frequencies each."""
    EI, third, mass, inertia, end = 6.5e4, 0.5, 32.6, 0.178, np.inf
    shaft = dt.Bicardan(
        length=(third,) * 3,
        EI=(EI,) * 3,
        rhoA=(0.0,) * 3,
        k_A=end,
        k_D=end,
        m_joint=(mass,) * 2,
        I_joint=(inertia,) * 2,
    )
    found = dt.critical_speeds(shaft, outputs=["angular_frequency"], modes=4).angular_frequency
    # Half a shaft: its outer part bends as a bar that is pinned at A, its inner part between rotations of one kind.
    outer = np.array([[3, -3 * third], [-3 * third, 3 * third**2]]) * EI / third**3
    even = outer + np.array([[0, 0], [0, 2]]) * EI / third
    odd = outer + np.array([[24, 12 * third], [12 * third, 6 * third**2]]) * EI / third**3
    scale = np.diag([mass**-0.5, inertia**-0.5])
    expected = np.sqrt([np.linalg.eigvalsh(scale @ stiffness @ scale) for stiffness in (even, odd)])
    np.testing.assert_allclose(found, np.sort(expected.ravel()), rtol=1e-12)
