"""Error against run time for the forced motion of the cardan shaft: the linear response and the nonlinear orbit.

    python -m benchmarks.precision_forced [--quick] [--out FOLDER]     # precision_forced.csv and .png

A region is a point (beta, Omega), its neighbours within 0.5 %, and one of the two motions. The error is that of the state at
the start of a period at the first point, relative to its largest component. The reference is Newton's method on the map of
one period with SciPy's DOP853 at 1e-13; the head of the CSV tells its distance from the same at 1e-11. The package solves
64 points at once, with an estimate of the error. Rivals, without one: the same Newton's method with SciPy (the state and the
columns of the Jacobian in one integration) and with diffrax under ``jax.vmap`` (Jacobian by forward mode), and collocation
by SciPy's ``solve_bvp``. The linear response starts every rival's search for the nonlinear orbit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from benchmarks.timing import once
from tests.oracles.cardan_orbit_reference import geometry, linear_field, nonlinear_field
from tests.oracles.cardan_reference import BASE_CASE, NAMES, PERIOD


class Region(NamedTuple):
    """A point, and whether its linear response is asked for."""

    linear: bool
    point: Mapping[str, float]


_DAMPED = BASE_CASE | {"zeta": 0.02, "gamma": 2.0, "beta": 0.4, "Omega": 0.8}
REGIONS = {
    "linear": Region(True, _DAMPED),
    "linear, near resonance": Region(True, _DAMPED | {"Omega": 0.265, "zeta": 1e-4}),
    "linear, stiff, zeta 10": Region(True, _DAMPED | {"Omega": 0.1, "zeta": 10.0}),
    "orbit": Region(False, _DAMPED),
    "orbit, large angle": Region(False, _DAMPED | {"beta": 1.2, "Omega": 1.6, "zeta": 0.1}),
}
_QUICK = ("linear", "orbit")
_LANES, _DIFFRAX_LANES = 64, 8
_MOST_STEPS, _NEWTON, _DIFFERENCE = 100_000, 8, 1e-6


def columns_of(region: str, count: int) -> dict[str, np.ndarray]:
    """``count`` points of the region, its centre first."""
    rng = np.random.default_rng(0)
    near = {name: np.r_[1.0, rng.uniform(0.995, 1.005, count - 1)] for name in ("beta", "Omega")}
    return {name: REGIONS[region].point[name] * near.get(name, np.ones(count)) for name in NAMES}


def scipy_shooting(region: Region, rtol: float) -> np.ndarray:
    """The periodic state by Newton's method; the Jacobian by differences, all five motions in one integration."""
    point = geometry(region.point)
    field, step = (linear_field, 1.0) if region.linear else (nonlinear_field, _DIFFERENCE)
    y = np.zeros(4) if region.linear else scipy_shooting(Region(True, region.point), 1e-6)

    def stacked(tau: float, states: np.ndarray) -> np.ndarray:
        return np.concatenate([field(tau, state, point) for state in states.reshape(5, 4)])

    for _ in range(1 if region.linear else _NEWTON):
        starts = np.concatenate([y, *(y + step * unit for unit in np.eye(4))])
        ends = solve_ivp(stacked, (0.0, PERIOD), starts, "DOP853", rtol=rtol, atol=1e-2 * rtol).y[:, -1].reshape(5, 4)
        move = np.linalg.solve(np.eye(4) - (ends[1:] - ends[0]).T / step, ends[0] - y)
        y = y + move
        if np.abs(move).max() <= 10 * rtol * np.abs(y).max():
            break
    return y


@cache
def reference(region: str) -> np.ndarray:
    """The periodic state."""
    return scipy_shooting(REGIONS[region], 1e-13)


def error_of(region: str, state: np.ndarray, notice: str = "") -> Judged:
    """The error of ``state``."""
    exact = reference(region)
    error = float(np.max(np.abs(state - exact)) / np.max(np.abs(exact)))
    return Judged(error, 0, notice) if math.isfinite(error) else Judged(math.nan, 1, notice or "nan")


def package(region: str, rtol: float) -> Contender:
    """The analysis ``forced``."""
    state = "periodic_state" if REGIONS[region].linear else "orbit_state"
    outputs = [state, f"{state}_error"]
    scene = columns_scene("cardan", "forced", outputs, columns_of(region, _LANES), options={"rtol": rtol})

    def judged(results: Mapping[str, np.ndarray]) -> Judged:
        found, bound = results[state][0], results[f"{state}_error"][0]
        notice = told(results["outcome"][:1])
        honest = np.all(np.abs(found - reference(region)) <= bound) and np.max(bound) > rtol * np.max(np.abs(found))
        return error_of(region, found, notice or (f"error {np.max(bound):.0e}" if honest else ""))

    return Contender(
        "forced", region, "package, shooting", f"rtol={rtol:g}", _LANES, partial(engine_job, scene), judged
    )


@once
def _with_diffrax(linear: bool) -> Callable[..., Any]:
    import diffrax
    import jax
    import jax.numpy as jnp

    from drivetrain_jax.systems.cardan import Cardan

    def flow(values: Mapping[str, Any], rtol: Any, linear_field: bool, y: Any) -> Any:
        shaft = Cardan.of(values)
        field = shaft.linear_field if linear_field else shaft.vector_field
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: field(t, y)), diffrax.Dopri8(), 0.0, PERIOD, None, y,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-2 * rtol), max_steps=_MOST_STEPS,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys[0], jnp.nan)

    def one(values: Mapping[str, Any], rtol: Any) -> Any:
        def newton(y: Any, through: Callable[[Any], Any]) -> Any:
            return y + jnp.linalg.solve(jnp.eye(4) - jax.jacfwd(through)(y), through(y) - y)

        y = newton(jnp.zeros(4), partial(flow, values, rtol, True))
        if linear:
            return y

        def going(state: tuple[Any, Any, Any]) -> Any:
            y, move, count = state
            return (count < _NEWTON) & (move > 10 * rtol * jnp.max(jnp.abs(y)))

        def step(state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            y, _, count = state
            new = newton(y, partial(flow, values, rtol, False))
            return new, jnp.max(jnp.abs(new - y)), count + 1

        return jax.lax.while_loop(going, step, (y, jnp.inf, 0))[0]

    kinds = {name: jax.ShapeDtypeStruct((_DIFFRAX_LANES,), float) for name in NAMES}
    return jax.jit(jax.vmap(one, in_axes=(0, None))).lower(kinds, jax.ShapeDtypeStruct((), float)).compile()


def by_diffrax(region: str, rtol: float) -> Contender:
    """Newton's method with diffrax, as a JAX user would write it."""
    columns = columns_of(region, _DIFFRAX_LANES)

    def prepare() -> Callable[[], np.ndarray]:
        compiled = _with_diffrax(REGIONS[region].linear)
        return lambda: np.asarray(compiled(columns, rtol))[0]

    judged = partial(error_of, region)
    return Contender("forced", region, "diffrax Dopri8, shooting", f"rtol={rtol:g}", _DIFFRAX_LANES, prepare, judged)


def collocation(region: str, tol: float) -> np.ndarray:
    """The periodic state by ``solve_bvp``."""
    linear, point = REGIONS[region]
    values, field = geometry(point), linear_field if linear else nonlinear_field
    start = np.zeros(4) if linear else scipy_shooting(Region(True, point), 1e-6)
    times = np.linspace(0.0, PERIOD, 65)
    solution = solve_ivp(field, (0.0, PERIOD), start, "DOP853", t_eval=times, args=(values,), rtol=1e-6, atol=1e-8)

    def columns(tau: np.ndarray, states: np.ndarray) -> np.ndarray:
        return np.stack([field(t, y, values) for t, y in zip(tau, states.T, strict=True)], axis=1)

    found = solve_bvp(columns, lambda a, b: a - b, times, solution.y, tol=tol, max_nodes=20_000)
    return found.y[:, 0] if found.success else np.full(4, np.nan)


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions, and the distance of two references."""
    found, distances = [], []
    for region in _QUICK if quick else REGIONS:
        judged = partial(error_of, region)
        found += [package(region, rtol) for rtol in ((1e-9,) if quick else (1e-6, 1e-9, 1e-12))]
        found += [by_diffrax(region, rtol) for rtol in ((1e-10,) if quick else (1e-6, 1e-8, 1e-10, 1e-12))]
        for rtol in (1e-10,) if quick else (1e-6, 1e-8, 1e-10, 1e-12):
            job = partial(scipy_shooting, REGIONS[region], rtol)
            found.append(
                Contender("forced", region, "scipy DOP853, shooting", f"rtol={rtol:g}", 1, lambda job=job: job, judged)
            )
        for tol in () if quick else (1e-4, 1e-7):
            job = partial(collocation, region, tol)
            found.append(Contender("forced", region, "scipy solve_bvp", f"tol={tol:g}", 1, lambda job=job: job, judged))
        apart = error_of(region, scipy_shooting(REGIONS[region], 1e-11)).error
        distances.append(f"{region}: DOP853 at 1e-11 differs from the reference by {apart:.0e}")
    return found, ["; ".join(distances)]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_forced", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
