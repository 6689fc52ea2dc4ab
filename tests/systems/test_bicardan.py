"""The bicardanic shaft as a system: refused parameters, and results through scenes."""

from __future__ import annotations

import math

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems.bicardan import PRESETS, Bicardan
from tests.oracles.bicardan_reference import finite_elements

FIXED = {name: list(value) if isinstance(value, tuple) else value for name, value in PRESETS["paper_fitted"].items()}
SCENE = {"system": "bicardan", "analysis": "critical_speeds"}


def refusal(**changes) -> str:
    options = changes.pop("options", {})
    outputs = changes.pop("outputs", ["critical_speed"])
    with pytest.raises(InputError) as error:
        load_scene({**SCENE, "fixed": FIXED | changes, "options": options, "outputs": outputs})
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("length", 0.0), ("length", -1.0), ("length", 1e31), ("EI", 0.0), ("EI", 1e-61), ("rhoA", -1.0), ("rhoA", 1e-61)],
)
def test_entries_are_in_a_range_that_numbers_can_hold(name, value):
    message = refusal(**{name: [FIXED[name][0], value, FIXED[name][2]]})
    least = "1e-30" if name == "length" else "1e-60"
    assert f"{name}[1] = {value}" in message and f"{least} <= {name}[i]" in message


def test_a_segment_without_mass_has_no_rotary_inertia():
    message = refusal(rhoA=[15.0, 0.0, 5.0], rhoI=[0.0, 0.1, 0.0])
    assert message == "fixed.rhoI[1] = 0.1: expected 0 for a segment without mass (rhoA[1] = 0)"
    assert "rhoI[1] = 2" in refusal(rhoA=[15.0, 0.0, 5.0], rhoI=2.0)
    load_scene({**SCENE, "fixed": FIXED | {"rhoA": [15.0, 0.0, 5.0], "rhoI": [0.1, 0.0, 0.1]}})


@pytest.mark.parametrize("name", ["EI", "rhoA", "kGA", "rhoI", "k_joint", "m_joint", "k_hinge", "I_joint"])
def test_lists_must_fit_the_segments(name):
    message = refusal(**{name: [1.0] * 5})
    assert f"fixed.{name} = " in message and "5 entries" in message


def test_supports_may_be_absent_or_rigid_but_not_negative():
    assert "0 <= k_A" in refusal(k_A=-1.0)
    load_scene({**SCENE, "fixed": FIXED | {"k_A": 0.0, "k_D": math.inf}})


def test_the_determinant_knows_no_additions():
    options = {"method": "krylov_determinant"}
    assert "expected the method certified" in refusal(m_joint=[1.0, 1.0], options=options)
    assert "expected the method certified" in refusal(k_rot_A=1.0, options=options)
    assert "expected rhoA[i] > 0" in refusal(rhoA=[15.0, 0.0, 5.0], options=options)


def test_a_margin_needs_operating_speeds():
    assert "options.operating_max" in refusal(outputs=["separation_margin"])
    assert "operating_min" in refusal(
        outputs=["separation_margin"], options={"operating_min": 9.0, "operating_max": 5.0}
    )


def test_operating_speeds_in_the_wrong_order_are_refused():
    assert "operating_max = 5" in refusal(options={"operating_min": 9.0, "operating_max": 5.0})
    assert "operating_max = 0" in refusal(options={"operating_min": 9.0})


def test_what_is_absent_is_left_out():
    plain = Bicardan.of(PRESETS["paper"]).shaft()
    assert plain.m is None and plain.k_hinge is None and not plain.is_timoshenko
    assert plain.k_rot is None and plain.inertia is None
    assert Bicardan.of(PRESETS["paper"] | {"m_D": 1.0}).shaft().m is not None


@pytest.fixture(scope="module")
def swept():
    """k_D swept through 0 and infinity, with all outputs."""
    outputs = ["natural_frequency", "angular_frequency", "critical_speed", "count_certified", "relative_error"]
    return dt.run(
        {
            **SCENE,
            "outputs": [*outputs, "separation_margin", "mode_shape"],
            "axes": {"k_D": {"values": [0.0, 20e6, 85e6, math.inf]}},
            "fixed": {name: value for name, value in FIXED.items() if name != "k_D"},
            "options": {"modes": 8, "operating_min": 600.0, "operating_max": 6000.0},
        }
    )


def test_units_and_certificates(swept):
    assert np.all(swept.outcome == 0) and np.all(swept.count_certified == 1)
    np.testing.assert_allclose(swept.natural_frequency, swept.angular_frequency / (2 * np.pi), rtol=1e-15)
    np.testing.assert_allclose(swept.critical_speed, swept.natural_frequency * 60, rtol=1e-15)
    assert list(swept.mode.values) == [*range(1, 9)] and swept.angular_frequency.dims == ("k_D", "mode")
    assert float(swept.relative_error.max()) < 1e-14
    np.testing.assert_allclose(swept.separation_margin[1:, 0], swept.critical_speed[1:, 0] / 6000 - 1, rtol=1e-12)


@pytest.mark.parametrize(
    ("preset", "pulsations"), [("paper_solid", [748.52, 2519.79]), ("paper_tube", [1062.53, 4004.91])]
)
def test_uniform_bars_of_section_4(preset, pulsations):
    """Results agree in both printed decimals, with one moment of area for the solid bar and its segment of the shaft."""
    found = dt.critical_speeds(Bicardan(**PRESETS[preset]), outputs=["angular_frequency"], modes=2)
    np.testing.assert_allclose(found.angular_frequency, pulsations, atol=0.0055)
    assert PRESETS["paper_solid"]["EI"][0] == PRESETS["paper_fitted"]["EI"][0] == pytest.approx(2.1e11 * 3.06e-7)


def test_section_4(swept):
    """Critical speeds as printed (with 3.14 for pi), and conclusion 3: the amplitude at D for f_A = 1 falls 4.35 times."""
    np.testing.assert_allclose(swept.angular_frequency[1, :2] * 30 / 3.14, [8375.78, 27013.15], atol=0.02)
    at_D = swept.mode_shape[1:3, 0, -1] / swept.mode_shape[1:3, 0, 0]
    assert abs(float(at_D[0] / at_D[1]) - 4.3476) < 1e-4


def test_rising_stiffness_raises_every_frequency(swept):
    assert np.all(np.diff(swept.angular_frequency.values, axis=0) > 0)


def test_mode_shapes(swept):
    """Mode j has j - 1 nodes and the largest deflection 1; without k_D mode 1 is a rotation about A; a rigid support
    holds D."""
    shapes = swept.mode_shape.values
    np.testing.assert_allclose(np.abs(shapes).max(axis=-1), 1.0, rtol=3e-16)
    changes = (np.diff(np.sign(shapes[1]), axis=-1) != 0).sum(axis=-1)
    assert np.array_equal(changes, np.arange(8))
    np.testing.assert_allclose(shapes[0, 0], swept.x.values, atol=1e-15)
    assert np.abs(shapes[3, :, -1]).max() < 1e-13


def test_mode_shapes_are_orthogonal_with_their_rayleigh_quotient(swept):
    """Modes are orthogonal in the mass of the shaft, by numerical integration over the stored stations."""
    x = swept.x.values
    ends = np.cumsum(FIXED["length"]) / sum(FIXED["length"])
    mass = np.array(FIXED["rhoA"])[np.minimum(np.searchsorted(ends, x), 2)]
    for shapes in swept.mode_shape.values[:, :4]:
        products = np.trapezoid(mass * shapes[:, None] * shapes[None], x, axis=-1)
        size = np.sqrt(np.diag(products))
        assert np.abs(products / np.outer(size, size) - np.eye(4)).max() < 0.03


def test_an_entry_and_an_addition_as_axes():
    axes = {"length[1]": {"values": [0.4, 0.59]}, "k_hinge": {"values": [1e4, 1e6]}}
    result = dt.run({**SCENE, "outputs": ["angular_frequency"], "axes": axes, "fixed": FIXED, "options": {"modes": 3}})
    for i, length in enumerate((0.4, 0.59)):
        for j, k_hinge in enumerate((1e4, 1e6)):
            values = PRESETS["paper_fitted"] | {"length": (0.07, length, 0.25), "k_hinge": k_hinge}
            np.testing.assert_allclose(result.angular_frequency[i, j], finite_elements(values, 3), rtol=1e-10)


@pytest.mark.full
def test_the_determinant_dies_near_mode_12(swept):
    """The determinant is right for the first modes, even with a rigid support; the count exposes its error at mode 13."""
    result = dt.run(
        {
            **SCENE,
            "outputs": ["angular_frequency", "count_certified"],
            "axes": {"k_D": {"values": [0.0, 20e6, math.inf]}},
            "fixed": {name: value for name, value in FIXED.items() if name != "k_D"},
            "options": {"method": "krylov_determinant", "modes": 13},
        }
    )
    exact = finite_elements(PRESETS["paper_fitted"], 13, bubbles=24)
    error = np.abs(result.angular_frequency.values[1] / exact - 1)
    assert error[:5].max() < 1e-11 and error[12] > 1e-5
    assert np.all(result.count_certified[:, :6] == 1) and np.all(result.count_certified[:, 12] == 0)
    assert np.all(result.outcome == 1)
    certified = swept.angular_frequency.values[[0, 3], :5]
    np.testing.assert_allclose(result.angular_frequency.values[[0, 2], :5], certified, rtol=1e-11)


@pytest.mark.full
def test_a_stiffer_support_lowers_the_amplitudes_at_the_characteristic_points():
    """Conclusion 3 of the paper, f_A = 1 and k_D from 20e6 to 85e6; expected from transfer matrices in 40 digits."""
    stations, points = 92, [7, 66, 91]
    soft, stiff = (
        dt.critical_speeds(
            Bicardan(**PRESETS["paper_fitted"] | {"k_D": k}), outputs=["mode_shape"], modes=2, stations=stations
        )
        for k in (20e6, 85e6)
    )
    ratio = [s.mode_shape[:, points] / s.mode_shape[:, :1] for s in (soft, stiff)]
    expected = [[1.01745, 1.03817, 4.3476], [1.04585, 1.00416, 4.58017]]
    np.testing.assert_allclose(ratio[0] / ratio[1], expected, rtol=1e-5)
