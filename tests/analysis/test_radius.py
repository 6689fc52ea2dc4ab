"""The spectral radius in closed form against eigenvalues, where it is certain and where it is not."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.multipliers import PolynomialError
from drivetrain_jax.analysis.floquet.results import has_closed_form, radius_by_eigenvalues, radius_in_closed_form
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from tests.quick_jit import quick_jit

ERROR, TOLERANCE = 1e-10, 1e-6


def matrices(multipliers: np.ndarray, seed: int = 0) -> jnp.ndarray:
    """Real matrices ``(4, 4, N)`` with the eigenvalues ``(N, 4)``, each half a conjugate pair or two real numbers."""
    rng = np.random.default_rng(seed)
    blocks = np.zeros((len(multipliers), 4, 4))
    for k in (0, 2):
        one, two = multipliers[:, k], multipliers[:, k + 1]
        real = one.imag == 0
        blocks[:, k, k], blocks[:, k + 1, k + 1] = one.real, two.real
        blocks[:, k, k + 1], blocks[:, k + 1, k] = np.where(real, 0, one.imag), np.where(real, 0, -one.imag)
    turn = np.linalg.qr(rng.normal(size=(len(multipliers), 4, 4)))[0]
    turn = turn + 0.1 * rng.normal(size=turn.shape)
    return jnp.moveaxis(jnp.asarray(turn @ blocks @ np.linalg.inv(turn)), 0, -1)


def samples(count: int) -> np.ndarray:
    """Eigenvalues with moduli from 1e-3 to 3: two pairs, a pair and two real numbers of one sign, or four real numbers."""
    rng = np.random.default_rng(1)
    modulus, angle = 10.0 ** rng.uniform(-3, 0.5, (count, 4)), rng.uniform(0, np.pi, (count, 2))
    pairs = [modulus[:, k] * np.exp(1j * angle[:, k]) for k in (0, 1)]
    found = np.stack([pairs[0], pairs[0].conj(), pairs[1], pairs[1].conj()], axis=1)
    signs = rng.choice([-1.0, 1.0], (count, 2)).repeat(2, axis=1)
    third = np.arange(count) % 3
    found[third > 0, 2:] = (signs * modulus)[third > 0, 2:]
    found[third > 1, :2] = (signs * modulus)[third > 1, :2]
    return found


def relative(z: jnp.ndarray) -> PolynomialError:
    """Coefficients with the relative error ``ERROR``."""
    rho = np.abs(np.linalg.eigvals(np.nan_to_num(np.moveaxis(np.asarray(z), -1, 0)))).max(axis=1)
    return PolynomialError(jnp.asarray(ERROR * rho ** np.arange(1, 5)[:, None]))


LANES = 3000
closed_form = quick_jit(radius_in_closed_form)


def radii(z: jnp.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radius and bound of each lane; all calls share a kernel of ``LANES`` lanes."""
    lanes = z.shape[-1]
    z = jnp.pad(z, ((0, 0), (0, 0), (0, LANES - lanes)), mode="edge")
    rho, bound, _ = closed_form(z, relative(z), jnp.ones(LANES), jnp.zeros(LANES, bool), TOLERANCE)
    return np.asarray(rho)[:lanes], np.asarray(bound)[:lanes]


def test_bound_holds_and_is_a_few_times_that_of_eigenvalues():
    multipliers = samples(LANES)
    z = matrices(multipliers)
    exact = np.abs(multipliers).max(axis=1)
    rho, bound = radii(z)
    assert (np.abs(rho - exact) <= bound).all()
    other = quick_jit(lambda z, error: radius_by_eigenvalues(eigenvalues(z), error)[1])(z, relative(z))
    assert np.median(bound / other) < 4
    assert (bound < TOLERANCE * exact).mean() > 0.99


@pytest.mark.parametrize("smallest", [1e-17, -1e-17])
def test_a_determinant_below_rounding_is_counted_as_its_error(smallest):
    """The closed form has two quadratics with positive constants, which cannot have a negative determinant."""
    rho, bound = radii(matrices(np.array([[2.0, -0.5, 0.3, smallest], [2.0, 0.5, 0.3, smallest]], complex)))
    assert (np.abs(rho - 2.0) <= bound).all() and (bound < 1e-8).all()
    rho, bound = radii(matrices(np.array([[2.0, -0.5, 0.3, 1e16 * smallest]], complex)))
    assert abs(rho[0] - 2.0) <= bound[0]


@pytest.mark.full
def test_lanes_do_not_depend_on_each_other():
    """Lanes do not change if another lane needs eigenvalues or is NaN."""
    z = matrices(samples(30))
    negative = matrices(np.array([[2.0, -0.5, 0.3, 0.1]], complex))
    alone = radii(z)
    beside = radii(jnp.concatenate([z, negative, jnp.full((4, 4, 1), jnp.nan)], axis=-1))
    for one, two in zip(alone, beside, strict=True):
        assert np.array_equal(one, two[:30])
    assert np.isnan(beside[0][-1])


def test_meeting_multipliers_have_the_root_of_the_error_as_bound():
    """The bound of a pair that approaches a double multiplier holds and stays finite."""
    for gap in (1e-3, 1e-6, 0.0):
        rho, bound = radii(matrices(np.array([[1.2 + gap, 1.2 - gap, 0.2 + 0.1j, 0.2 - 0.1j]])))
        assert abs(rho[0] - 1.2 - gap) <= bound[0] <= 1e-4


def test_it_serves_four_states_in_lanes():
    assert has_closed_form(jnp.zeros((4, 4, 7)))
    assert not has_closed_form(jnp.zeros((4, 4)))
    assert not has_closed_form(jnp.zeros((2, 2, 7)))
