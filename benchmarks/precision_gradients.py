"""Error against run time for the gradient of the spectral radius of the cardan shaft by all six parameters.

    python -m benchmarks.precision_gradients [--quick] [--out FOLDER]     # precision_gradients.csv and .png

Each region is one shaft and 63 neighbours within 0.5 %. The error is that of the gradient of the first shaft, relative to
its largest component, against complex steps through SciPy's DOP853 (tests/oracles/complex_step.py). A time is that of value
and gradient of one shaft in a batch of 64 (SciPy: 1), compiled, on one core. The rivals integrate the sixteen equations of
the fundamental matrix over the whole period, and differentiate the largest modulus of its eigenvalues: diffrax by reverse
and by forward mode, gradsolve by its record-and-replay adjoint (the record is not timed), SciPy by central differences.
gradsolve compiles for a minute, so it is measured in one region at one tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drivetrain_jax as dt
from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from benchmarks.timing import once
from tests.oracles.cardan_reference import BASE_CASE, NAMES, PERIOD, monodromy, spectral_radius
from tests.oracles.complex_step import cardan_monodromy, radius_slopes

REGIONS = {
    "easy": BASE_CASE | {"beta": 0.2, "Omega": 1.43},
    "typical": BASE_CASE | {"beta": 1.0, "Omega": 0.52, "zeta": 0.02},
    "damped": BASE_CASE | {"beta": 0.8, "Omega": 0.4, "zeta": 0.5, "gamma": 2.0},
}
_QUICK = ("typical",)
_LANES, _MOST_STEPS = 64, 4096


def columns_of(region: str, count: int) -> dict[str, np.ndarray]:
    """``count`` shafts of the region, its centre first."""
    rng = np.random.default_rng(0)
    return {name: REGIONS[region][name] * np.r_[1.0, rng.uniform(0.995, 1.005, count - 1)] for name in NAMES}


@cache
def reference(region: str) -> np.ndarray:
    """The gradient."""
    values = REGIONS[region]
    return radius_slopes(cardan_monodromy(values, NAMES), values, NAMES)[0]


def error_of(region: str, gradients: np.ndarray) -> Judged:
    """The error of the first of ``gradients`` (lanes, 6)."""
    exact = reference(region)
    error = float(np.max(np.abs(gradients[0] - exact)) / np.max(np.abs(exact)))
    return Judged(error) if math.isfinite(error) else Judged(math.nan, 1, "nan")


def _shaft(point: Any) -> dt.Cardan:
    return dt.Cardan(**dict(zip(NAMES, point, strict=True)))


def _radius(z: Any) -> Any:
    """The largest modulus of the eigenvalues."""
    return jnp.max(jnp.abs(jnp.linalg.eigvals(z)))


@once
def _package(rtol: float) -> Callable[..., Any]:
    def value(point: Any) -> Any:
        return dt.floquet(_shaft(point), rtol=rtol).spectral_radius

    return _compiled(jax.vmap(jax.value_and_grad(value)))


@once
def _diffrax(rtol: float, forward: bool) -> Callable[..., Any]:
    import diffrax

    adjoint = diffrax.ForwardMode() if forward else diffrax.RecursiveCheckpointAdjoint()

    def value(point: Any) -> Any:
        shaft = _shaft(point)
        field = jax.vmap(lambda t, y: shaft.linear_field(t, y) - shaft.linear_field(t, jnp.zeros(4)), in_axes=(None, 0))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: field(t, y)), diffrax.Dopri8(), 0.0, PERIOD, None, jnp.eye(4),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-2 * rtol), max_steps=_MOST_STEPS, adjoint=adjoint,
        )  # fmt: skip
        return _radius(solution.ys[0].T)

    if forward:
        return _compiled(jax.vmap(lambda point: (value(point), jax.jacfwd(value)(point))))
    return _compiled(jax.vmap(jax.value_and_grad(value)))


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(function).lower(jax.ShapeDtypeStruct((_LANES, len(NAMES)), float)).compile()


class _Fundamental:
    """The fundamental matrix as a problem of gradsolve."""

    name, dim, t0, t1, is_stiff = "fundamental_matrix_of_a_cardan_shaft", 16, 0.0, PERIOD, False

    def f_jax(self, t: Any, y: Any, p: Any) -> Any:
        """The right-hand side of the four columns."""
        shaft = _shaft(p)
        field = jax.vmap(lambda x: shaft.linear_field(t, x) - shaft.linear_field(t, jnp.zeros(4)))
        return field(y.reshape(4, 4)).reshape(-1)


def _gradsolve(points: np.ndarray, rtol: float) -> Callable[[], np.ndarray]:
    import gradsolve

    starts = np.tile(np.eye(4).reshape(-1), (_LANES, 1))
    states = gradsolve.grad_closure(_Fundamental(), starts, points, engine="tsit5_replay", rtol=rtol, atol=1e-2 * rtol)

    def total(points: Any) -> Any:
        return jnp.sum(jax.vmap(lambda y: _radius(y.reshape(4, 4).T))(states(points)))

    both = jax.jit(jax.value_and_grad(total)).lower(points).compile()
    return lambda: np.asarray(both(points)[1])


def differences(region: str, rtol: float) -> np.ndarray:
    """Central differences of SciPy's spectral radius."""
    h, values = rtol ** (1 / 3), REGIONS[region]

    def radius(name: str, sign: int) -> float:
        point = values | {name: values[name] * (1 + sign * h)}
        return float(spectral_radius(monodromy(point, "DOP853", rtol, rtol)))

    return np.array([[(radius(name, 1) - radius(name, -1)) / (2 * h * values[name]) for name in NAMES]])


def _contender(region: str, method: str, rtol: float, prepare: Callable[[], Any], count: int = _LANES) -> Contender:
    return Contender("gradients", region, method, f"rtol={rtol:g}", count, prepare, partial(error_of, region))


def _batch(points: np.ndarray, make: Callable[[], Callable[..., Any]]) -> Callable[[], np.ndarray]:
    """A job that returns the gradients at ``points``; ``make`` compiles values and gradients."""
    run = make()
    return lambda: np.asarray(jax.block_until_ready(run(points))[1])


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions."""
    found = []
    for region in _QUICK if quick else REGIONS:
        points = np.stack([columns_of(region, _LANES)[name] for name in NAMES], axis=1)
        batch, add = partial(_batch, points), partial(_contender, region)
        own = (1e-9,) if quick else (1e-6, 1e-9, 1e-12)
        found += [add("package, floquet", rtol, partial(batch, partial(_package, rtol))) for rtol in own]
        for rtol in (1e-10,) if quick else (1e-6, 1e-8, 1e-10, 1e-12):
            for forward in (False, True):
                name = f"diffrax Dopri8, {'forward' if forward else 'reverse'} mode"
                found.append(add(name, rtol, partial(batch, partial(_diffrax, rtol, forward))))
            job = partial(differences, region, rtol)
            found.append(add("scipy, central differences", rtol, lambda job=job: job, 1))
        if find_spec("gradsolve") and region == "typical" and not quick:
            found.append(add("gradsolve, tsit5_replay", 1e-10, partial(_gradsolve, points, 1e-10)))
    return found, [] if find_spec("gradsolve") else ["gradsolve is not installed: left out"]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_gradients", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
