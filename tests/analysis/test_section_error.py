"""Errors of sections: errors of single strobes add up over the memory of the motion, and grow in chaos."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from flows import linear, lorenz
from scipy.linalg import expm

from drivetrain_jax.analysis.lyapunov.growth_record import discarded, sampled
from drivetrain_jax.analysis.lyapunov.variational import initial_state
from drivetrain_jax.analysis.poincare import EARLY, Steps, section_errors

DAMPING, STIFFNESS, TORQUE = [0.0, 0.01, 2.0], 20.0, 1.0
FIRST, COUNT = 200, 300


def errors_of(flow, steps: int, checks: Steps, first: int, count: int):
    """The section by equal steps, and its estimated errors."""

    def both():
        early, _ = sampled(flow, steps, initial_state(flow), 0, min(first, EARLY))
        states, _ = sampled(flow, steps, discarded(flow, steps, first), first, count)
        return states, section_errors(flow, states, early, first, checks, 1e-6)

    states, errors = jax.jit(both)()
    return np.asarray(states), errors


@pytest.fixture(scope="module")
def oscillators():
    """Sections and errors of oscillators: undamped, damped over 200 strobes, damped over one; 8 steps, compared with 6."""
    return errors_of(linear(np.array(DAMPING), STIFFNESS, TORQUE), 8, Steps(16, 6), FIRST, COUNT)


def exact_section(damping: float) -> np.ndarray:
    """The exact section, by powers of the matrix exponential about the equilibrium."""
    rest = np.array([TORQUE / STIFFNESS, 0.0])
    propagator = expm(np.array([[0.0, 1.0], [-STIFFNESS, -damping]]))
    state, found = np.array([1.0, 0.5]) - rest, []
    for _ in range(FIRST + COUNT):
        state = propagator @ state
        found.append(state + rest)
    return np.array(found[FIRST:])


def test_the_estimate_is_the_error_of_the_section(oscillators):
    states, (strobe, section) = oscillators
    for i, damping in enumerate(DAMPING[:2]):
        exact = exact_section(damping)
        error = np.abs(states[:, :, i] - exact).max() / np.abs(exact).max()
        assert 0.4 < float(section[i]) / error < 2.5
    # Without damping one strobe makes a thousandth of the error; with strong damping one strobe makes all of it.
    assert float(section[0]) > 100 * float(strobe[0])
    assert float(section[2]) < 10 * max(float(strobe[2]), 1e-15)


@pytest.mark.full
def test_chaotic_motion_is_lost_though_its_strobes_are_right():
    """Errors of at most 1e-8 in every strobe grow to the size of the motion for any number of steps."""
    _, (strobe, section) = errors_of(lorenz(2), 24, Steps(48, 12, 48), 20, 200)
    assert (np.asarray(strobe) < 1e-6).all()
    assert (np.asarray(section) > 0.1).all()
