"""Sections, their measures, and the 0-1 test."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.lyapunov.section_measures import chaos_k01, period_multiple, torus_residual
from drivetrain_jax.systems import Flow, System, serves

FIXED = {"element": "input", "beta": math.radians(9), "zeta": 0.0186, "chi_n": 0.0026}
# 3000 Hz strobes against a motor torque of 300 Hz close after 10, 3066.5 Hz after 6133.
FREQUENCIES = [3000.0, 3066.5]


def section(outputs: list[str], **options) -> object:
    scene = {"system": "tripod", "analysis": "poincare", "outputs": outputs, "fixed": FIXED, "options": options}
    return dt.run(scene | {"axes": {"excitation_frequency": {"values": FREQUENCIES}}})


@pytest.fixture(scope="module")
def motor():
    """Sections after 800 strobes, which are 45 decay times of the transient at this damping."""
    return section(["section", "torus_residual", "distinct_points", "chaos_k01"], strobes=1024, discard=800, steps=24)


@pytest.mark.full
def test_input_element_ends_on_a_torus(motor):
    """The section is a smooth function of the angle of the motor's torque, also in the periodic case."""
    assert motor.section.dims == ("excitation_frequency", "strobe", "state")
    assert motor.torus_residual.values[1].max() < 1e-6
    assert motor.distinct_points.values.tolist() == [10, 0]


@pytest.mark.full
def test_regular_motion_does_not_diffuse(motor):
    assert (np.abs(motor.chaos_k01) < 0.1).all()


@pytest.mark.full
def test_a_section_that_repeats_has_k_zero():
    """The section has five points, for which the plain test over 128 strobes gives K = 0.94."""
    scene = {"system": "tripod", "analysis": "poincare", "outputs": ["section", "chaos_k01"]}
    fixed = {"element": "input", "beta": 0.157, "zeta": 0.05, "chi_n": 0.2, "excitation_frequency": 500.0}
    found = dt.run(scene | {"fixed": fixed | {"equation": "29"}, "options": {"strobes": 128, "discard": 500}})
    assert found.outcome == Outcome.SUCCESS
    assert chaos_k01(jnp.asarray(found.section.values)).max() > 0.9
    assert found.chaos_k01 == 0


@pytest.mark.full
def test_few_strobes_that_do_not_repeat_tell_nothing_of_chaos():
    """A torus needs 512 strobes; fewer may give any K."""
    found = [section(["chaos_k01"], strobes=n, discard=800, steps=24).chaos_k01.values for n in (511, 512)]
    np.testing.assert_array_equal(np.isnan(found), [[False, True], [False, False]])
    assert found[0][0] == 0 and abs(found[1][1]) < 0.1


def test_the_angle_of_a_section_lies_within_a_turn():
    """A turning pendulum gains some 90 rad a strobe; the curve of its section is closed on the cylinder."""

    class Turning(System):
        name = title = "turning"

        @serves("poincare")
        def flow(self):
            def field(angles, y):
                return y[1], 2.0 + 0.5 * jnp.cos(angles[0]) - 0.2 * y[1] - jnp.sin(y[0])

            return Flow(field, (0.1, 0.0), period=2 * math.pi / 0.7, turns=(1,), cyclic=(0,))

    section = dt.poincare(Turning(), strobes=128, discard=20, steps=24).section
    assert 3.0 < jnp.max(jnp.abs(section[:, 0])) <= math.pi
    assert jnp.ptp(section[:, 1]) < 0.3


@pytest.mark.full
def test_section_repeats_exactly():
    points = section(["section"], strobes=128, discard=500, steps=24).section.values[0]
    assert np.abs(points[10:] - points[:-10]).max() < 1e-9 * np.abs(points).max()
    assert len(np.unique(np.round(points[:, 0] / np.abs(points[:, 0]).max(), 7))) == 10


@pytest.mark.full
def test_loose_tolerances_blur_the_section(motor):
    """The loose section differs from equal steps of order 8 by more than its extent, and its outcome shows it."""
    extent = np.ptp(motor.section.values[1, :, 0])
    found = {}
    for rtol, atol in ((1e-3, 1e-6), (1e-9, 1e-12)):
        options = {"method": "adaptive", "strobes": 128, "discard": 800, "rtol": rtol, "atol": atol}
        ours = section(["section", "strobe_error", "section_error"], **options)
        missed = ours.section_error > min(1e-6, 10 * rtol)
        np.testing.assert_array_equal(ours.outcome, np.where(missed, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS))
        assert ((ours.strobe_error > 1e-6) == (rtol == 1e-3)).all()
        # Errors of steps add up over the decay time of the motion.
        assert (ours.section_error > ours.strobe_error).all()
        found[rtol] = np.abs(ours.section.values[1, :, 0] - motor.section.values[1, :128, 0]).max() / extent
    assert found[1e-3] > 1
    assert found[1e-9] < 1e-2


@pytest.mark.full
def test_steps_that_are_too_long_are_noticed():
    """With four natural half periods per strobe, the estimate is of the size of the change by eight times the steps."""
    scene = {"system": "tripod", "analysis": "poincare", "outputs": ["section", "strobe_error"]}
    scene |= {"fixed": FIXED | {"excitation_frequency": 1500.0}}
    coarse, fine = (dt.run(scene | {"options": {"strobes": 128, "discard": 800, "steps": n}}) for n in (6, 48))
    assert coarse.outcome == Outcome.TOLERANCE_NOT_MET
    assert fine.outcome == Outcome.SUCCESS
    difference = float(np.abs(coarse.section - fine.section).max() / np.abs(fine.section).max())
    assert 0.1 * float(coarse.strobe_error) < difference < 100 * float(coarse.strobe_error)


OUTPUT_ELEMENT = {"element": "output", "equation": "26", "M_MS": 4002.639767285174}
OUTPUT_ELEMENT |= {"excitation_frequency": 4754.933122197243, "zeta": 1.5383755066975724, "chi_n": 0.4978108469450189}
INPUT_ELEMENT = {"element": "input", "equation": "25"}


@pytest.mark.parametrize(
    ("fixed", "start", "discard"),
    [
        (OUTPUT_ELEMENT, (1.0925995030791809, 91428.57142857143), 0),
        pytest.param(
            INPUT_ELEMENT | {"zeta": 0.007724415608099983, "chi_n": 0.335893153586345},
            (-2.3362162256755377, -128600.2548853408),
            20,
            marks=pytest.mark.full,
        ),
    ],
)
@pytest.mark.full
def test_errors_of_a_violent_start_are_told(fixed, start, discard):
    """The errors come from the first strobe or from discarded strobes; single strobes of the section are right to 1e-8."""
    fixed = fixed | {"beta": 0.157, "phi0": start[0], "velocity0": start[1]}
    scene = {"system": "tripod", "analysis": "poincare", "outputs": ["section", "section_error"], "fixed": fixed}
    ours, finer = (dt.run(scene | {"options": {"strobes": 128, "discard": discard, "steps": n}}) for n in (48, 192))
    element = {name: fixed[name] for name in ("element", "beta", "chi_n")}
    omega = float(dt.point("tripod", "parameters", **element).natural_angular_frequency)
    units = np.array([1.0, omega])
    error = float(np.abs((ours.section - finer.section) / units).max() / np.abs(ours.section / units).max())
    assert error > 1e-5
    assert 0.95 < float(ours.section_error) / error < 1.1
    assert ours.outcome == Outcome.TOLERANCE_NOT_MET
    assert finer.outcome == Outcome.SUCCESS


@pytest.mark.full
def test_a_violent_neighbour_does_not_matter():
    """A member that needs a second march does not change its neighbour."""
    scene = {"system": "tripod", "analysis": "poincare", "outputs": ["section_error"]}
    scene |= {"fixed": OUTPUT_ELEMENT | {"beta": 0.157}, "options": {"strobes": 128, "discard": 0, "steps": 24}}
    speeds = [1e3, 105714.28571428572]
    both = dt.run(scene | {"axes": {"velocity0": {"values": speeds}}})
    alone = [float(dt.run(scene | {"axes": {"velocity0": {"values": [v]}}}).section_error[0]) for v in speeds]
    assert both.outcome.values.tolist() == [Outcome.SUCCESS, Outcome.TOLERANCE_NOT_MET]
    np.testing.assert_allclose(both.section_error, alone, rtol=1e-6, atol=1e-15)


class TestZeroOne:
    """The test of Gottwald & Melbourne 2009 for regular and chaotic series of the logistic map, and for a constant."""

    @staticmethod
    def logistic(rates) -> np.ndarray:
        x, series = np.full(len(rates), 0.3), []
        for _ in range(2500):
            x = np.asarray(rates) * x * (1 - x)
            series.append(x)
        return np.array(series[500:])

    @pytest.mark.full
    def test_logistic_map(self):
        values = np.asarray(jax.jit(chaos_k01)(self.logistic([3.55, 3.97, 4.0 - 1e-9])))
        np.testing.assert_allclose(values, [0.0, 1.0, 1.0], atol=0.02)

    @pytest.mark.full
    def test_quasi_periodic_and_constant(self):
        n = np.arange(2000)
        series = np.stack([np.cos(math.sqrt(2) * n), np.full(2000, 3.7)], axis=1)
        np.testing.assert_allclose(np.asarray(chaos_k01(jnp.asarray(series))), 0.0, atol=0.05)

    def test_it_is_its_definition(self):
        """K equals walks, mean square displacements and correlations by plain NumPy."""
        series = self.logistic([3.7, 3.95])[:400, 0]
        centred, n, values = series - series.mean(), np.arange(1, 401), []
        for angle in math.pi / 5 + 3 * math.pi / 5 * (np.arange(100) + 0.5) / 100:
            walk = np.cumsum(centred * np.exp(1j * angle * n))
            distance = [np.mean(np.abs(walk[k : k + 360] - walk[:360]) ** 2) for k in range(1, 41)]
            values.append(np.corrcoef(distance, np.arange(1, 41))[0, 1])
        assert float(chaos_k01(jnp.asarray(series))) == pytest.approx(np.median(values), abs=1e-10)

    @pytest.mark.full
    def test_scale_and_offset_do_not_matter(self):
        series = self.logistic([3.97])
        np.testing.assert_allclose(chaos_k01(jnp.asarray(1e-4 * series + 5)), chaos_k01(jnp.asarray(series)), atol=1e-6)


def test_period_multiple_counts_distinct_points():
    k = np.arange(1200)
    rows = [np.cos(2 * np.pi * k * 3 / 7), np.ones(1200), np.cos(math.sqrt(5) * k), np.zeros(1200)]
    series = jnp.asarray(np.array(rows).T[:, None, :])
    assert period_multiple(series, jnp.float64(1e-9), 500).tolist() == [7, 1, 0, 1]


@pytest.mark.full
def test_torus_residual_sees_noise():
    rng = np.random.default_rng(0)
    angle = (np.sqrt(2) * np.arange(3000)) % (2 * np.pi)
    smooth = np.exp(np.cos(angle)) + 0.3 * np.sin(5 * angle)
    states = np.stack([smooth, smooth + 1e-3 * rng.standard_normal(3000)], axis=1)
    clean, noisy = np.asarray(torus_residual(jnp.asarray(states), jnp.asarray(angle)))
    assert clean < 1e-12
    assert 1e-4 < noisy < 1e-2


@pytest.mark.full
def test_a_parameter_of_the_field_may_vary():
    """Nothing is discarded either, so that a march of no steps has unused inputs (see ``in_one_kernel``)."""
    others = {name: value for name, value in FIXED.items() if name != "zeta"}
    scene = {
        "system": "tripod",
        "analysis": "poincare",
        "outputs": ["section"],
        "axes": {"zeta": {"start": 0.01, "stop": 0.02, "num": 8}},
        "fixed": others | {"excitation_frequency": 3066.5},
    }
    fixed = dt.run(scene | {"options": {"strobes": 128, "discard": 0, "steps": 24}})
    pair = dt.run(
        scene | {"options": {"method": "adaptive", "strobes": 128, "discard": 0, "rtol": 1e-11, "atol": 1e-15}}
    )
    assert (fixed.outcome == Outcome.SUCCESS).all()
    np.testing.assert_allclose(fixed.section, pair.section, rtol=0, atol=1e-7 * float(abs(pair.section).max()))


@pytest.mark.full
def test_sections_that_never_end_are_not_begun():
    fixed = {"element": "input", "beta": 0.1, "zeta": 0.0016, "excitation_frequency": 3e3}
    options = {"strobes": 128, "discard": 1_000_000_000, "steps": 1_000_000}
    ours = dt.run({"system": "tripod", "analysis": "poincare", "fixed": fixed, "options": options})
    assert ours.outcome == Outcome.STEP_LIMIT and np.isnan(ours.section).all()
