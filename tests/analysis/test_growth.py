"""The record of growth: means, standard errors, memory, and compilation of the march."""

from __future__ import annotations

import math
from dataclasses import replace

import flows
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.lyapunov.analysis import spectrum_of, sum_rule_residual
from drivetrain_jax.analysis.lyapunov.growth_record import SEGMENTS, block_mean, drift, record_growth
from drivetrain_jax.analysis.lyapunov.variational import one_kernel
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel

SPAN = 2.0


def mean_and_error(series: np.ndarray, used: int = SEGMENTS) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of ``series`` (SEGMENTS, N), one exponent for each of N members."""
    mean, error = block_mean(jnp.asarray(series)[:, None], jnp.full(series.shape[1], used), jnp.float64(SPAN))
    return np.asarray(mean)[0], np.asarray(error)[0]


@pytest.mark.full
def test_standard_error_of_independent_segments():
    """The error of 48 segments is sigma/sqrt(48) per duration of a segment; the larger of two estimates is 9 % more on
    average."""
    series = 3.0 + 0.5 * np.random.default_rng(1).standard_normal((SEGMENTS, 4000))
    mean, error = mean_and_error(series)
    exact = 0.5 / math.sqrt(48) / SPAN
    assert mean.mean() == pytest.approx(3.0 / SPAN, abs=4 * exact / math.sqrt(4000))
    assert mean.std() == pytest.approx(exact, rel=0.05)
    assert exact < error.mean() < 1.2 * exact


def test_standard_error_sees_slow_fluctuations():
    """Equal segments in groups of four (one block) double the error of independent segments; groups of eight make it 2.8
    times larger."""
    noise = np.random.default_rng(2).standard_normal((SEGMENTS // 8, 4000))
    mean, error = mean_and_error(np.repeat(noise, 8, axis=0))
    assert np.sqrt(np.mean(error**2)) > 0.85 * mean.std()


def test_transient_is_discarded():
    series = np.where(np.arange(SEGMENTS) < SEGMENTS // 4, 100.0, 1.0)[:, None]
    mean, error = mean_and_error(series)
    assert (mean[0], error[0]) == (1.0 / SPAN, 0.0)


def test_growth_in_proportion_to_time_is_within_its_error():
    """The exponent is zero, but the mean over the last three quarters is ln 4/(0.75 T), five standard errors of blocks."""
    edges = np.log(np.arange(SEGMENTS + 1.0).clip(0.5))
    mean, error = mean_and_error(np.diff(edges)[:, None])
    time = SEGMENTS * SPAN
    assert mean[0] * time == pytest.approx(math.log(4) / 0.75, rel=1e-12)
    assert error[0] * time == pytest.approx(1.085, abs=0.01)


def test_a_drift_is_told_from_scatter():
    """99 % of independent series have no drift; most of a change by ten standard errors is found."""
    series = np.random.default_rng(3).standard_normal((SEGMENTS, 4000)) / math.sqrt(48) / SPAN
    means = series[SEGMENTS // 4 :].reshape(12, 4, -1).mean(axis=1)
    found = np.asarray(drift(jnp.asarray(means)))
    assert (found == 0).mean() > 0.99
    change = 10 * means.std() / math.sqrt(3)
    stepped = np.asarray(drift(jnp.asarray(means + change * (np.arange(12) < 6)[:, None])))
    assert 0.6 * change < np.median(stepped) < change


def damped(max_time: float, lanes: int = 4):
    flow = flows.linear(np.linspace(0.2, 0.3, lanes), np.ones(lanes))
    return lambda: record_growth(flow, 12, max_time, 0.0, jnp.ones(lanes, bool))


@pytest.mark.full
def test_memory_does_not_grow_with_the_number_of_strobes():
    """The record and the working memory have the same size for 64 strobes and for 64,000."""
    sizes = []
    for max_time in (64.0, 64_000.0):
        compiled = jax.jit(damped(max_time)).lower().compile()
        memory = compiled.memory_analysis()
        sizes.append((memory.temp_size_in_bytes, memory.output_size_in_bytes))
    assert sizes[0] == sizes[1]


@pytest.mark.full
def test_sum_rule_sees_a_wrong_divergence():
    """The residual is zero for the true divergence of the field, and the error of a wrong one."""
    flow = flows.linear(np.full(2, 0.2), np.ones(2))
    for claimed, residual in ((-0.2, 0.0), (-0.25, 0.05)):
        record = record_growth(replace(flow, divergence=lambda *_, c=claimed: c), 12, 64.0, 0.0, jnp.ones(2, bool))
        np.testing.assert_allclose(sum_rule_residual(record, spectrum_of(record)), residual, atol=1e-9)


@pytest.mark.full
def test_marks_of_the_compiler_change_rounding_only(monkeypatch):
    """A short march of Lorenz' system agrees with and without the marks.

    The third vector shrinks to a thousandth of the others within a strobe, and loses three to four digits.
    """
    flow, active = flows.lorenz(33), jnp.ones(33, bool)

    def growth() -> np.ndarray:
        return np.asarray(jax.jit(lambda: record_growth(flow, 32, 1.0, 0.0, active).growth)())[:2]

    marked = growth()
    monkeypatch.setattr("drivetrain_jax.analysis.lyapunov.variational.stored", lambda function: function)
    monkeypatch.setattr(
        "drivetrain_jax.analysis.lyapunov.growth_record.one_kernel", lambda _: lambda function: function
    )
    plain = growth()
    np.testing.assert_allclose(marked[:, :2], plain[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(marked[:, 2], plain[:, 2], rtol=0, atol=1e-9)


def test_marked_functions_compute_what_they_are():
    x = jnp.linspace(0.1, 1.0, 50)
    for mark in (stored, in_one_kernel):
        assert jnp.array_equal(jax.jit(mark(lambda x: jnp.where(x > 0.5, x * 2, x)))(x), jnp.where(x > 0.5, x * 2, x))


@pytest.mark.parametrize("start", [(jnp.sin, jnp.cos), (jnp.sin, jnp.sin), (jnp.zeros_like, jnp.zeros_like)])
@pytest.mark.parametrize("steps", [0, 3])
def test_a_kernel_may_be_given_what_it_does_not_use(start, steps):
    """The compiler once aborted the process for unused inputs: a time without a clock, or all inputs of no steps."""
    unused = jnp.linspace(0.0, 1.0, 8)

    def march(x, y, z, time):
        def step(_, state):
            x, y, time = state
            return x + z, y * z, time + unused

        return jax.lax.fori_loop(0, steps, step, (x, y, time))[:2]

    x = jnp.linspace(0.1, 1.0, 8)
    ends = jax.jit(lambda x: in_one_kernel(march)(start[0](x), start[1](x), 2 * x, x))(x)
    np.testing.assert_allclose(ends, [start[0](x) + steps * 2 * x, start[1](x) * (2 * x) ** steps], rtol=1e-15)


@pytest.mark.full
def test_a_field_that_sorts_does_without_the_single_kernel():
    """Sorting cannot be part of a single kernel: the march is slower, but as accurate."""
    plain = flows.linear(np.full(3, 0.2), np.ones(3))

    def field(angles, y):
        return jnp.sort(jnp.stack(jnp.broadcast_arrays(*plain.field(angles, y))), axis=0)[0], -y[1]

    unusual = replace(plain, field=field)
    assert suits_one_kernel(lambda y: plain.field((), y), (jnp.ones(3), jnp.ones(3)))
    assert one_kernel(plain) is in_one_kernel
    assert one_kernel(unusual) is not in_one_kernel
    record = jax.jit(lambda: record_growth(unusual, 8, 8.0, 0.0, jnp.ones(3, bool)))()
    assert np.isfinite(record.growth).all()
