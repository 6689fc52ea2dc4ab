"""The batched singular values and vectors against LAPACK and mpmath."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.modes import follow
from drivetrain_jax.analysis.numerics.kernels import compiler_options, options_for_few
from drivetrain_jax.analysis.numerics.lanes import in_blocks
from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul
from drivetrain_jax.analysis.numerics.singular_values import (
    EPS,
    _rotation,
    bidiagonal_form,
    bidiagonal_values,
    jacobi_vectors,
    singular_values,
)
from drivetrain_jax.systems import get_system
from tests.oracles.planetary_reference import case_parameters

ROWS, COLUMNS = 12, 9


def random_matrices() -> np.ndarray:
    """Matrices (lanes, rows, columns): dense, rank deficient, with double values, graded, in blocks, tiny, huge, zero."""
    rng = np.random.default_rng(3)
    dense = rng.standard_normal((8, ROWS, COLUMNS))
    deficient = dense @ np.diag([1, 1, 1, 1, 1, 1, 1, 0, 0]) @ np.linalg.qr(rng.standard_normal((COLUMNS, COLUMNS)))[0]
    u, _, v = np.linalg.svd(dense, full_matrices=False)
    double = u @ np.diag([5, 5, 5, 3, 3, 2, 1, 1, 1]) @ v
    graded = dense * np.logspace(0, -6, ROWS)[:, None]
    separate = dense.copy()
    separate[:, :6, 4:] = separate[:, 6:, :4] = 0
    return np.concatenate([dense, deficient, double, graded, separate, 1e-160 * dense, 1e150 * dense, 0 * dense[:1]])


@pytest.fixture(scope="module")
def matrices() -> np.ndarray:
    return random_matrices()


@pytest.fixture(scope="module")
def compiled():
    return jax.jit(lambda a: (*singular_values(a), *jacobi_vectors(a)))


@pytest.fixture(scope="module")
def solved(compiled, matrices):
    return [np.asarray(x) for x in compiled(jnp.asarray(np.moveaxis(matrices, 0, -1)))]


def test_values(solved, matrices):
    exact = np.linalg.svd(matrices, compute_uv=False)[:, ::-1].T
    values, found, *_ = solved
    assert found.all()
    assert (np.diff(values, axis=0) >= 0).all()
    assert (np.abs(values - exact) <= 30 * EPS * exact[-1]).all()


def test_rotations_are_orthogonal_however_small_the_numbers():
    f, g = np.meshgrid(*2 * (np.concatenate([[0.0], np.logspace(-307, 150, 2000)]),))
    c, s, r = (np.asarray(x) for x in jax.jit(_rotation)(f, g))
    assert np.abs(c**2 + s**2 - 1).max() < 8 * EPS
    allowed = 8 * EPS * np.hypot(f, g) + 2e-140
    assert (np.abs(c * f + s * g - r) <= allowed).all() and (np.abs(c * g - s * f) <= allowed).all()


@pytest.mark.full
@pytest.mark.parametrize("few", [False, True], ids=["optimised", "few"])
def test_coincident_values_however_it_is_compiled(few):
    """The form of a gear with twelve planets has many entries of pure rounding.

    Two evaluations with different rounding would give rotations that are not orthogonal: errors were 1e-7 without
    optimisation.
    """
    case = json.loads((Path(__file__).parents[1] / "reference" / "planetary.json").read_text())["N12_random"]
    parameters = case_parameters(case)
    parameters["planet_angle"] = tuple(parameters["planet_angle"])
    factor = np.asarray(get_system("planetary").models["modes"].build(parameters).whole.factor)
    lanes = jnp.repeat(jnp.asarray(factor)[:, :, None], 8, axis=2)
    options = options_for_few() if few else compiler_options(short_loops=True)
    values, found = map(np.asarray, jax.jit(singular_values).lower(lanes).compile(options)(lanes))
    exact = np.linalg.svd(factor, compute_uv=False)[::-1]
    assert found.all()
    assert np.abs(values - exact[:, None]).max() <= 30 * EPS * exact[-1]


def test_a_wide_batch():
    """With some thousand lanes the compiler fuses and splits loops differently."""
    a = np.random.default_rng(4).standard_normal((5000, 7, 5))
    values, found = map(np.asarray, jax.jit(singular_values)(jnp.asarray(np.moveaxis(a, 0, -1))))
    exact = np.linalg.svd(a, compute_uv=False)[:, ::-1].T
    assert found.all()
    assert (np.abs(values - exact) <= 30 * EPS * exact[-1]).all()


def test_vectors_are_orthonormal_and_reproduce_the_values(solved, matrices):
    values, _, vectors, found = solved
    assert found.all()
    lanes = np.moveaxis(vectors, -1, 0)
    np.testing.assert_allclose(
        np.swapaxes(lanes, 1, 2) @ lanes, np.broadcast_to(np.eye(COLUMNS), lanes.shape), atol=2e-14
    )
    size = np.maximum(values[-1], 1e-300)
    lengths = np.sort(np.linalg.norm(matrices / size[:, None, None] @ lanes, axis=1), axis=1)
    assert (np.abs(lengths - (values / size).T) <= 30 * EPS).all()


def test_a_lane_that_is_not_finite_spoils_only_itself(compiled, matrices, solved):
    spoilt = np.moveaxis(matrices, 0, -1).copy()
    spoilt[2, 3, 5], spoilt[0, 0, 11] = np.nan, np.inf
    values, found, _, vectors_found = map(np.asarray, compiled(jnp.asarray(spoilt)))
    bad = np.isin(np.arange(found.size), [5, 11])
    assert (found == ~bad).all() and (vectors_found == ~bad).all()
    assert np.isnan(values[:, bad]).all()
    np.testing.assert_array_equal(values[:, ~bad], solved[0][:, ~bad])


def test_blocks_are_one_matrix_without_an_entry_between_them(matrices):
    a, b = (jnp.asarray(np.moveaxis(x, 0, -1)) for x in (matrices[:8], matrices[8:16, :5, :3]))
    form = jax.jit(bidiagonal_form)(a, b)
    assert (np.asarray(form.upper)[[COLUMNS - 1, -1]] == 0).all() and (np.asarray(form.upper)[0] != 0).all()
    values = np.sort(np.asarray(jax.jit(bidiagonal_values)(form)[0]), axis=0)
    separate = [np.linalg.svd(x, compute_uv=False) for x in (matrices[:8], matrices[8:16, :5, :3])]
    exact = np.sort(np.concatenate(separate, axis=1), axis=1).T
    assert (np.abs(values - exact) <= 30 * EPS * exact[-1]).all()


def test_product():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((3, 4, 5)), rng.standard_normal((4, 2, 5))
    np.testing.assert_allclose(
        np.asarray(looped_matmul(jnp.asarray(a), jnp.asarray(b))), np.einsum("ikn,kjn->ijn", a, b)
    )


def test_in_blocks_gives_what_the_whole_gives():
    values = {"a": jnp.arange(10.0), "b": 2.0, "c": (3.0, jnp.arange(10.0) ** 2)}

    def function(part, count):
        assert isinstance(part["b"], float)
        return jnp.stack([part["a"] * part["b"], part["c"][0] + part["c"][1]])

    np.testing.assert_array_equal(in_blocks(function, values, 10, 4), function(values, 10))


def rotating(angles: np.ndarray) -> np.ndarray:
    """Shapes (L, 3, 3): two turn by ``angles``, the third stays."""
    c, s, o = np.cos(angles), np.sin(angles), 0 * angles
    return np.stack([np.stack([c, s, o], 1), np.stack([-s, c, o], 1), np.stack([o, o, o + 1], 1)], axis=2)


def test_branches_go_with_the_shape_through_a_crossing():
    """Modes 1 and 3 exchange their order at the third point."""
    shapes = rotating(np.linspace(0, 0.3, 6))
    shapes[2:] = shapes[2:][:, :, [2, 1, 0]]
    same = np.broadcast_to(np.eye(3, dtype=bool), (6, 3, 3))
    branch, mac = map(np.asarray, follow(jnp.asarray(shapes), jnp.asarray(same)))
    assert branch[:2].tolist() == [[1, 2, 3]] * 2 and branch[2:].tolist() == [[3, 2, 1]] * 4
    np.testing.assert_allclose(mac[1:, 1], np.cos(0.06) ** 2)
    np.testing.assert_allclose(mac[0], 1)


def test_branches_pass_a_point_where_two_frequencies_meet():
    shapes = rotating(np.full(5, 0.2))
    turn = rotating(np.array([0.9]))[0]
    shapes[2] = shapes[2] @ turn
    same = np.broadcast_to(np.eye(3, dtype=bool), (5, 3, 3)).copy()
    same[2, :2, :2] = True
    branch, mac = map(np.asarray, follow(jnp.asarray(shapes), jnp.asarray(same)))
    assert branch[3:].tolist() == [[1, 2, 3]] * 2
    np.testing.assert_allclose(mac, 1)


def test_a_point_without_vectors_does_not_lose_the_branches():
    shapes = rotating(np.linspace(0, 0.2, 5))
    shapes[2] = np.nan
    same = np.broadcast_to(np.eye(3, dtype=bool), (5, 3, 3))
    branch, mac = map(np.asarray, follow(jnp.asarray(shapes), jnp.asarray(same)))
    assert branch.tolist() == [[1, 2, 3]] * 5
    assert np.isnan(mac[2]).all() and np.isfinite(mac[[0, 1, 3, 4]]).all()
