"""Multiple scales and describing function against quadrature, published values and integration in time."""

from __future__ import annotations

import itertools
import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from drivetrain_jax.analysis.frequency_response import closed_form_response, describing_function
from drivetrain_jax.analysis.frequency_response.describing_function import follow, refined
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.quick_jit import quick_jit
from tests.sizes import full_after

TABLE1 = PRESETS["table1"] | {"omega": 1.0}
MODEL = Rattle.models["basins"].build(TABLE1)
OMEGAS = np.array([0.3, 0.5, 0.76, 0.8, 0.84, 0.9, 1.0, 1.3])
# Cases by lane: Table 1 first, then limits.
CASES = (
    {},
    {"b": 0.0},
    {"alpha": 1.0},
    {"alpha": 0.0},
    {"alpha": 2.0},
    {"c": 0.0},
    {"B1": 0.0},
    {"B1": 1e-4, "B0": 0.3},
    {"B1": -0.03},
    {"k": 1e6, "I": 1e6, "c": 5e4},
)
OUTPUTS = ("u_max", "u_min", "u_rms", "phase", "stability", "spectral_radius", "residual", "branch_u_max",
           "branch_u_min", "branch_stability", "peak_amplitude", "peak_frequency", "fold_frequency",
           "backbone_amplitude")  # fmt: skip


def lanes(cases) -> dict[str, np.ndarray]:
    tables = [TABLE1 | case for case in cases]
    return {name: np.array([table[name] for table in tables]) for name in TABLE1}


@cache
def compiled(method: str, omegas: tuple[float, ...], shape: tuple[int, ...], fit_range: float | None, outputs=OUTPUTS):
    """The compiled response at ``omegas``, as a function of the other parameters."""

    def run(values):
        model = Rattle.models["basins"].build(values | {"omega": np.array(omegas)})
        return closed_form_response.response(model, method, fit_range, shape, outputs)

    return quick_jit(run)


def solve(method: str, omegas=OMEGAS, cases=CASES, fit_range: float | None = None) -> dict[str, np.ndarray]:
    run = compiled(method, tuple(omegas), (len(cases),), fit_range)
    return {name: np.asarray(value) for name, value in run(lanes(cases)).items()}


@pytest.fixture(scope="module")
def scales():
    return solve("multiple_scales")


@pytest.fixture(scope="module")
def describing():
    return solve("describing_function")


def linear(values, omega):
    stiffness, damping = values["k"] / values["I"], values["c"] / values["I"]
    return abs(values["B1"]) / np.hypot(stiffness - omega**2, damping * omega)


def test_cubic_is_the_least_squares_fit():
    model, reach = MODEL, 0.9
    fit = closed_form_response.cubic_fit(model, jnp.array(reach))
    powers = np.array([[2 * reach ** (i + j + 1) / (i + j + 1) for j in (1, 3)] for i in (1, 3)])
    moments = [
        2 * quad(lambda u, i=i: float(model.restoring(u)) * u**i, 0, reach, points=[model.b], epsabs=1e-13)[0]
        for i in (1, 3)
    ]
    np.testing.assert_allclose([fit.stiffness, fit.cubic], np.linalg.solve(powers, moments), rtol=1e-10)


def test_multiple_scales_of_table_1():
    fit = closed_form_response.cubic_fit(MODEL, jnp.array(1.0))
    flow = closed_form_response.slow_flow(MODEL, fit)
    np.testing.assert_allclose([fit.stiffness, fit.cubic], [0.6441, 0.2692], atol=5e-5)
    np.testing.assert_allclose(closed_form_response.peak(flow), [0.748, 0.8729], atol=5e-4)
    np.testing.assert_allclose(closed_form_response.folds(flow)[1], [0.861, 0.8752], atol=3e-4)


@pytest.mark.parametrize("damping", [1e-8, 1e-11, 1e-14])
def test_multiple_scales_at_hardly_any_damping(damping):
    """Away from resonance the amplitude does not depend on the damping, however distant the peak is."""
    cases = ({"c": damping, "alpha": 1.0}, {"c": damping})
    found = solve("multiple_scales", cases=cases)
    low = (found["branch_u_max"] - found["branch_u_min"])[:, 0] / 2
    away = OMEGAS != 1.0
    expected = TABLE1["B1"] / 2 / np.abs(OMEGAS[away] - 1)
    np.testing.assert_allclose(low[away, 0], expected, rtol=1e-12)
    flow = closed_form_response.SlowFlow(*(jnp.array(x) for x in (0.8, damping, 0.02, 0.13)))
    rho, frequency = closed_form_response.folds(flow)
    # Without damping F^2 = 4 g^2 rho^3 at the fold, on the arm omega = w0 + g rho + F/sqrt(rho); the other is the peak.
    assert rho[0] == pytest.approx((0.02**2 / (4 * 0.13**2)) ** (1 / 3), rel=1e-12)
    assert frequency[0] == pytest.approx(0.8 + 0.13 * float(rho[0]) + 0.02 / math.sqrt(rho[0]), rel=1e-12)
    assert rho[1] == pytest.approx((0.02 / damping) ** 2, rel=1e-12)


def test_folds_and_peak_are_at_frequencies_of_a_drive():
    """A cubic fit may bend to negative frequencies, which have no folds; without damping there is no second fold."""
    cases = ({"alpha": 3.0, "c": 0.01, "B1": 1.0}, {"c": 0.0})
    found = solve("multiple_scales", np.geomspace(1e-6, 3.0, 60), cases, fit_range=0.8)
    folds = found["fold_frequency"][0]
    np.testing.assert_array_equal(np.isfinite(folds).sum(axis=0), [1, 1])
    assert (folds[0] > 0).all()
    assert found["peak_frequency"][0, 0] == 0
    assert found["peak_amplitude"][0, 0] == pytest.approx(np.nanmax(found["branch_u_max"][..., 0]), rel=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("alpha", [0.0, 0.2, 0.1, 0.15, 0.3])
def test_the_largest_self_consistent_range_is_taken(alpha):
    """The range agrees with a dense scan from large ranges down, also where two ranges nearly merge."""
    for ratio in (0.01, 0.4, 0.55, 0.65, 0.68, 0.69, 0.71, 0.72, 0.8, 0.9, 0.95):
        stiffness = 1 - (1 - alpha) * float(closed_form_response._share(ratio))
        if stiffness <= 0:
            continue
        model = Rattle.models["basins"].build(
            TABLE1 | {"alpha": alpha, "B1": TABLE1["c"] * TABLE1["b"] / ratio * math.sqrt(stiffness)}
        )
        reach = float(closed_form_response.self_consistent_range(model, ()))
        r = np.linspace(1e-3, 1, 400_000)
        excess = (1 - (1 - alpha) * closed_form_response._share(r)) / r**2 - stiffness / ratio**2
        assert TABLE1["b"] / reach == pytest.approx(r[np.argmax(excess <= 1e-12 / ratio**2)], rel=1e-2)
        peak = closed_form_response.peak(
            closed_form_response.slow_flow(model, closed_form_response.cubic_fit(model, jnp.array(reach)))
        )
        assert peak[0] == pytest.approx(reach, rel=1e-9)


@pytest.mark.parametrize("name", full_after(1, ["B1", "b", "c", "alpha", "k"]))
def test_one_parameter_may_vary_alone(name):
    """One to three lanes of a single parameter, with numbers for the others, give the same as arrays of all parameters."""
    # With 1.3 times this drive there are three self-consistent ranges, the largest nearly twice the next one.
    table, factors = TABLE1 | {"alpha": 0.15, "B1": 0.0023}, np.array([0.9, 1.0, 1.3])
    cases = [table | {name: table[name] * factor} for factor in factors]

    def reach(values, shape):
        return closed_form_response.self_consistent_range(Rattle.models["basins"].build(values), shape)

    expected = jax.jit(lambda values: reach(values, (3,)))(lanes(cases))
    for chosen in (slice(1), slice(1, None), slice(None)):
        given = table[name] * factors[chosen]
        found = jax.jit(lambda x, shape=given.shape: reach(table | {name: x}, shape))(given)
        np.testing.assert_allclose(found, expected[chosen], rtol=1e-12)


def settled(epsilon: float, sigma: float, start: float) -> float:
    """Settled amplitude of the cubic system, from the amplitude ``start`` in the phase of the averaged motion."""
    mu, drive = 0.2, 0.5

    def rate(t, y):
        u, v = y
        return v, epsilon * (drive * math.cos((1 + epsilon * sigma) * t) - 2 * mu * v - u**3) - u

    span = 12 / (epsilon * mu)
    late = np.linspace(span - 40, span, 4000)
    lag = math.asin(min(2 * mu * start / drive, 1.0))
    lag = lag if sigma < 3 * start**2 / 8 else math.pi - lag
    first = (start * math.cos(lag), start * math.sin(lag))
    u = solve_ivp(rate, (0, span), first, "DOP853", late, rtol=1e-9, atol=1e-9).y[0]
    return (u.max() - u.min()) / 2


@pytest.mark.full
def test_cubic_system_meets_averaged_amplitudes_to_first_order():
    """Integration in time: errors halve with epsilon, and the middle amplitude separates the basins of the others."""
    sigma, errors = 0.55, []
    flow = closed_form_response.SlowFlow(jnp.array(0.0), jnp.array(0.2), jnp.array(0.25), jnp.array(0.375))
    low, middle, high = (float(a) for a in closed_form_response.roots(flow, jnp.array(sigma)))
    for epsilon in (0.04, 0.02):
        found = settled(epsilon, sigma, 0.85 * middle), settled(epsilon, sigma, 1.15 * middle)
        errors.append([found[0] - low, found[1] - high])
    first, second = np.abs(errors)
    assert (second < 0.02).all()
    np.testing.assert_allclose(first / second, 2.0, rtol=0.35)


def test_describing_function_against_quadrature():
    amplitude, bias = 0.4, 0.07
    point = describing_function.point_at(MODEL, jnp.array(amplitude), jnp.array(bias))
    angle = 2 * np.pi * (np.arange(200_000) + 0.5) / 200_000
    force = np.asarray(MODEL.restoring(bias + amplitude * np.cos(angle)))
    assert float(point.stiffness) == pytest.approx(2 * np.mean(force * np.cos(angle)) / amplitude, rel=1e-8)
    mean = describing_function.imbalance(MODEL, jnp.array(amplitude), jnp.array(bias))[0] + MODEL.B0 / MODEL.stiffness
    assert float(mean) == pytest.approx(force.mean(), rel=1e-8)
    a = 0.4
    step = 1e-5
    exact = [
        describing_function.point_at(MODEL, jnp.array(x), describing_function.bias_of(MODEL, jnp.array(x)))
        for x in (a - step, a, a + step)
    ]
    assert float(exact[1].slope) == pytest.approx(float(exact[2].stiffness - exact[0].stiffness) / (2 * step), rel=1e-6)


def balanced_force(values, bias, amplitude):
    """Mean and fundamental of the spring force by quadrature between the flanks, in units of the stiffness."""
    crossings = [
        math.acos(x) for x in ((flank - bias) / amplitude for flank in (values["b"], -values["b"])) if abs(x) < 1
    ]
    ends = [0.0, *crossings, math.pi]
    points, weights = np.polynomial.legendre.leggauss(40)
    angle = np.concatenate([(a + b) / 2 + (b - a) / 2 * points for a, b in itertools.pairwise(ends)])
    weight = np.concatenate([(b - a) / 2 * weights for a, b in itertools.pairwise(ends)])
    u = bias + amplitude * np.cos(angle)
    force = u - (1 - values["alpha"]) * np.clip(u, -values["b"], values["b"])
    return np.sum(weight * force) / math.pi, 2 * np.sum(weight * force * np.cos(angle)) / math.pi


def assert_balanced(values, omega, bias, amplitude, rtol=1e-9):
    mean, first = balanced_force(values, bias, amplitude)
    assert mean == pytest.approx(values["B0"], rel=rtol)
    size = math.hypot(first - omega**2 * amplitude, values["c"] * omega * amplitude)
    assert size == pytest.approx(values["B1"], rel=rtol * max(1.0, amplitude / values["B1"]))


@pytest.mark.full
def test_amplitudes_on_both_sides_of_a_narrow_resonance():
    """At light damping both arms cross a frequency within a thousandth of an amplitude."""
    values = {"B0": 0.14, "B1": 1.4e-4, "b": 0.63, "c": 1.2e-4, "alpha": 0.0}
    omegas = np.array([0.53, 0.59, 0.66, 0.74])
    found = solve("describing_function", omegas, (values,))
    high, low = found["branch_u_max"][..., 0], found["branch_u_min"][..., 0]
    np.testing.assert_array_equal(np.isfinite(high).sum(axis=1), [5, 5, 5, 3])
    np.testing.assert_array_equal(found["branch_stability"][0, :, 0], [0, 1, 0, 1, 0])
    amplitude = (high - low) / 2
    assert ((amplitude[:, 2] - amplitude[:, 1]) / amplitude[:, 1] < 2e-3).all()
    for omega, row, mean in zip(omegas, amplitude, (high + low) / 2, strict=True):
        assert (np.diff(row[np.isfinite(row)]) > 0).all()
        for a, m in zip(row[np.isfinite(row)], mean[np.isfinite(row)], strict=True):
            assert_balanced(TABLE1 | values, omega, m, a, 1e-8)


@pytest.mark.full
def test_weak_drives_next_to_a_flank():
    """About a rest on the flank the spring is bilinear, so amplitudes are proportional to the drive, however weak."""
    weak = {"B0": 0.05, "b": 0.5, "alpha": 0.1, "c": 0.05}
    cases = tuple(weak | {"B1": drive} for drive in (1e-3, 1e-4, 1e-5, 1e-7))
    found = solve("describing_function", np.array([0.3, 0.45, 0.7]), cases)
    amplitude = (found["u_max"] - found["u_min"])[:, 0] / 2
    relative = amplitude / [case["B1"] for case in cases]
    np.testing.assert_allclose(relative, np.stack([relative[:, 0]] * 4, axis=1), rtol=1e-6)
    bias = (found["u_max"] + found["u_min"])[:, 0] / 2
    for place, omega in enumerate((0.3, 0.45, 0.7)):
        assert_balanced(TABLE1 | cases[1], omega, bias[place, 1], amplitude[place, 1])


def test_describing_function_of_table_1(describing):
    assert 2 * describing["peak_amplitude"][0, 0] == pytest.approx(1.37595, abs=5e-6)
    assert describing["peak_frequency"][0, 0] == pytest.approx(0.871767, abs=5e-7)
    np.testing.assert_allclose(describing["fold_frequency"][0, :2, 0], [0.7511, 0.8745], atol=5e-5)
    assert np.isnan(describing["fold_frequency"][0, 2:, 0]).all()


@pytest.mark.parametrize("method", ["multiple_scales", "describing_function"])
def test_up_and_down_differ_between_the_folds_only(method, request):
    result = request.getfixturevalue("scales" if method == "multiple_scales" else "describing")
    folds = result["fold_frequency"][0, :2, 0]
    between = (folds[0] < OMEGAS) & (folds[1] > OMEGAS)
    differ = result["u_max"][:, 0, 0] != result["u_max"][:, 1, 0]
    np.testing.assert_array_equal(differ, between)
    assert (result["u_max"][between, 0, 0] > result["u_max"][between, 1, 0]).all()
    assert (result["stability"][..., 0] == 0).all()
    assert (result["spectral_radius"][..., 0] < 1).all()
    branches = np.isfinite(result["branch_u_max"][..., 0]).sum(axis=1)
    np.testing.assert_array_equal(branches, np.where(between, 3, 1))
    np.testing.assert_array_equal(result["branch_stability"][between][:, :3, 0], [[0, 1, 0]] * between.sum())


def test_linear_limits_are_exact(scales, describing):
    for lane in (1, 2):
        values = TABLE1 | CASES[lane]
        for result in (scales, describing):
            amplitude = (result["u_max"] - result["u_min"])[..., lane] / 2
            if result is describing:
                expected = linear(values, OMEGAS)
                np.testing.assert_allclose(result["residual"][..., lane], 0, atol=1e-12)
            else:
                # The averaged response of a linear spring: detuning to first order.
                expected = abs(values["B1"]) / 2 / np.hypot(OMEGAS - 1, values["c"] / 2)
            np.testing.assert_allclose(amplitude, np.stack([expected] * 2, axis=1), rtol=1e-12)
    values = TABLE1 | CASES[7]
    amplitude = (describing["u_max"] - describing["u_min"])[..., 7] / 2
    np.testing.assert_allclose(amplitude[:, 0], linear(values, OMEGAS), rtol=1e-12)


def test_limits_without_drive_damping_or_stiffness(scales, describing):
    for result in (scales, describing):
        assert (result["u_max"][..., 6] == result["u_min"][..., 6]).all()
        assert np.isfinite(result["u_max"][..., 3]).all()
        np.testing.assert_allclose(result["u_max"][..., 9], result["u_max"][..., 0], rtol=1e-10)
        np.testing.assert_array_equal(result["u_max"][..., 8], result["u_max"][..., 0])
        opposite = np.abs(np.abs(result["phase"][..., 8] - result["phase"][..., 0]) - np.pi)
        np.testing.assert_allclose(opposite, 0, atol=1e-12)
    # Without damping: the linear resonance has no steady amplitude; elsewhere the multipliers have modulus one.
    assert np.isnan(scales["u_max"][6, :, 5]).all()
    assert scales["outcome"][6, 5] == 2
    assert (scales["outcome"][[0, 1, 5, 7]][:, 5] == 0).all()
    np.testing.assert_allclose(describing["spectral_radius"][[0, 1, 7]][..., 5], 1, rtol=1e-12)
    assert np.isnan(describing["fold_frequency"][0, 1:, 5]).all()


@pytest.mark.full
def test_peak_is_the_largest_amplitude_with_heavy_damping():
    """Without a resonance the amplitude falls from its static value at the frequency 0, B1/k' for a linear spring."""
    cases = ({"alpha": 1.0, "c": 1.9}, {"alpha": 1.0, "c": 2.5}, {"c": 1.5}, {"alpha": 0.0, "B0": 0.0, "c": 3.0})
    cases += ({"c": 0.8}, {"alpha": 3.0, "b": 0.05, "B1": 0.2, "c": 1.0})
    found = solve("describing_function", np.geomspace(1e-3, 3.0, 400), cases)
    seen = np.max(found["u_max"] - found["u_min"], axis=(0, 1)) / 2
    peak, frequency = found["peak_amplitude"][0], found["peak_frequency"][0]
    assert (seen <= peak * (1 + 1e-12)).all()
    np.testing.assert_allclose(seen, peak, rtol=1e-4)
    np.testing.assert_allclose(peak[:2], TABLE1["B1"], rtol=1e-12)
    np.testing.assert_array_equal(frequency > 0, [False] * 4 + [True] * 2)


@pytest.mark.full
@pytest.mark.parametrize("case", [{}, {"alpha": 0.0}, {"alpha": 3.0, "B0": 0.0}, {"B0": 0.3}])
def test_the_backbone_is_the_largest_free_motion(case):
    """The backbone agrees with a scan of amplitudes; it does not depend on the drive and continues beyond the peak."""
    omegas = np.array([0.3, 0.65, 0.85, 0.9, 0.99, 0.99999, 1.3])
    small, large = (
        solve("describing_function", omegas, ({**case, "B1": b},))["backbone_amplitude"] for b in (1e-3, 0.5)
    )
    np.testing.assert_array_equal(small, large)
    model, at = Rattle.models["basins"].build(TABLE1 | case), describing_function.point_at
    scanned = jnp.geomspace(1e-4, 1e6, 100_001)
    kappa = np.asarray(jax.jit(lambda a: at(model, a, describing_function.bias_of(model, a)).stiffness)(scanned))
    for omega, found in zip(omegas, small[:, 0], strict=True):
        crossed = np.flatnonzero((kappa[1:] > omega**2) != (kappa[:-1] > omega**2))
        assert np.isfinite(found) == (crossed.size > 0)
        if crossed.size:
            assert scanned[crossed[-1]] <= found * (1 + 1e-9) and found <= scanned[crossed[-1] + 1] * (1 + 1e-9)


def test_a_linear_spring_has_no_backbone(scales):
    """Free motions of a linear spring have any amplitude at one frequency, and no amplitude at others."""
    assert np.isnan(scales["backbone_amplitude"][..., 2]).all()
    assert np.isfinite(scales["backbone_amplitude"][-1, 0])


def test_softening_bends_down(describing):
    assert describing["peak_frequency"][0, 4] < math.sqrt(2.0) - 0.02


def test_a_line_without_lanes_equals_the_batch(describing):
    alone = compiled("describing_function", tuple(OMEGAS), (), None, ("u_max", "fold_frequency"))(TABLE1)
    np.testing.assert_allclose(alone["u_max"], describing["u_max"][..., 0], rtol=1e-12)
    assert alone["fold_frequency"].shape == (len(OMEGAS), closed_form_response.FOLDS)


def test_sweeps_follow_their_branch():
    inf = np.inf
    roots = np.array([[0.9, inf, inf], [1.0, 2.0, 3.0], [1.1, 1.5, 4.0], [5.0, inf, inf], [5.1, inf, inf]])
    index = np.asarray(follow(jnp.asarray(roots)))
    reached = np.take_along_axis(roots, index, axis=1)
    np.testing.assert_array_equal(reached[:, 0], [0.9, 1.0, 1.1, 5.0, 5.1])
    np.testing.assert_array_equal(reached[:, 1], [0.9, 3.0, 4.0, 5.0, 5.1])


@pytest.mark.parametrize("case", [{"c": 0.005, "B1": 0.003}, {"c": 0.001, "B1": 6e-4}])
def test_a_sweep_stays_on_a_steep_branch_up_to_its_fold(case):
    """A narrow peak bends to higher frequencies: wherever there are three amplitudes, a sweep up has the largest."""
    found = solve("multiple_scales", np.linspace(0.4, 1.0, 121), (case,))
    motions = found["branch_u_max"][..., 0]
    three = np.isfinite(motions).sum(axis=1) == 3
    assert three.sum() > 25
    np.testing.assert_array_equal(found["u_max"][three, 0, 0], motions[three, 2])
    np.testing.assert_array_equal(found["u_max"][three, 1, 0], motions[three, 0])


def test_refined_contains_the_values():
    omega = np.array([1.0, 0.5, 0.6])
    fine, places = refined(omega, 0.05, 4)
    np.testing.assert_array_equal(fine[places], omega)
    assert len(fine) == 9
