"""Both propagators on systems whose propagator is known in closed form."""

from __future__ import annotations

import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import DOP853
from scipy.linalg import expm

from drivetrain_jax.analysis.floquet.direct import assemble, direct_monodromy, stable_steps, stiffness_of
from drivetrain_jax.analysis.floquet.multipliers import spectral_radius_bound
from drivetrain_jax.analysis.floquet.propagator import (
    EXPLICIT_ORDER,
    IMPLICIT_ORDER,
    LinearTerm,
    Order8,
    Propagator,
    Radau,
    propagator,
)
from drivetrain_jax.analysis.numerics import dop853
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.analysis.numerics.radau import radau_iia
from drivetrain_jax.systems import LinearPeriodic
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


def explicit(system: LinearPeriodic):
    return jax.jit(lambda steps: propagator(system, steps))


def implicit(system: LinearPeriodic):
    return jax.jit(lambda steps: propagator(system, steps, 1, Radau))


def measured_orders(propagate, exact: np.ndarray, steps: list[int]) -> np.ndarray:
    errors = np.array([np.abs(full(propagate(jnp.int32(n))) - exact).max() for n in steps])
    assert errors.min() > 1e-13, errors
    return np.diff(np.log(errors)) / -np.diff(np.log(steps))


def test_explicit_scheme_converges_with_its_order():
    rates = (-0.5, 1.5)
    orders = measured_orders(explicit(rotating(rates)), rotating_exactly(rates), [2, 3, 4, 6])
    assert EXPLICIT_ORDER == 8
    assert (np.abs(orders[1:] - EXPLICIT_ORDER) < 0.8).all(), orders


def test_implicit_scheme_keeps_its_order_on_a_stiff_problem():
    """On stiff problems the classical order 15 falls to the stage order 8, which the error estimate of ``compare`` uses."""
    rates = (-1e5, 0.5)
    propagate, exact = implicit(rotating(rates)), rotating_exactly(rates)
    assert IMPLICIT_ORDER == 8
    orders = measured_orders(propagate, exact, [3, 4, 6, 8])
    assert orders[-1] == pytest.approx(IMPLICIT_ORDER, abs=0.1), orders
    for n in (1, 2, 3, 4):
        coarse, fine = full(propagate(jnp.int32(n))), full(propagate(jnp.int32(2 * n)))
        bound = 4 * np.abs(fine - coarse).max() / (2**IMPLICIT_ORDER - 1)
        assert np.abs(fine - exact).max() <= bound


def test_coefficients_are_those_of_scipy():
    for name in "ABC":
        assert (getattr(dop853, name) == getattr(DOP853, name)).all(), name


def test_explicit_scheme_is_one_step_of_dop853():
    """One step equals the stages of SciPy's tableau."""
    rates = (-0.5, 1.5)
    field = rotating(rates).matrix
    a, b, c, k = DOP853.A, DOP853.B, DOP853.C, []
    for i in range(len(b)):
        state = np.eye(2) + SPAN * sum((a[i, j] * k[j] for j in range(i)), np.zeros((2, 2)))
        k.append(np.asarray(field(SPAN * c[i])) @ state)
    expected = np.eye(2) + SPAN * sum(w * x for w, x in zip(b, k, strict=True))
    np.testing.assert_allclose(full(explicit(rotating(rates))(jnp.int32(1))), expected, rtol=1e-12)


@pytest.mark.parametrize("decay", full_after(1, [1e2, 1e5, 1e8, 1e12]))
def test_implicit_scheme_is_l_stable(decay):
    """A fast-decaying component must vanish after one panel; in a symmetric scheme it would keep the modulus one."""
    system = LinearPeriodic(lambda t: ((-decay + 0 * t, 0), (0, -1.0 + 0 * t)), 1.0)
    phi = full(propagator(system, jnp.int32(1), 1, Radau))
    assert abs(phi[0, 0]) <= 10 / decay
    assert phi[1, 1] == pytest.approx(math.exp(-1), rel=1e-14)


@pytest.mark.full
def test_growth_of_what_is_made_on_the_way():
    """Two modes decay by e^-24 each, but at different times, so that errors made on the way grow relative to the result.

    |Phi(T, t)| |Phi(t, 0)|/|Phi(T, 0)| follows from the integral of the rates, 24 (t -+ sin(2 pi t)/(2 pi)).
    """
    rate = lambda t, sign: -24 * (1 + sign * jnp.cos(2 * math.pi * t))  # noqa: E731
    system = LinearPeriodic(lambda t: ((rate(t, 1), 0), (0, rate(t, -1))), 1.0)
    # The first mode decays fast in the outer quarters, the other one in the middle of the span.
    lost = lambda t: 24 * np.stack([t + np.sin(2 * np.pi * t) / (2 * np.pi), t - np.sin(2 * np.pi * t) / (2 * np.pi)])  # noqa: E731
    norm = lambda exponents: np.linalg.norm(np.exp(-exponents), axis=0)  # noqa: E731
    whole = lost(np.array([1.0]))
    for pieces in (1, 4, 16):
        t = np.arange(1, pieces) / pieces
        squares = (norm(whole - lost(t)) * norm(lost(t)) / norm(whole)) ** 2 / 2
        expected = math.sqrt((squares.sum() + 1) / pieces)
        found = propagator(system, jnp.int32(160), pieces)
        assert float(found.growth) == pytest.approx(expected, rel=1e-6)
        np.testing.assert_allclose(np.diag(full(found)), np.exp(-24), rtol=1e-9)
    assert float(propagator(system, jnp.int32(32), 16, Radau).growth) == pytest.approx(expected, rel=1e-6)
    assert expected > 100


@pytest.mark.full
@pytest.mark.parametrize("n", [4, 1])
def test_constant_coefficients(n):
    a = 2 * np.random.default_rng(n).standard_normal((n, n))
    expected = expm(a)
    for found in (propagator(constant(a), jnp.int32(40)), propagator(constant(a), jnp.int32(4), 4, Radau)):
        np.testing.assert_allclose(full(found), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.full
def test_batch_and_structural_zeros():
    """Oscillators of many frequencies as lanes: lanes are independent, and zeros may be the integer 0."""

    def rows(frequency, t):
        return (0, 1.0), (-(frequency**2), 0)

    def one(frequency):
        return propagator(LinearPeriodic(jax.tree_util.Partial(rows, frequency), 1.3), jnp.int32(30)).matrix

    def closed(frequency):
        return propagator(LinearPeriodic(lambda t: rows(frequency, t), 1.3), jnp.int32(30)).matrix

    for count in (1, 7, 32, 71):
        frequency = np.linspace(0.5, 3.0, count)
        c, s = np.cos(1.3 * frequency), np.sin(1.3 * frequency)
        exact = np.moveaxis(np.array([[c, s / frequency], [-frequency * s, c]]), -1, 0)
        for function in (one, closed):
            np.testing.assert_allclose(jax.vmap(function)(frequency), exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one(frequency[-1]), exact[-1], rtol=0, atol=1e-12)
    nested = jax.vmap(jax.vmap(one))(frequency[:70].reshape(10, 7)).reshape(70, 2, 2)
    np.testing.assert_array_equal(nested, jax.vmap(one)(frequency[:70]))


@pytest.mark.parametrize("solver", full_after(1, [Order8, Radau]))
def test_solver_takes_any_state_of_any_linear_term_both_ways(solver):
    system, y = rotating((-0.5, 1.5)), jnp.array([0.3, -1.2])
    whole = rotating_exactly((-0.5, 1.5))

    def solve(t0, t1, y):
        return diffrax.diffeqsolve(
            LinearTerm(system),
            solver(60),
            t0,
            t1,
            (t1 - t0) / 3,
            y,
            stepsize_controller=diffrax.ConstantStepSize(),
            max_steps=8,
        ).ys[0]

    there = solve(0.0, SPAN, y)
    np.testing.assert_allclose(there, whole @ y, rtol=1e-12)
    np.testing.assert_allclose(solve(SPAN, 0.0, there), y, rtol=1e-12)
    stock = diffrax.diffeqsolve(
        diffrax.ODETerm(system.vf), diffrax.Dopri8(), 0.0, SPAN, None, y,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )  # fmt: skip
    np.testing.assert_allclose(stock.ys[0], there, rtol=1e-10)


@pytest.mark.full
def test_clock_functions_reach_the_rows():
    """x' = cos(t) x with the cosine from ``basis``, which would reveal a wrong node."""
    system = LinearPeriodic(lambda cosine: ((cosine,),), SPAN, basis=lambda t: (jnp.cos(t),))
    for found in (propagator(system, jnp.int32(20)), propagator(system, jnp.int32(3), 3, Radau)):
        assert full(found).item() == pytest.approx(math.exp(math.sin(SPAN)), rel=1e-13)


def test_log_scale_saves_what_underflows():
    """e^-2000 is below the smallest float64; the matrix keeps the ratio of both decays, the scale the rest."""
    system = LinearPeriodic(lambda t: ((-1000.0 + 0 * t, 0), (0, -1000.5 + 0 * t)), 2.0)
    found = propagator(system, jnp.int32(2000), 16, Radau)
    assert float(jnp.exp(found.log_scale)) == 0
    log_first = math.log(found.matrix[0, 0]) + float(found.log_scale)
    log_second = math.log(found.matrix[1, 1]) + float(found.log_scale)
    assert log_first == pytest.approx(-2000, rel=1e-12)
    assert log_second - log_first == pytest.approx(-1, rel=1e-9)


def test_radau_coefficients():
    """Collocation is exact for polynomials up to the stage order; the last node is 1, the last row holds the weights."""
    for stages in (2, 3, 8):
        a, c = radau_iia(stages)
        assert c[-1] == 1 and (np.diff(c) > 0).all() and c[0] > 0
        for k in range(stages):
            np.testing.assert_allclose(a @ c**k, c ** (k + 1) / (k + 1), rtol=1e-13, atol=1e-15)
        for k in range(2 * stages - 1):
            assert a[-1] @ c**k == pytest.approx(1 / (k + 1), rel=1e-13)
    np.testing.assert_allclose(radau_iia(2)[0], [[5 / 12, -1 / 12], [3 / 4, 1 / 4]], rtol=1e-14)


def test_half_period_is_completed_by_the_reversor():
    """Mathieu's equation is even about the middle of its period, so X Phi^T X Phi of half a period has its multipliers."""
    rows = lambda t: ((0, 1.0), (-(1.3 - 2 * 0.4 * jnp.cos(2 * t)), 0))  # noqa: E731
    exchange = np.array([[0.0, 1.0], [1.0, 0.0]])
    half, whole = LinearPeriodic(rows, math.pi / 2, reversor=exchange), LinearPeriodic(rows, math.pi)
    z = [np.asarray(assemble(s, propagator(s, jnp.int32(60)).matrix)) for s in (half, whole)]
    np.testing.assert_allclose(np.poly(z[0]), np.poly(z[1]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("rates", full_after(1, [(-1e9, 0.5), (-1e3, 0.5), (-1e6, 0.5), (-1e8, -0.1)]))
def test_bound_holds_for_stiff_systems_without_a_determinant(rates):
    """The bound is of the size of the rounding of the entries, which no scheme avoids."""
    system, exact = rotating(rates), np.abs(np.linalg.eigvals(rotating_exactly(rates))).max()
    z = jax.jit(
        lambda n: direct_monodromy(
            system,
            lambda steps, pieces: propagator(system, steps, pieces, Radau),
            n,
            (),
            stiffness_of(system),
            2.5e-11,
            IMPLICIT_ORDER,
            2,
            0.0,
        )
    )(jnp.int32(8))
    real, imaginary = eigenvalues(z.matrix)
    size = float(jnp.exp(z.log_scale))
    bound = float(spectral_radius_bound(real, imaginary, z.error)) * size
    assert abs(float(jnp.max(jnp.hypot(real, imaginary))) * size - exact) < bound
    assert bound < 60 * np.finfo(float).eps * float(stiffness_of(system)) * exact


@pytest.mark.full
@pytest.mark.parametrize("steps", [24, 30, 48])
def test_a_fourfold_coarser_solution_tells_the_same_error(steps):
    """The estimates from coarser solutions with a half and a quarter of the steps hold and agree."""
    system, exact = rotating((-3.0, 0.5)), rotating_exactly((-3.0, 0.5))

    def solve(ratio):
        return direct_monodromy(
            system,
            lambda n, pieces: propagator(system, n, pieces),
            jnp.int32(steps),
            (),
            0.0,
            1e-8,
            EXPLICIT_ORDER,
            ratio,
            0.0,
        )

    two, four = (jax.jit(solve, static_argnums=0)(ratio) for ratio in (2, 4))
    assert float(four.error) == pytest.approx(float(two.error), rel=0.5) and bool(two.met) and bool(four.met)
    for found in (two, four):
        error = np.linalg.norm(np.asarray(found.matrix) - exact)
        assert error <= float(found.error) * np.linalg.norm(exact)
        assert error <= np.linalg.norm(np.asarray(found.change)) <= 20 * error


@pytest.mark.full
def test_the_coarser_solution_of_a_damped_system_is_stable():
    """Otherwise the coarser solution is useless, and a third propagator is necessary."""
    system, counts = rotating((-300.0, 0.5)), []

    def propagate(steps, pieces):
        jax.debug.callback(lambda n: counts.append(int(n)), steps)
        return propagator(system, steps, pieces)

    def solve(least):
        return direct_monodromy(system, propagate, jnp.int32(240), (), 0.0, 1e-5, EXPLICIT_ORDER, 4, least)

    least = stable_steps(system)
    found = jax.jit(solve)(least)
    jax.effects_barrier()
    assert counts == [math.ceil(least), 240] and bool(found.met)
    exact = rotating_exactly((-300.0, 0.5))
    assert np.linalg.norm(np.asarray(found.matrix) - exact) < float(found.error) * np.linalg.norm(exact)
    counts.clear()
    jax.jit(solve)(0.0)
    jax.effects_barrier()
    assert counts == [60, 240, 480]
