"""Bounds and verdicts of systems that a user writes, at random points, against long doubles."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.effort import _estimate, _panels_of
from drivetrain_jax.analysis.floquet.propagator import monodromy
from drivetrain_jax.analysis.floquet.results import results
from drivetrain_jax.systems import FloquetModel, LinearPeriodic
from tests.sizes import full_after

SPAN, ORDER = 2 * np.pi, 30
OUTPUTS = ("spectral_radius", "spectral_radius_error", "verdict")
Harmonics = tuple[np.ndarray, np.ndarray, np.ndarray]


def propagator(harmonics: Harmonics) -> tuple[np.ndarray, np.ndarray]:
    """Phi of ``x' = (A0 + A1 cos t + B1 sin t) x`` over SPAN in long doubles, by Taylor series; and log_scale."""
    a0, a1, b1 = (x.astype(np.longdouble) for x in harmonics)
    size = sum(np.abs(x).sum(axis=2).max(axis=1) for x in (a0, a1, b1)) + 1
    steps = np.ceil(SPAN * size / 2).astype(int) + 1
    phi = np.broadcast_to(np.eye(a0.shape[1], dtype=np.longdouble), a0.shape).copy()
    log_scale = np.zeros(len(phi), np.longdouble)
    for k in range(steps.max()):
        lanes = np.flatnonzero(k < steps)
        h = np.longdouble(SPAN) / steps[lanes]
        cosine, sine = np.cos(k * h), np.sin(k * h)
        terms, factor = [], h
        for m in range(ORDER):
            c, s = ((cosine, sine), (-sine, cosine), (-cosine, -sine), (sine, -cosine))[m % 4]
            terms.append((factor * c)[:, None, None] * a1[lanes] + (factor * s)[:, None, None] * b1[lanes])
            factor = factor * h / (m + 1)
        terms[0] += h[:, None, None] * a0[lanes]
        y = [phi[lanes]]
        for m in range(ORDER):
            y.append(sum(np.einsum("nij,njk->nik", terms[j], y[m - j]) for j in range(m + 1)) / (m + 1))
        total = sum(y[::-1])
        largest = np.abs(total).max(axis=(1, 2))
        phi[lanes], log_scale[lanes] = total / largest[:, None, None], log_scale[lanes] + np.log(largest)
    return phi, log_scale


def spectral_radius(z: np.ndarray) -> np.ndarray:
    """The largest modulus of the eigenvalues: the method of Aberth on the characteristic polynomial."""
    n, power, coefficients = z.shape[1], z, [np.ones(len(z), z.dtype)]
    for k in range(1, n + 1):
        coefficients.append(-np.trace(power, axis1=1, axis2=2) / k)
        power = np.einsum("nij,njk->nik", z, power + coefficients[-1][:, None, None] * np.eye(n))
    start = np.linalg.eigvals(z.astype(float)).T
    roots = (start + 1e-14 * np.abs(start).max(axis=0) * np.arange(n)[:, None]).astype(np.clongdouble)
    for _ in range(40):
        value, slope = np.zeros_like(roots), np.zeros_like(roots)
        for a in coefficients:
            value, slope = value * roots + a, slope * roots + value
        with np.errstate(all="ignore"):
            gaps = roots[:, None] - roots
            others = np.where(np.eye(n, dtype=bool)[..., None], 0, 1 / gaps).sum(axis=1)
            change = value / (slope - value * others)
        roots -= np.where(np.isfinite(change), change, 0)
    return np.abs(roots).max(axis=0)


def rows(second_order: bool, harmonics, t):
    n, cosine, sine = len(harmonics[0]), jnp.cos(t), jnp.sin(t)
    half = n // 2 if second_order else 0
    a0, a1, b1 = harmonics
    entry = lambda i, j: a0[i, j] + a1[i, j] * cosine + b1[i, j] * sine  # noqa: E731
    upper = tuple(tuple(1.0 if j == i + half else 0 for j in range(n)) for i in range(half))
    return upper + tuple(tuple(entry(i, j) for j in range(n)) for i in range(half, n))


def solver(second_order: bool, harmonics: Harmonics):
    """The results as a function of rtol. As ``direct`` does: points of similar sizes in chunks."""

    def build(values) -> FloquetModel:
        form = LinearPeriodic(jax.tree_util.Partial(partial(rows, second_order), values["harmonics"]), SPAN)
        return FloquetModel(form, form, hamiltonian=lambda: False)

    @jax.jit
    def chunk(harmonics, rtol):
        needed = jax.vmap(lambda own: _panels_of(*_estimate(build, {"harmonics": own}), rtol))(harmonics)
        panels = jnp.ceil(jnp.max(needed)).astype(jnp.int64)
        one = lambda own: monodromy(build({"harmonics": own}).direct, panels, rtol / 4)  # noqa: E731
        return results(jax.vmap(one, out_axes=-1)(harmonics), OUTPUTS, rtol, build({"harmonics": harmonics}))

    order = np.argsort(sum(np.abs(x).sum(axis=(1, 2)) for x in harmonics))

    def solved(rtol: float) -> dict[str, np.ndarray]:
        parts = [chunk(tuple(x[part] for x in harmonics), rtol) for part in order.reshape(-1, min(500, len(order)))]
        return {name: np.concatenate([part[name] for part in parts])[np.argsort(order)] for name in OUTPUTS}

    return solved


def random_systems(kind: str, n: int, count: int) -> Harmonics:
    rng = np.random.default_rng(n)
    normal = lambda: rng.standard_normal((count, n, n))  # noqa: E731
    scale = 10 ** rng.uniform(-1.0, 0.7, (count, 1, 1))
    a0, a1, b1 = 0.3 * scale * normal(), scale * rng.random((count, 1, 1)) * normal(), 0.3 * scale * normal()
    if kind == "second order":
        stiffness, half = scale**2, n // 2
        square = a0[:, half:, :half] @ np.swapaxes(a0[:, half:, :half], 1, 2) / scale**2
        a0[:, :half], a1[:, :half], b1[:, :half] = 0, 0, 0
        a0[:, :half, half:] = np.eye(half)
        a0[:, half:, :half] = -stiffness * (square + np.eye(half))
        a1[:, half:, :half] *= scale
        a0[:, half:, half:] = -0.1 * scale * np.eye(half)
        a1[:, half:, half:], b1[:, half:, half:] = 0, 0
    if kind == "steep":
        # Rates of up to 20 that change their sign within the period.
        for x in (a1, b1):
            x[:, range(n), range(n)] += 10 ** rng.uniform(-0.5, 1.3, (count, n)) * rng.choice([-1, 1], (count, n))
    return a0, a1, b1


@pytest.mark.parametrize(
    "kind, n, count",
    full_after(
        1,
        [
            ("second order", 2, 100),
            ("second order", 2, 5000),
            ("first order", 2, 5000),
            ("steep", 2, 5000),
            ("first order", 3, 2000),
            ("steep", 4, 1500),
            ("second order", 4, 1500),
            ("second order", 6, 500),
            ("first order", 8, 500),
        ],
        several=True,
    ),
)
def test_bounds_and_verdicts(kind, n, count):
    harmonics = random_systems(kind, n, count)
    z, log_scale = propagator(harmonics)
    exact = spectral_radius(z) * np.exp(log_scale)
    solved = solver(kind == "second order", harmonics)
    for rtol in (1e-12, 1e-6):
        found = solved(rtol)
        radius, bound = (found[name].astype(np.longdouble) for name in OUTPUTS[:2])
        worst = np.nanmax(np.abs(radius - exact) / bound)
        assert worst <= 1, (rtol, worst, np.nanargmax(np.abs(radius - exact) / bound))
        assert np.isfinite(radius).mean() > 0.99 and np.median(bound / radius) < 1e-3 * rtol**0.5
        assert not np.any((found["verdict"] == 0) & (exact > 1)) and not np.any((found["verdict"] == 1) & (exact < 1))
