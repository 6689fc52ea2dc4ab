"""Gauss collocation on systems whose propagator is known in closed form."""

from __future__ import annotations

import math
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from drivetrain_jax.analysis.floquet.direct import Propagator, assemble
from drivetrain_jax.analysis.floquet.multipliers import spectral_radius_bound
from drivetrain_jax.analysis.floquet.propagator import ORDER, STAGES, Gauss, LinearTerm, march, monodromy
from drivetrain_jax.analysis.numerics.collocation import first_order, gauss, panel, radau, second_order, small_panel
from drivetrain_jax.analysis.numerics.lanes import Constants, lanes_last, traced_once
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.systems import LinearPeriodic
from tests.quick_jit import quick_jit
from tests.sizes import full_after

SPAN = 2.0


def rotating(rates: tuple[float, float]) -> LinearPeriodic:
    """x' = (R' R^-1 + R D R^-1) x with the rotation R by sin(t) and D = diag(rates): Phi = R(SPAN) e^(D SPAN) R(0)^-1."""
    mean, half = (rates[0] + rates[1]) / 2, (rates[0] - rates[1]) / 2

    def rows(t):
        cosine, sine = jnp.cos(2 * jnp.sin(t)), jnp.sin(2 * jnp.sin(t))
        turn = jnp.cos(t)
        return (mean + half * cosine, half * sine - turn), (half * sine + turn, mean - half * cosine)

    return LinearPeriodic(rows, SPAN)


def rotating_exactly(rates: tuple[float, float]) -> np.ndarray:
    angle = math.sin(SPAN)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return rotation @ np.diag(np.exp(np.array(rates) * SPAN))


def constant(a: np.ndarray, span: float = 1.0) -> LinearPeriodic:
    return LinearPeriodic(lambda t: tuple(tuple(float(x) + 0 * t for x in row) for row in a), span)


def full(propagator: Propagator) -> np.ndarray:
    return np.asarray(propagator.matrix * jnp.exp(propagator.log_scale))


def marched(system: LinearPeriodic):
    """The propagator as a function of the number of panels."""
    return jax.jit(lambda panels: march(system, panels))


def oscillator(frequency, damping) -> LinearPeriodic:
    """A damped oscillator as a second-order equation."""
    return LinearPeriodic(lambda t: ((0, 1.0), (-(frequency**2), -damping)), SPAN)


def oscillator_exactly(frequency: float, damping: float) -> np.ndarray:
    return expm(np.array(((0, 1.0), (-(frequency**2), -damping))) * SPAN)


march_oscillator = jax.jit(lambda frequency, damping, panels: march(oscillator(frequency, damping), panels))
rotating_monodromy = jax.jit(lambda rates, panels, rtol: monodromy(rotating(rates), panels, rtol))


@pytest.mark.parametrize("order", ["first", "second"])
def test_errors_fall_with_the_order(order):
    """A system of first order, and Mathieu's equation, against twice as many panels."""
    system = LinearPeriodic(lambda t: ((0, 1.0), (-40 - 30 * jnp.cos(2 * t), -0.1)), SPAN)
    if order == "first":
        system = LinearPeriodic(lambda t: ((0.0 * t, 1.0), (-40 - 30 * jnp.cos(2 * t), -0.1)), SPAN)
    propagate, panels = marched(system), np.array([6, 8, 10, 12])
    exact = full(propagate(jnp.int32(96)))
    errors = [np.abs(full(propagate(jnp.int32(n))) - exact).max() for n in panels]
    assert errors[-1] > 1e-12
    orders = np.diff(np.log(errors)) / -np.diff(np.log(panels))
    assert ORDER == 2 * STAGES == 10 and abs(orders[-1] - ORDER) < 0.3, orders


@pytest.mark.parametrize("frequency, damping", [(1e-3, 0.0), (2.0, 0.3), (30.0, 1.0), (1.0, 60.0)])
def test_second_order_equations_need_only_their_second_derivatives(frequency, damping):
    assert oscillator(frequency, damping).displacement_unit == 1.0
    exact, found = oscillator_exactly(frequency, damping), full(march_oscillator(frequency, damping, jnp.int32(240)))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12 * np.abs(exact).max())


def test_pivots_of_oscillation_and_of_decay_are_at_least_one():
    """So that no rows need to be exchanged: leading minors of M for x'' = -w^2 x and x'' = -c x', up to 12 in a panel."""
    scheme = second_order(gauss(STAGES))
    for k, largest in enumerate((300.0, 144.0)):
        for size in np.linspace(0, largest, 200):
            pivots, m = [], np.eye(STAGES) + size * scheme.inner[k]
            for i in range(STAGES):
                pivots.append(m[i, i])
                m[i + 1 :] -= np.outer(m[i + 1 :, i] / m[i, i], m[i])
            assert min(pivots) >= 1 - 1e-12, (k, size, pivots)


def test_determinant_and_symplectic_form_are_kept():
    phi = full(march_oscillator(25.0, 0.0, jnp.int32(4)))
    assert np.linalg.det(phi) == pytest.approx(1, abs=1e-13)


def test_a_fast_mode_is_damped_whatever_its_rate():
    """Gauss schemes turn fast decay into slow decay, so the number of panels follows the rate until nothing remains."""
    for rates in ((-1e3, -0.1), (-1e6, -0.1)):
        exact = np.abs(np.linalg.eigvals(rotating_exactly(rates))).max()
        found = rotating_monodromy(rates, jnp.int64(math.sqrt(-rates[0])), 1e-9)
        radius = np.abs(np.linalg.eigvals(np.asarray(found.matrix))).max() * np.exp(float(found.log_scale))
        assert radius == pytest.approx(exact, rel=1e-8) and bool(found.met)


def test_two_numbers_of_panels_do_not_agree_on_a_missed_oscillation():
    """In few panels a fast oscillation becomes a slow one, for both numbers of panels."""
    solve = jax.jit(lambda frequency: monodromy(oscillator(frequency, 0.0), jnp.int64(8), 1e-2, 4))
    for frequency in (3e2, 1e4, 1e8):
        found, exact = solve(frequency), oscillator_exactly(frequency, 0.0)
        # Of the same size in all units of the states, unlike the other entries.
        error = np.abs(np.diag(found.matrix) * np.exp(float(found.log_scale)) - np.diag(exact)).max()
        assert error < 1e-2 or (not bool(found.met) and float(found.error.sizes[0]) > 1)


@pytest.mark.parametrize("scheme", [first_order(gauss(2)), second_order(gauss(2))])
def test_derivative_of_a_panel(scheme):
    """The adjoint of the collocation against differences of the propagator."""
    rng = np.random.default_rng(1)
    coefficients = [jnp.asarray(rng.standard_normal((len(scheme.nodes), 2, 2, 3)) / 2) for _ in scheme.inner]
    n = 2 * len(scheme.start)
    weights, step = rng.standard_normal((n, n, 3)), 1e-6
    value = jax.jit(lambda e: jnp.sum(weights * panel(scheme, e)))
    gradients = jax.jit(jax.grad(value))(coefficients)
    for t, gradient in enumerate(gradients):
        direction = rng.standard_normal(gradient.shape)
        ahead, behind = (
            value([e + sign * step * direction * (k == t) for k, e in enumerate(coefficients)]) for sign in (1, -1)
        )
        assert float(jnp.sum(gradient * direction)) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-8)
    small = jax.value_and_grad(lambda e: jnp.sum(weights * small_panel(scheme, e)))(coefficients)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-11), small, (value(coefficients), gradients))


@pytest.mark.parametrize("d", [3, 7])
def test_chains_are_eliminated_unknown_by_unknown(d):
    """Up to 12 radians in a panel, against a solution of all equations with exchanged rows, unrolled and as a loop."""
    rng, scheme, s = np.random.default_rng(2), second_order(gauss(STAGES)), STAGES
    slopes = rng.uniform(0.5, 1.5, (3, d, s))
    couplings = [np.stack([np.diag(x[:, t]) @ (np.eye(d) - np.eye(d, k=-1)) for t in range(s)]) for x in slopes]
    stiff = np.einsum("tki,tkj->tij", couplings[0], couplings[1])
    coefficients = [-0.3 * couplings[2], -stiff * 144 / np.linalg.norm(stiff[0], 2)]
    found = quick_jit(partial(panel, scheme, chain=True))([jnp.asarray(e)[..., None] for e in coefficients])[..., 0]
    m, right = np.eye(s * d).reshape(s, d, s, d), 0
    for weights, factors, e in zip(scheme.inner, np.swapaxes(scheme.right, 0, 1), coefficients, strict=True):
        m = m - np.einsum("tu,tij->tiuj", weights, e)
        right = right + np.einsum("pt,tij->tipj", factors, e)
    x = np.linalg.solve(m.reshape(s * d, -1), np.reshape(right, (s * d, -1))).reshape(s, d, -1)
    expected = np.kron(scheme.start, np.eye(d)) + np.einsum("pt,tic->pic", scheme.left, x).reshape(2 * d, -1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.full
def test_growth_of_what_is_made_on_the_way():
    """Two modes decay by e^-24 each, but at different times, so that errors made on the way grow relative to the result.

    The modes are (1, +-1). |Phi(T, t)| |Phi(t, 0)| follows from the integral of the rates, 24 (t -+ sin(2 pi t)/(2 pi)).
    """
    rate = lambda t: -24 * jnp.cos(2 * math.pi * t)  # noqa: E731
    system = LinearPeriodic(lambda t: ((-24.0, rate(t)), (rate(t), -24.0)), 1.0)
    # The first mode decays fast in the outer quarters, the other one in the middle of the span.
    lost = lambda t: 24 * np.stack([t + np.sin(2 * np.pi * t) / (2 * np.pi), t - np.sin(2 * np.pi * t) / (2 * np.pi)])  # noqa: E731
    norm = lambda exponents: np.linalg.norm(np.exp(-exponents), axis=0)  # noqa: E731
    whole = lost(np.array([1.0]))
    for panels in (48, 160):
        t = np.arange(1, panels + 1) / panels
        expected = math.sqrt(np.mean((norm(whole - lost(t)) * norm(lost(t))) ** 2)) / 2
        found = march(system, jnp.int32(panels))
        # Terms of products may be larger than their sums.
        assert 1 <= float(found.growth * jnp.exp(found.log_scale)) / expected < 1.2
        np.testing.assert_allclose(full(found), np.exp(-24) * np.eye(2), rtol=0, atol=1e-9 * np.exp(-24))
    assert expected > 100 * np.exp(-24)
    diagonal = LinearPeriodic(lambda t: ((rate(t) - 24, 0), (0, -rate(t) - 24)), 1.0)
    assert float(march(diagonal, jnp.int32(48)).growth) == pytest.approx(math.exp(-24), rel=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("n", [4, 1])
def test_constant_coefficients(n):
    a = 2 * np.random.default_rng(n).standard_normal((n, n))
    expected = expm(a)
    np.testing.assert_allclose(
        full(march(constant(a), jnp.int32(10))), expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


@pytest.mark.full
def test_batch_and_structural_zeros():
    """Oscillators of many frequencies as lanes: lanes are independent, and zeros may be the integer 0."""

    def rows(frequency, t):
        return (0, 1.0), (-(frequency**2), 0)

    def one(frequency):
        return monodromy(LinearPeriodic(jax.tree_util.Partial(rows, frequency), 1.3), jnp.int32(8), 1e-12).matrix

    def closed(frequency):
        return monodromy(LinearPeriodic(lambda t: rows(frequency, t), 1.3), jnp.int32(8), 1e-12).matrix

    for count in (1, 7, 32, 71):
        frequency = np.linspace(0.5, 3.0, count)
        c, s = np.cos(1.3 * frequency), np.sin(1.3 * frequency)
        exact = np.moveaxis(np.array([[c, s / frequency], [-frequency * s, c]]), -1, 0)
        for function in (one, closed):
            np.testing.assert_allclose(jax.vmap(function)(frequency), exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one(frequency[-1]), exact[-1], rtol=0, atol=1e-12)
    nested = jax.vmap(jax.vmap(one))(frequency[:70].reshape(10, 7)).reshape(70, 2, 2)
    # The lanes of a block share their panels.
    np.testing.assert_allclose(nested, jax.vmap(one)(frequency[:70]), rtol=0, atol=1e-12)


def test_solver_takes_any_state_of_a_linear_term():
    system, y = rotating((-0.5, 1.5)), jnp.array([0.3, -1.2])
    found = diffrax.diffeqsolve(
        LinearTerm(system), Gauss(8, 1e-12), 0.0, SPAN, SPAN, y, max_steps=1,
        stepsize_controller=diffrax.ConstantStepSize(),
    ).ys[0]  # fmt: skip
    np.testing.assert_allclose(found, rotating_exactly((-0.5, 1.5)) @ y, rtol=1e-12)
    stock = diffrax.diffeqsolve(
        diffrax.ODETerm(system.vf), diffrax.Dopri8(), 0.0, SPAN, None, y,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )  # fmt: skip
    np.testing.assert_allclose(stock.ys[0], found, rtol=1e-10)


@pytest.mark.full
def test_clock_functions_reach_the_rows():
    """x' = cos(t) x with the cosine from ``basis``, which would reveal a wrong node."""
    system = LinearPeriodic(lambda cosine: ((cosine,),), SPAN, basis=lambda t: (jnp.cos(t),))
    assert full(march(system, jnp.int32(6))).item() == pytest.approx(math.exp(math.sin(SPAN)), rel=1e-13)


def test_log_scale_saves_what_underflows():
    """e^-2000 is below the smallest float64; the matrix keeps the ratio of both decays, the scale the rest."""
    system = LinearPeriodic(lambda t: ((-1000.0 + 0 * t, 0), (0, -1000.5 + 0 * t)), 2.0)
    found = march(system, jnp.int32(4000))
    assert float(jnp.exp(found.log_scale)) == 0
    log_first = math.log(found.matrix[0, 0]) + float(found.log_scale)
    log_second = math.log(found.matrix[1, 1]) + float(found.log_scale)
    assert log_first == pytest.approx(-2000, rel=1e-11)
    assert log_second - log_first == pytest.approx(-1, rel=1e-9)


def test_coefficients():
    """Collocation is exact for polynomials up to its order; Radau's last node is 1, its last row holds the weights."""
    for stages in (2, 3, 8):
        for order, (a, b, c) in ((2 * stages, gauss(stages)), (2 * stages - 1, radau(stages))):
            assert (np.diff(c) > 0).all() and c[0] > 0
            for k in range(stages):
                np.testing.assert_allclose(a @ c**k, c ** (k + 1) / (k + 1), rtol=1e-13, atol=1e-15)
            for k in range(order):
                assert b @ c**k == pytest.approx(1 / (k + 1), rel=1e-13)
        assert radau(stages).c[-1] == 1 and (radau(stages).a[-1] == radau(stages).b).all()
    np.testing.assert_allclose(radau(2).a, [[5 / 12, -1 / 12], [3 / 4, 1 / 4]], rtol=1e-14)


def test_half_period_is_completed_by_the_reversor():
    """Mathieu's equation is even about the middle of its period, so X Phi^T X Phi of half a period has its multipliers."""
    rows = lambda t: ((0, 1.0), (-(1.3 - 2 * 0.4 * jnp.cos(2 * t)), 0))  # noqa: E731
    exchange = np.array([[0.0, 1.0], [1.0, 0.0]])
    half, whole = LinearPeriodic(rows, math.pi / 2, reversor=exchange), LinearPeriodic(rows, math.pi)
    z = [np.asarray(assemble(s.ends(), march(s, jnp.int32(12)).matrix)) for s in (half, whole)]
    np.testing.assert_allclose(np.poly(z[0]), np.poly(z[1]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("rates", full_after(1, [(-1e6, 0.5), (-1e3, 0.5), (-1e8, -0.1)]))
def test_bound_holds_for_stiff_systems_without_a_determinant(rates):
    """The bound is of the size of the rounding of the entries, which no scheme avoids."""
    exact = np.abs(np.linalg.eigvals(rotating_exactly(rates))).max()
    z = rotating_monodromy(rates, jnp.int64(math.sqrt(-rates[0])), 2.5e-11)
    size = float(jnp.exp(z.log_scale))
    real, imaginary = eigenvalues(z.matrix)
    bound = float(spectral_radius_bound(real, imaginary, z.error)) * size
    assert abs(float(jnp.max(jnp.hypot(real, imaginary))) * size - exact) < bound
    assert bound < 1e-12 * abs(rates[0]) * exact


@pytest.mark.full
@pytest.mark.parametrize("panels", [8, 12])
def test_a_fourfold_coarser_solution_shows_the_same_error(panels):
    """The estimates from coarser solutions with a half and a quarter of the panels hold."""
    system, exact = rotating((-3.0, 0.5)), rotating_exactly((-3.0, 0.5))
    for ratio in (2, 4):
        found = jax.jit(lambda n, ratio=ratio: monodromy(system, n, 1e-3, ratio))(jnp.int32(panels))
        error = np.linalg.norm(np.asarray(found.matrix) - exact)
        assert bool(found.met) and error <= float(found.error.sizes[0])
        assert error <= np.linalg.norm(np.asarray(found.change)) <= 200 * error


def test_the_trace_of_one_point_serves_the_expected_batch(retraced):
    traced = []

    def triple(constants, x, factor):
        traced.append(x.shape)
        return factor * x

    def one(x):
        return lanes_last(partial(traced_once, triple), Constants(None), x, jnp.asarray(3.0), expected=5)

    np.testing.assert_array_equal(jax.jit(jax.vmap(one))(jnp.arange(5.0)), 3.0 * np.arange(5))
    assert traced == [(5,)]
    np.testing.assert_array_equal(jax.vmap(one)(jnp.arange(7.0)), 3.0 * np.arange(7))
    assert float(one(jnp.asarray(2.0))) == 6.0 and traced == [(5,), (7,)]
