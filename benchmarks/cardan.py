"""Contenders on the cardan shaft: its spectral radius, the gradient of it, and its forced motion. One core each.

Points of a region are a shaft and neighbours within 0.5 %. Errors of the spectral radius are those of two points
against 200-bit Taylor series (tests/oracles/cardan_precise_reference.py), which SciPy's DOP853 at 1e-13 confirms (head
of the CSV); against damping, and for the chart, against heyoka at 1e-15. The package and heyoka solve all points at
once, diffrax and the stacked SciPy 64 (Kvaerno5 8), SciPy two, one after the other.

Gradients are by all six parameters, at the first point, relative to the largest component, against complex steps
through DOP853. Rivals integrate the fundamental matrix over the whole period and differentiate the largest modulus of
its eigenvalues: diffrax by reverse and by forward mode, SciPy by central differences.

The forced motion is compared at the start of a period with Newton's method on the map of one period by DOP853 at 1e-13.
Rivals solve by the same Newton's method with SciPy or with diffrax under ``jax.vmap``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.measure import Columns, Job, Judged, Method, Study, judged, near, outcomes, points_job, take
from tests.oracles.cardan_orbit_reference import geometry, linear_field, nonlinear_field
from tests.oracles.cardan_precise_reference import spectral_radius as precise_radius
from tests.oracles.cardan_reference import (
    BASE_CASE,
    NAMES,
    PERIOD,
    from_half_period,
    monodromy,
    spectral_radius,
    stacked_monodromy,
)
from tests.oracles.complex_step import cardan_monodromy, radius_slopes

HEYOKA = find_spec("heyoka") is not None
REGIONS: dict[str, dict[str, float]] = {
    "easy": BASE_CASE | {"beta": 0.2, "Omega": 1.416},
    "typical": BASE_CASE | {"beta": 1.0, "Omega": 0.5},
    "near boundary": BASE_CASE | {"beta": 1.14, "Omega": 0.6695},
    "stiff, zeta 10": BASE_CASE | {"beta": 1.0, "Omega": 0.1, "zeta": 10.0},
    "oscillatory, Omega 0.01": BASE_CASE | {"beta": 1.0, "Omega": 0.01},
    "nearly singular, beta 1.55": BASE_CASE | {"beta": 1.55, "Omega": 1.0},
    "ill-conditioned, gamma 1e16": BASE_CASE | {"beta": 1.0, "Omega": 0.5, "gamma": 1e16},
}
DAMPING = {
    f"zeta = {zeta:g}": BASE_CASE | {"beta": 1.0, "Omega": 0.1, "zeta": zeta} for zeta in (0.1, 10.0, 100.0, 1000.0)
}
MANY, SOME, FEW, CHECKED = 512, 64, 8, 2
RADIUS = ("spectral_radius", "spectral_radius_error", "verdict")


class HeyokaBatch:
    """Monodromy matrices by ``heyoka.taylor_adaptive_batch``, in the fastest form that we found.

    The four columns of the fundamental matrix over half a period are 16 state variables (theta1, theta1', theta2, omega2),
    where omega2 = theta2' + (eta theta1)' is the absolute speed of the second disk. In these variables the equations need
    three products of power series a column and no eta''. Z ~ N0 Phi^T N1 Phi, N = T^T X T with the reversor X of
    docs/theory/cardan.md. Points are grouped so that the lanes of a batch need similar numbers of steps.
    """

    def __init__(self, tolerance: float, batch: int = 8) -> None:
        import heyoka as hy

        self.batch = batch
        # Without force_avx512 LLVM prefers 256-bit registers.
        self.integrator = hy.taylor_adaptive_batch(
            _heyoka_equations(hy), np.zeros((16, batch)), tol=tolerance, compact_mode=False, high_accuracy=False,
            force_avx512=True,
        )  # fmt: skip

    def monodromy(self, columns: Columns) -> np.ndarray:
        """Matrices similar to the monodromy matrices, shape ``(N, 4, 4)``, of columns of shape ``(N,)``."""
        order, width, integrator = _similar_effort(columns), self.batch, self.integrator
        ordered = take(columns, np.concatenate([order, np.repeat(order[-1:], -order.size % width)]))
        p = ordered
        runtime = np.stack([np.cos(p["beta"]), np.sin(p["beta"]) ** 2, 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"],
                            p["alpha"], p["mu"], 1 / p["gamma"]])  # fmt: skip
        start, phi = np.repeat(np.eye(4).reshape(16, 1), width, axis=1), np.empty((16, runtime.shape[1]))
        for first in range(0, runtime.shape[1], width):
            lanes = slice(first, first + width)
            integrator.state[:], integrator.pars[:] = start, runtime[:, lanes]
            integrator.set_time(0.0)
            integrator.propagate_until(np.pi / 2)
            phi[:, lanes] = integrator.state
        out = np.empty((order.size, 4, 4))
        # phi[j, i] is component i of column j.
        out[order] = from_half_period(phi.reshape(4, 4, -1)[..., : order.size], take(columns, order))
        return out


def _heyoka_equations(hy: Any) -> list[tuple[Any, Any]]:
    c, s2, stiffness, damping, alpha, mu, inverse_gamma = (hy.par[i] for i in range(7))
    sine = hy.sin(hy.time)
    eta = c / (1.0 - s2 * sine * sine)
    deta = eta * eta * (s2 / c) * (2.0 * sine * hy.cos(hy.time))
    equations = []
    for j in range(4):
        theta1, rate1, theta2, speed2 = hy.make_vars(*(f"{name}{j}" for name in ("a", "b", "c", "d")))
        rate2 = speed2 - deta * theta1 - eta * rate1
        torque = stiffness * mu * theta2 + damping * alpha * rate2
        equations += [(theta1, rate1), (rate1, eta * torque - damping * rate1 - stiffness * theta1),
                      (theta2, rate2), (speed2, -inverse_gamma * torque)]  # fmt: skip
    return equations


def _similar_effort(p: Columns) -> np.ndarray:
    # Bands of beta (the poles of eta set the step) sorted by the phase of the fast mode over the half period: clearly
    # faster than sorting by the phase alone, hardly slower than sorting by the measured numbers of steps.
    sine = np.sin(p["beta"])
    phase = (1 + np.sqrt(p["mu"]) * np.where(sine > 0, np.arctanh(np.abs(sine)), 0.0)) / p["Omega"]
    return np.lexsort((phase, np.floor(np.abs(p["beta"]) / 0.1)))


heyoka_batch = cache(HeyokaBatch)


def reference_radius(columns: Columns) -> np.ndarray:
    """Spectral radii by heyoka at 1e-15."""
    return spectral_radius(heyoka_batch(1e-15).monodromy(columns))


def columns_of(point: Mapping[str, float], count: int) -> dict[str, np.ndarray]:
    """``count`` shafts, ``point`` first."""
    return near({name: point[name] for name in NAMES}, ("beta", "Omega"), count, 0.005)


def rows_of(columns: Columns, count: int) -> list[dict[str, float]]:
    """The first ``count`` points of ``columns``."""
    return [{name: float(column[i]) for name, column in columns.items()} for i in range(count)]


@cache
def precise(region: str) -> np.ndarray:
    """Spectral radii of the first ``CHECKED`` points of a region."""
    if region in DAMPING:
        return reference_radius(columns_of(DAMPING[region], CHECKED))
    return np.array([float(precise_radius(point)) for point in rows_of(columns_of(REGIONS[region], CHECKED), CHECKED)])


def radius_error(region: str, setting: Any, result: Any) -> Judged:
    """The error of the first radii; the package's bound counts as a notice if it covers an error above the tolerance."""
    package = isinstance(result, Mapping)
    radii, exact = result["spectral_radius"] if package else result, precise(region)
    failed, errors = int(np.sum(~np.isfinite(radii))), np.abs(radii[:CHECKED] - exact)
    error = float(np.nanmax(errors / exact)) if np.isfinite(errors).any() else np.nan
    if package and not (notice := outcomes(result["outcome"])) and not failed:
        bounds = result["spectral_radius_error"][:CHECKED]
        notice = f"bound {np.max(bounds):.0e}" if error > setting and np.all(errors <= bounds) else ""
    else:
        notice = notice if package else ""
    return Judged(error, failed, notice or ("nan" if failed else ""))


def floquet(points: Mapping[str, Mapping[str, float]], method: str, count: int = MANY, **options: Any) -> Any:
    """The package's analysis ``floquet`` as ``prepare`` of a method."""

    def prepare(region: str, rtol: float) -> Job:
        used = {"method": method, "rtol": rtol, **options}
        return points_job("cardan", "floquet", RADIUS, columns_of(points[region], count), options=used)

    return prepare


def heyoka(points: Mapping[str, Mapping[str, float]]) -> Any:
    """heyoka's batch Taylor integrator as ``prepare`` of a method."""

    def prepare(region: str, tolerance: float) -> Job:
        solver, columns = HeyokaBatch(tolerance), columns_of(points[region], MANY)
        return lambda: spectral_radius(solver.monodromy(columns))

    return prepare


def scipy_points(method: str) -> Callable[[str, float], Job]:
    """``solve_ivp`` point by point."""

    def prepare(region: str, rtol: float) -> Job:
        points = rows_of(columns_of(REGIONS[region], CHECKED), CHECKED)
        return lambda: np.array([spectral_radius(monodromy(point, method, rtol, rtol)) for point in points])

    return prepare


def scipy_stacked(region: str, rtol: float) -> Job:
    """``solve_ivp`` with 64 points in one state."""
    columns = columns_of(REGIONS[region], SOME)
    return lambda: spectral_radius(stacked_monodromy(columns, rtol, rtol))


def _two_references(regions: Sequence[str]) -> list[str]:
    apart = (
        spectral_radius(stacked_monodromy(columns_of(REGIONS[name], CHECKED), 1e-13, 1e-13)) / precise(name) - 1
        for name in regions
    )
    apart = zip(regions, apart, strict=True)
    return ["; ".join(f"{n}: DOP853 at 1e-13 differs from the reference by {np.abs(d).max():.0e}" for n, d in apart)]


_SLOW = ("oscillatory, Omega 0.01",)
_FAST = tuple(name for name in REGIONS if name not in _SLOW)


def _diffrax(solver: str, settings: Sequence[float], count: int, quick: Sequence[float] = ()) -> Method:
    return Method(
        f"package, diffrax {solver}", floquet(REGIONS, "diffrax", count=count, solver=solver), count, settings, quick
    )


STUDY = Study(
    "cardan", tuple(REGIONS), ("typical", "ill-conditioned, gamma 1e16"),
    (
        Method("package, direct", floquet(REGIONS, "direct"), MANY, (1e-5, 1e-7, 1e-8, 1e-9, 1e-13), (1e-9,)),
        _diffrax("Tsit5", (1e-5, 1e-9), SOME),
        _diffrax("Dopri5", (1e-5, 1e-9), SOME),
        _diffrax("Dopri8", (1e-6, 1e-10), SOME, (1e-9,)),
        # Tighter tolerances would take minutes a point with implicit methods of order 5.
        _diffrax("Kvaerno5", (1e-6,), FEW),
        Method("scipy RK45", scipy_points("RK45"), CHECKED, (1e-5, 1e-9), (1e-9,)),
        Method("scipy DOP853", scipy_points("DOP853"), CHECKED, (1e-5, 1e-9, 1e-12), (1e-9,)),
        Method("scipy LSODA", scipy_points("LSODA"), CHECKED, (1e-5, 1e-9)),
        Method("scipy Radau", scipy_points("Radau"), CHECKED, (1e-5, 1e-7, 1e-9), regions=_FAST),
        Method("scipy DOP853, stacked", scipy_stacked, SOME, (1e-5, 1e-9, 1e-12), (1e-9,)),
        *([Method("heyoka batch", heyoka(REGIONS), MANY, (1e-5, 1e-7, 1e-8, 1e-9, 1e-11, 1e-13), (1e-9,), "tolerance={:g}")]
          if HEYOKA else []),
    ),
    radius_error, _two_references,
)  # fmt: skip

AGAINST_DAMPING = Study(
    "damping", tuple(DAMPING) if HEYOKA else (), tuple(DAMPING)[:2] if HEYOKA else (),
    (
        Method("package, direct", floquet(DAMPING, "direct"), MANY, (1e-7, 1e-8, 1e-9), (1e-9,)),
        Method("heyoka batch", heyoka(DAMPING), MANY, (1e-7, 1e-8, 1e-9), (1e-9,), "tolerance={:g}"),
    ),
    radius_error,
)  # fmt: skip

# Gradients of the spectral radius.
SLOPES = {
    "easy": BASE_CASE | {"beta": 0.2, "Omega": 1.43},
    "typical": BASE_CASE | {"beta": 1.0, "Omega": 0.52, "zeta": 0.02},
    "damped": BASE_CASE | {"beta": 0.8, "Omega": 0.4, "zeta": 0.5, "gamma": 2.0},
}
_GRADIENT_STEPS = 4096


@cache
def _gradient(region: str) -> np.ndarray:
    return radius_slopes(cardan_monodromy(SLOPES[region], NAMES), SLOPES[region], NAMES)[0]


def gradient_error(region: str, setting: Any, gradients: np.ndarray) -> Judged:
    """The error of the first of ``gradients`` (lanes, 6)."""
    exact = _gradient(region)
    return judged(np.max(np.abs(gradients[0] - exact)) / np.max(np.abs(exact)))


def _shaft(point: Any) -> Any:
    import drivetrain_jax as dt

    return dt.Cardan(**dict(zip(NAMES, point, strict=True)))


def _largest(z: Any) -> Any:
    import jax.numpy as jnp

    return jnp.max(jnp.abs(jnp.linalg.eigvals(z)))


def _points(region: str) -> np.ndarray:
    values = SLOPES[region]
    columns = near({name: values[name] for name in NAMES}, NAMES, SOME, 0.005)
    return np.stack([columns[name] for name in NAMES], axis=1)


@cache
def _compiled_gradient(kind: str, rtol: float) -> Callable[..., Any]:
    import diffrax
    import jax
    import jax.numpy as jnp

    import drivetrain_jax as dt

    def value(point: Any) -> Any:
        shaft = _shaft(point)
        if kind == "package":
            return dt.floquet(shaft, rtol=rtol).spectral_radius
        field = jax.vmap(lambda t, y: shaft.linear_field(t, y) - shaft.linear_field(t, jnp.zeros(4)), in_axes=(None, 0))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: field(t, y)), diffrax.Dopri8(), 0.0, PERIOD, None, jnp.eye(4),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-2 * rtol), max_steps=_GRADIENT_STEPS,
            adjoint=diffrax.ForwardMode() if kind == "forward" else diffrax.RecursiveCheckpointAdjoint(),
        )  # fmt: skip
        return _largest(solution.ys[0].T)

    both = (lambda point: (value(point), jax.jacfwd(value)(point))) if kind == "forward" else jax.value_and_grad(value)
    return jax.jit(jax.vmap(both)).lower(jax.ShapeDtypeStruct((SOME, len(NAMES)), float)).compile()


def gradient(kind: str, region: str, rtol: float) -> Job:
    """Values and gradients of 64 shafts by the package, or by diffrax in reverse or forward mode."""
    run, points = _compiled_gradient(kind, rtol), _points(region)
    return lambda: np.asarray(run(points)[1])


def central_differences(region: str, rtol: float) -> Job:
    """Central differences of SciPy's spectral radius."""
    h, values = rtol ** (1 / 3), SLOPES[region]

    def radius(name: str, sign: int) -> float:
        return float(spectral_radius(monodromy(values | {name: values[name] * (1 + sign * h)}, "DOP853", rtol, rtol)))

    return lambda: np.array([[(radius(name, 1) - radius(name, -1)) / (2 * h * values[name]) for name in NAMES]])


_LADDER = (1e-6, 1e-8, 1e-10, 1e-12)
GRADIENTS = Study(
    "gradients", tuple(SLOPES), ("typical",),
    (
        Method("package, floquet", partial(gradient, "package"), SOME, (1e-6, 1e-9, 1e-12), (1e-9,)),
        Method("diffrax Dopri8, reverse mode", partial(gradient, "reverse"), SOME, _LADDER, (1e-10,)),
        Method("diffrax Dopri8, forward mode", partial(gradient, "forward"), SOME, _LADDER, (1e-10,)),
        Method("scipy, central differences", central_differences, 1, _LADDER, (1e-10,)),
    ),
    gradient_error,
)  # fmt: skip


class Motion(NamedTuple):
    """A shaft, and whether its linear response or its nonlinear orbit is computed."""

    linear: bool
    point: Mapping[str, float]


_DAMPED = BASE_CASE | {"zeta": 0.02, "gamma": 2.0, "beta": 0.4, "Omega": 0.8}
MOTIONS = {
    "linear": Motion(True, _DAMPED),
    "linear, near resonance": Motion(True, _DAMPED | {"Omega": 0.265, "zeta": 1e-4}),
    "linear, stiff, zeta 10": Motion(True, _DAMPED | {"Omega": 0.1, "zeta": 10.0}),
    "orbit": Motion(False, _DAMPED),
    "orbit, large angle": Motion(False, _DAMPED | {"beta": 1.2, "Omega": 1.6, "zeta": 0.1}),
}
_NEWTON, _DIFFERENCE, _MOST_STEPS = 8, 1e-6, 100_000


def scipy_shooting(motion: Motion, rtol: float) -> np.ndarray:
    """The periodic state by Newton's method; the Jacobian by differences, all five motions in one integration."""
    point = geometry(motion.point)
    field, step = (linear_field, 1.0) if motion.linear else (nonlinear_field, _DIFFERENCE)
    y = np.zeros(4) if motion.linear else scipy_shooting(Motion(True, motion.point), 1e-6)

    def stacked(tau: float, states: np.ndarray) -> np.ndarray:
        return np.concatenate([field(tau, state, point) for state in states.reshape(5, 4)])

    for _ in range(1 if motion.linear else _NEWTON):
        starts = np.concatenate([y, *(y + step * unit for unit in np.eye(4))])
        ends = solve_ivp(stacked, (0.0, PERIOD), starts, "DOP853", rtol=rtol, atol=1e-2 * rtol).y[:, -1].reshape(5, 4)
        move = np.linalg.solve(np.eye(4) - (ends[1:] - ends[0]).T / step, ends[0] - y)
        y = y + move
        if np.abs(move).max() <= 10 * rtol * np.abs(y).max():
            break
    return y


@cache
def _periodic_state(region: str) -> np.ndarray:
    return scipy_shooting(MOTIONS[region], 1e-13)


def motion_error(region: str, setting: Any, state: np.ndarray, notice: str = "") -> Judged:
    """The error of ``state``."""
    exact = _periodic_state(region)
    return judged(np.max(np.abs(state - exact)) / np.max(np.abs(exact)), notice)


def _state(region: str) -> str:
    return "periodic_state" if MOTIONS[region].linear else "orbit_state"


def forced(region: str, rtol: float) -> Job:
    """The analysis ``forced``."""
    columns, state = columns_of(MOTIONS[region].point, SOME), _state(region)
    return points_job("cardan", "forced", [state, f"{state}_error"], columns, options={"rtol": rtol})


def forced_error(region: str, rtol: float, results: Mapping[str, np.ndarray]) -> Judged:
    """The error of the package; its bound counts as a notice if it holds and is above the tolerance."""
    state, bound = (results[name][0] for name in (_state(region), f"{_state(region)}_error"))
    honest = np.all(np.abs(state - _periodic_state(region)) <= bound) and np.max(bound) > rtol * np.max(np.abs(state))
    notice = outcomes(results["outcome"][:1]) or (f"error {np.max(bound):.0e}" if honest else "")
    return motion_error(region, rtol, state, notice)


@cache
def _compiled_shooting(linear: bool) -> Callable[..., Any]:
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

        def going(carry: tuple[Any, Any, Any]) -> Any:
            y, move, count = carry
            return (count < _NEWTON) & (move > 10 * rtol * jnp.max(jnp.abs(y)))

        def step(carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            y, _, count = carry
            new = newton(y, partial(flow, values, rtol, False))
            return new, jnp.max(jnp.abs(new - y)), count + 1

        return jax.lax.while_loop(going, step, (y, jnp.inf, 0))[0]

    kinds = {name: jax.ShapeDtypeStruct((FEW,), float) for name in NAMES}
    return jax.jit(jax.vmap(one, in_axes=(0, None))).lower(kinds, jax.ShapeDtypeStruct((), float)).compile()


def diffrax_shooting(region: str, rtol: float) -> Job:
    """Newton's method with diffrax, as a JAX user would write it."""
    columns, compiled = columns_of(MOTIONS[region].point, FEW), _compiled_shooting(MOTIONS[region].linear)
    return lambda: np.asarray(compiled(columns, rtol))[0]


def _looser_reference(regions: Sequence[str]) -> list[str]:
    apart = ((name, motion_error(name, None, scipy_shooting(MOTIONS[name], 1e-11)).error) for name in regions)
    return ["; ".join(f"{name}: DOP853 at 1e-11 differs from the reference by {error:.0e}" for name, error in apart)]


FORCED = Study(
    "forced", tuple(MOTIONS), ("linear", "orbit"),
    (
        Method("package, shooting", forced, SOME, (1e-6, 1e-9, 1e-12), (1e-9,), error=forced_error),
        Method("diffrax Dopri8, shooting", diffrax_shooting, FEW, _LADDER, (1e-10,)),
        Method("scipy DOP853, shooting", lambda region, rtol: partial(scipy_shooting, MOTIONS[region], rtol), 1, _LADDER,
               (1e-10,)),
    ),
    motion_error, _looser_reference,
)  # fmt: skip
