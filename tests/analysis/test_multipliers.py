"""The error bound of the spectral radius for polynomials with known roots, and the verdict from it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.multipliers import (
    PolynomialError,
    characteristic_coefficients,
    multiplier_errors,
    root_scale,
    sort_multipliers,
    spectral_radius_bound,
    verdict,
)

COUNT = 500
ERRORS = (1e-15, 1e-13, 1e-11, 1e-8, 1e-5, 1e-3, 0.05)


def closed_under_conjugation(rng, kind: str) -> np.ndarray:
    """Four roots of a real quartic, with moduli up to about one."""
    pair = lambda r, phi: [r * np.exp(1j * phi), r * np.exp(-1j * phi)]  # noqa: E731
    phi, split = rng.uniform(0.1, 3.0, 2), 10.0 ** rng.uniform(-12, -1)
    sign = rng.choice([-1.0, 1.0])
    roots = {
        "separated": lambda: [sign, -0.7 * sign, *pair(0.4, phi[0])],
        "random real": lambda: list(rng.uniform(-1, 1, 4)),
        "random pairs": lambda: pair(1.0, phi[0]) + pair(rng.uniform(0.1, 1), phi[1]),
        "unit circle": lambda: pair(1.0, phi[0]) + pair(1.0, phi[1]),
        "near-double real": lambda: [sign, sign * (1 - split), *pair(rng.uniform(0.2, 1), phi[0])],
        "near-double at one": lambda: pair(1.0, split) + pair(0.9, phi[0]),
        "double": lambda: [sign, sign, *pair(rng.uniform(0.2, 1), phi[0])],
        "double, inside": lambda: [sign, -0.6, 0.3, 0.3],
        "near-double pairs": lambda: pair(1.0, phi[0]) + pair(1 - split, phi[0] + 10.0 ** rng.uniform(-12, -1)),
        "double pairs": lambda: pair(1.0, phi[0]) * 2,
        "triple": lambda: [sign, sign, sign * (1 - split), 0.5],
        "quadruple": lambda: [sign] * 4,
        "graded": lambda: list(sign * 10.0 ** -rng.uniform(0, 15, 4)),
    }
    return np.array(roots[kind](), complex)


KINDS = (
    "separated",
    "random real",
    "random pairs",
    "unit circle",
    "near-double real",
    "near-double at one",
    "double",
    "double, inside",
    "near-double pairs",
    "double pairs",
    "triple",
    "quadruple",
    "graded",
)


def exact_coefficients(roots: np.ndarray) -> np.ndarray:
    """a_0 = 1, a_1, ..., a_n of prod (z - s_i) in extended precision, ``(N, n) -> (N, n + 1)``."""
    roots = roots.astype(np.clongdouble)
    coefficients = np.ones((len(roots), 1), np.clongdouble)
    for k in range(roots.shape[1]):
        raised = np.pad(coefficients, ((0, 0), (0, 1)))
        coefficients = raised - roots[:, k, None] * np.pad(coefficients, ((0, 0), (1, 0)))
    return coefficients


def difference(a: np.ndarray, b: np.ndarray, rho: np.ndarray) -> np.ndarray:
    """max_k |a_k - b_k| / rho^k, a little more than the rounding of this computation."""
    k = np.arange(1, a.shape[1])
    noise = 8 * np.finfo(np.longdouble).eps
    return ((np.abs(a[:, 1:] - b[:, 1:]) / rho[:, None] ** k).max(axis=1) + noise).astype(float)


def relative(error: np.ndarray, roots: np.ndarray) -> PolynomialError:
    """Errors of the coefficients a_k of ``error`` times the k-th power of the largest root, ``(N,)`` and ``(N, n)``."""
    powers = np.arange(1, roots.shape[1] + 1)[:, None]
    return PolynomialError(jnp.asarray(error * np.abs(roots).max(axis=1) ** powers))


@pytest.fixture(scope="module")
def bound():
    compiled = jax.jit(spectral_radius_bound)

    def evaluate(roots, error):
        return np.asarray(compiled(jnp.asarray(roots.real.T), jnp.asarray(roots.imag.T), relative(error, roots)))

    return evaluate


@pytest.fixture(scope="module", params=KINDS)
def pairs(request):
    """Roots, and the roots of polynomials whose coefficients differ by random signs times ``error rho^k``.

    The difference of the two polynomials is computed from their roots, so no root finder has to be exact.
    """
    rng = np.random.default_rng(KINDS.index(request.param))
    size = 10.0 ** rng.uniform(-3, 3, (COUNT, 1))
    roots = size * np.stack([closed_under_conjugation(rng, request.param) for _ in range(COUNT)])
    rho = np.abs(roots).max(axis=1)
    asked = rng.choice(ERRORS, COUNT)
    signs = rng.choice([-1.0, 1.0], (COUNT, 4))
    coefficients = np.stack([np.poly(r).real for r in roots])
    coefficients[:, 1:] += signs * asked[:, None] * rho[:, None] ** np.arange(1, 5)
    other = np.stack([np.roots(c) if c[-1] else np.append(np.roots(c), 0) for c in coefficients])
    return request.param, roots, other, asked


def test_bound_is_never_violated(pairs, bound):
    """The bound holds with either set of roots as the computed one."""
    _, roots, other, asked = pairs
    exact, changed = exact_coefficients(roots), exact_coefficients(other)
    true, found = np.abs(roots).max(axis=1), np.abs(other).max(axis=1)
    assert np.median(difference(exact, changed, true) / asked) == pytest.approx(1, rel=0.2)
    for rho, computed, reference in ((true, roots, found), (found, other, true)):
        limit = bound(computed, difference(exact, changed, rho))
        violated = np.abs(rho - reference) > limit
        assert not violated.any(), (
            np.flatnonzero(violated)[:5],
            np.abs(rho - reference)[violated][:5],
            limit[violated][:5],
        )


def test_every_multiplier_lies_within_its_error(pairs):
    """With either set of roots as the computed one, each has a root of the other set within its error."""
    _, roots, other, _ = pairs
    apart = np.abs(roots[:, :, None] - other[:, None])
    exact, changed = exact_coefficients(roots), exact_coefficients(other)
    for computed, distance in ((roots, apart.min(axis=2)), (other, apart.min(axis=1))):
        error = difference(exact, changed, np.abs(computed).max(axis=1))
        limit = np.asarray(jax.jit(multiplier_errors)(computed.real.T, computed.imag.T, relative(error, computed))).T
        assert (distance <= limit).all(), (distance / limit).max()


def test_bound_of_a_multiple_root_is_the_root_of_the_error(bound):
    """A change of the coefficients by ``error`` moves a multiple root by a root of ``error``; the bound is of this size."""
    for error in (1e-12, 1e-8):
        double = np.array([[-1.0, -1.0, 0.3, 0.2]], complex)
        limit = float(bound(double, np.array([error]))[0])
        assert np.sqrt(error) < limit < 40 * np.sqrt(error)
        quadruple = np.full((1, 4), -1.0 + 0j)
        assert error**0.25 < float(bound(quadruple, np.array([error]))[0]) < 10 * error**0.25


def test_bound_is_not_absurd_for_separated_roots(bound):
    """The bound is at most 100 times the largest first-order change of a modulus by coefficients of this error."""
    rng = np.random.default_rng(0)
    roots = np.stack([closed_under_conjugation(rng, "separated") for _ in range(COUNT)])
    gaps = np.abs(roots[:, :1] - roots[:, 1:])
    for error in (1e-13, 1e-10, 1e-6):
        attainable = 4 * error / gaps.prod(axis=1)
        limit = bound(roots, np.full(COUNT, error))
        assert (limit >= attainable).all()
        assert (limit <= 100 * attainable).all(), (limit / attainable).max()


def test_bound_scales_with_the_roots_and_grows_with_the_error(bound):
    rng = np.random.default_rng(1)
    roots = np.stack([closed_under_conjugation(rng, "random pairs") for _ in range(COUNT)])
    error = np.full(COUNT, 1e-9)
    np.testing.assert_allclose(bound(1e5 * roots, error), 1e5 * bound(roots, error), rtol=1e-12)
    assert (bound(roots, 100 * error) > bound(roots, error)).all()


def test_bound_without_an_error_is_rounding_only(bound):
    roots = np.array([[0.8, -0.5, 0.3, 0.1]], complex)
    assert 4 * np.finfo(float).eps * 0.8 <= bound(roots, np.zeros(1))[0] <= 1e-14


@pytest.mark.parametrize("error", [np.inf, np.nan, 1e9])
def test_bound_is_infinite_if_nothing_is_certain(bound, error):
    roots = np.array([[0.8, -0.5, 0.3, 0.1]], complex)
    assert not np.isfinite(bound(roots, np.array([error]))[0])


@pytest.mark.full
@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_bound_of_other_sizes(n):
    roots = np.linspace(1, -0.5, n)
    limit = float(spectral_radius_bound(jnp.asarray(roots), jnp.zeros(n), PolynomialError(jnp.full(n, 1e-10))))
    assert 1e-10 < limit < 1e-6


def test_bound_belongs_to_the_dominant_root_wherever_it_stands(bound):
    roots = np.array([[0.9, -0.5, 0.3, 0.1]], complex)
    limits = [bound(np.roll(roots, k, axis=1), np.array([1e-9]))[0] for k in range(4)]
    np.testing.assert_allclose(limits, limits[0], rtol=1e-12)


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("rho", "error", "expected"),
    [
        (0.9, 0.05, 0),
        (0.9, 0.2, 2),
        (1.1, 0.05, 1),
        (1.1, 0.2, 2),
        (1.0, 0.0, 2),
        (1.0, 1e-9, 2),
        (0.5, 0.5, 2),
        (1.5, 0.5, 2),
        (1 - 1e-12, 1e-13, 0),
        (1 + 1e-12, 1e-13, 1),
        (0.0, 0.0, 0),
        (NAN, 0.1, 2),
        (0.5, NAN, 2),
        (2.0, NAN, 2),
        (0.5, INF, 2),
        (2.0, INF, 2),
        (INF, 1.0, 1),
        (INF, INF, 2),
        (NAN, NAN, 2),
    ],
)
def test_verdict(rho, error, expected):
    found = verdict(jnp.asarray(rho), jnp.asarray(error))
    assert (int(found), found.dtype) == (expected, jnp.int8)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_characteristic_coefficients(n):
    a = np.random.default_rng(n).standard_normal((n, n, 20))
    found = np.asarray(characteristic_coefficients(jnp.asarray(a)))
    assert found.shape == (n, 20)
    expected = np.stack([np.poly(a[..., i])[1:] for i in range(20)], axis=-1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose((-1) ** n * found[-1], np.linalg.det(np.moveaxis(a, -1, 0)), rtol=1e-9)


def test_root_scale_is_a_lower_bound():
    rng = np.random.default_rng(2)
    for kind in KINDS:
        roots = np.stack([closed_under_conjugation(rng, kind) for _ in range(50)])
        coefficients = np.stack([np.poly(r).real[1:] for r in roots], axis=-1)
        scale, rho = np.asarray(root_scale(jnp.asarray(coefficients))), np.abs(roots).max(axis=1)
        assert (scale <= rho * (1 + 1e-14)).all()
        assert (scale >= rho / 8).all()
    assert float(root_scale(jnp.asarray(np.poly([-1.0] * 4)[1:]))) == pytest.approx(1, rel=1e-14)


def test_multipliers_are_sorted_by_falling_modulus():
    values = np.array([0.3, -0.9, 0.5 + 0.5j, 0.5 - 0.5j])
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        x = values[order]
        found = np.asarray(sort_multipliers(jnp.asarray(x.real), jnp.asarray(x.imag)))
        np.testing.assert_array_equal(found, [-0.9, 0.5 - 0.5j, 0.5 + 0.5j, 0.3])


def test_order_of_a_conjugate_pair_is_stable_under_rounding():
    up, down = 0.6 + 0.8j, (0.6 - 0.8j) * (1 - 1e-15)
    for x in ([up, down], [up * (1 - 2e-15), down]):
        found = np.asarray(sort_multipliers(jnp.asarray(np.real(x)), jnp.asarray(np.imag(x))))
        assert found[0].imag < 0 < found[1].imag
