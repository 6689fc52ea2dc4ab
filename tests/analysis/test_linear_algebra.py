"""Dense linear algebra without LAPACK against NumPy's LAPACK."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues, hessenberg, matmul, solve, spectral_norm
from tests.quick_jit import quick_jit

EPS = np.finfo(float).eps
SIZES = (1, 2, 3, 4, 5, 6)
COUNT = 40


def similar(rng, diagonal_form: np.ndarray) -> np.ndarray:
    """Matrix with the given Jordan form in random orthogonal coordinates, which keep its condition."""
    q = np.linalg.qr(rng.standard_normal(diagonal_form.shape))[0]
    return q @ diagonal_form @ q.T


def graded(rng, n: int) -> np.ndarray:
    """Matrix with entries over 16 decades, as for the multipliers of a strongly damped system."""
    scale = 10.0 ** -np.linspace(0, 16 if n > 1 else 0, n)
    return rng.standard_normal((n, n)) * np.sqrt(scale[:, None] * scale)


def family(kind: str, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if kind == "random":
        return rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-100, 100)
    if kind == "orthogonal":
        return np.linalg.qr(rng.standard_normal((n, n)))[0]
    if kind == "symmetric":
        a = rng.standard_normal((n, n))
        return a + a.T
    if kind == "defective":
        return similar(
            rng, np.diag([-1.0] * min(n, 2) + [0.3] * (n - 2)) + np.eye(n, k=1) * (np.arange(n) == 0)[:, None]
        )
    if kind == "double":
        return similar(rng, np.diag([1.5] * min(n, 2) + list(rng.uniform(-1, 1, max(n - 2, 0)))))
    if kind == "rotation":
        # A permutation, on which unshifted QR makes no progress.
        return np.roll(np.eye(n), 1, axis=0)
    if kind == "diagonal":
        return np.diag(rng.standard_normal(n))
    return graded(rng, n) if kind == "graded" else np.zeros((n, n))


KINDS = ("random", "orthogonal", "symmetric", "defective", "double", "rotation", "diagonal", "graded", "zero")


@pytest.fixture(scope="module", params=SIZES)
def spectra(request):
    """All kinds of matrices of one size, with two lanes that are not finite among them, and their eigenvalues."""
    n = request.param
    matrices = {kind: np.stack([family(kind, n, seed) for seed in range(COUNT)]) for kind in KINDS}
    batch = np.concatenate([np.full((1, n, n), np.nan), *matrices.values(), np.full((1, n, n), np.inf)])
    # Not optimised: the code is unrolled for every size, and optimisation would take longer than all these tests.
    compiled = jax.jit(eigenvalues, compiler_options={"xla_backend_optimization_level": 0})
    real, imaginary = compiled(jnp.moveaxis(batch, 0, -1))
    values = np.asarray(real + 1j * imaginary).T
    assert not np.isfinite(values[[0, -1]]).any()
    assert n == 1 or np.isnan(values[[0, -1]]).all()
    return {kind: (matrices[kind], values[1:-1][i * COUNT : (i + 1) * COUNT]) for i, kind in enumerate(KINDS)}


@pytest.mark.parametrize("kind", KINDS)
def test_eigenvalues_are_backward_stable(spectra, kind):
    """Each value is an eigenvalue of a matrix within rounding: the smallest singular value of A - lambda I is rounding."""
    matrices, values = spectra[kind]
    n = matrices.shape[-1]
    norm = np.maximum(np.linalg.norm(matrices, axis=(1, 2)), np.finfo(float).tiny)
    shifted = (matrices[:, None] - values[:, :, None, None] * np.eye(n)) / norm[:, None, None, None]
    assert np.linalg.svd(shifted, compute_uv=False)[..., -1].max() <= 20 * n * EPS


@pytest.mark.parametrize("kind", KINDS)
def test_eigenvalues_are_all_found_and_once(spectra, kind):
    """The values pair with NumPy's; a defective pair is determined only to the square root of the rounding."""
    matrices, values = spectra[kind]
    tolerance = {"defective": 1e-6, "random": 1e-11, "graded": 1e-11}.get(kind, 1e-13)
    for matrix, found in zip(matrices, values, strict=True):
        expected = np.linalg.eigvals(matrix)
        distance = np.abs(found[:, None] - expected)
        pairs = linear_sum_assignment(distance)
        assert distance[pairs].max() <= tolerance * np.linalg.norm(matrix)


def test_eigenvalues_of_zero_are_zero(spectra):
    assert (spectra["zero"][1] == 0).all()


def test_eigenvalues_of_one_matrix_without_batch():
    a = np.array([[1.0, 2.0], [-3.0, 0.5]])
    real, imaginary = jax.jit(eigenvalues)(a)
    assert real.shape == imaginary.shape == (2,)
    np.testing.assert_allclose(
        np.sort_complex(real + 1j * imaginary), np.sort_complex(np.linalg.eigvals(a)), rtol=1e-14
    )


def test_hessenberg_form_is_similar():
    rng = np.random.default_rng(3)
    a = rng.standard_normal((5, 5, 8))
    h = np.moveaxis(np.asarray(jax.jit(hessenberg)(a)), -1, 0)
    assert np.abs(np.tril(h, -2)).max() <= 1e-14
    original = np.moveaxis(a, -1, 0)
    np.testing.assert_allclose(np.linalg.norm(h, axis=(1, 2)), np.linalg.norm(original, axis=(1, 2)), rtol=1e-13)
    for matrix, form in zip(original, h, strict=True):
        np.testing.assert_allclose(np.poly(form), np.poly(matrix), rtol=0, atol=1e-11)


def test_matmul_over_trailing_axes():
    rng = np.random.default_rng(4)
    a, b = rng.standard_normal((3, 4, 5, 2)), rng.standard_normal((4, 2, 5, 2))
    np.testing.assert_allclose(
        matmul(jnp.asarray(a), jnp.asarray(b)), np.einsum("ij...,jk...->ik...", a, b), rtol=1e-13
    )


@pytest.mark.parametrize("n", [1, 2, 4, 32])
def test_solve(n):
    rng = np.random.default_rng(n)
    a, b = rng.standard_normal((n, n)), rng.standard_normal((n, 3))
    x = np.asarray(jax.jit(solve)(a, b))
    np.testing.assert_allclose(a @ x, b, rtol=0, atol=1e-13 * np.linalg.cond(a) * np.abs(b).max())
    np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=0, atol=1e-13 * np.linalg.cond(a) * np.abs(x).max())


@pytest.mark.parametrize("small", [0.0, 1e-17])
def test_solve_pivots(small):
    """Without an exchange of rows the first pivot is zero, or so small that the other entries lose their digits."""
    a = np.array([[small, 1.0, 0.0], [1.0, 1.0, 2.0], [3.0, 0.0, small]])
    b = np.array([[1.0], [4.0], [3.0]])
    np.testing.assert_allclose(solve(jnp.asarray(a), jnp.asarray(b)), [[1.0], [1.0], [1.0]], rtol=1e-14)


@pytest.mark.parametrize("a", [np.zeros((3, 3)), np.ones((2, 2)), np.diag([1.0, 0.0, 2.0])])
def test_solve_tells_a_singular_matrix(a):
    assert not np.isfinite(solve(jnp.asarray(a), jnp.eye(len(a)))).all()


def test_solve_tells_a_matrix_that_is_not_finite():
    assert not np.isfinite(solve(jnp.array([[np.nan, 1.0], [1.0, 2.0]]), jnp.eye(2))).all()


norm = jax.jit(spectral_norm)


@pytest.mark.parametrize("shape", [(4, 4), (6, 2), (2, 3)])
@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_spectral_norm(shape, size):
    a = size * np.random.default_rng(5).standard_normal(shape)
    assert float(norm(a)) == pytest.approx(np.linalg.norm(a, 2), rel=1e-13)


def test_spectral_norm_of_zero_and_of_rank_one():
    assert float(norm(np.zeros((4, 4)))) == 0
    u, v = np.array([1.0, 2.0, 2.0, 4.0]), np.array([3.0, 4.0, 0.0, 0.0])
    assert float(norm(np.outer(u, v))) == pytest.approx(25.0, rel=1e-13)


def test_derivatives_of_the_spectral_norm():
    """They are the product of the singular vectors."""
    a = np.random.default_rng(3).normal(size=(4, 4))
    left, _, right = np.linalg.svd(a)
    slope = quick_jit(jax.grad(spectral_norm))(jnp.asarray(a))
    np.testing.assert_allclose(slope, np.outer(left[:, 0], right[0]), rtol=1e-10)
