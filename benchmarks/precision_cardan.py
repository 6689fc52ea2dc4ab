"""Error against run time for the spectral radius of the cardan shaft, from easy to nearly singular points.

    python -m benchmarks.precision_cardan [--quick] [--out FOLDER]     # precision_cardan.csv and .png

A region is a point (beta, Omega) and a grid of 16 x 32 neighbours within 0.5 %. The error is the larger one of the centre
and a corner against 200-bit Taylor series (tests/oracles/cardan_precise_reference.py), which SciPy's DOP853 at 1e-13
confirms (head of the CSV). Every method runs on one core. The package and heyoka solve the whole grid, diffrax and the
stacked SciPy 64 of its points (Kvaerno5 8), and SciPy point by point the two compared points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from benchmarks.timing import once, take
from tests.oracles.cardan_precise_reference import spectral_radius as precise_radius
from tests.oracles.cardan_reference import BASE_CASE, NAMES, monodromy, spectral_radius, stacked_monodromy

Columns = dict[str, np.ndarray]
REGIONS: dict[str, dict[str, float]] = {
    "easy": BASE_CASE | {"beta": 0.2, "Omega": 1.416},
    "typical": BASE_CASE | {"beta": 1.0, "Omega": 0.5},
    "near boundary": BASE_CASE | {"beta": 1.14, "Omega": 0.6695},
    "stiff, zeta 10": BASE_CASE | {"beta": 1.0, "Omega": 0.1, "zeta": 10.0},
    "oscillatory, Omega 0.01": BASE_CASE | {"beta": 1.0, "Omega": 0.01},
    "nearly singular, beta 1.55": BASE_CASE | {"beta": 1.55, "Omega": 1.0},
    "ill-conditioned, gamma 1e16": BASE_CASE | {"beta": 1.0, "Omega": 0.5, "gamma": 1e16},
}
# Points of the grid in beta x Omega, as many as a chunk of the package has lanes, and its relative width.
SHAPE, WIDTH = (16, 32), 0.005
SIZE = SHAPE[0] * SHAPE[1]
CENTRE = SHAPE[0] // 2 * SHAPE[1] + SHAPE[1] // 2
CHECKED, FEW, SOME = 2, 8, 64
OUTPUTS = ["spectral_radius", "spectral_radius_error", "verdict"]
_SLOW = ("stiff, zeta 10", "oscillatory, Omega 0.01")
_QUICK = ("typical", "ill-conditioned, gamma 1e16")
IMPLICIT = "Kvaerno5"
SOLVERS = ("Tsit5", "Dopri5", "Dopri8", IMPLICIT)
STEPS = (32, 256, 2048)


def axes(region: str) -> dict[str, np.ndarray]:
    """The values of beta and Omega."""
    around = (1 + WIDTH * (np.arange(count) / (count // 2) - 1) for count in SHAPE)
    return {name: REGIONS[region][name] * factors for name, factors in zip(("beta", "Omega"), around, strict=True)}


def columns_of(region: str, count: int = SIZE) -> Columns:
    """``count`` points of the grid, the centre and a corner first."""
    grid = np.meshgrid(*axes(region).values(), indexing="ij")
    rest = np.setdiff1d(np.arange(SIZE), (0, CENTRE))
    order = np.r_[CENTRE, 0, np.random.default_rng(0).permutation(rest)]
    points = {"beta": grid[0].ravel(), "Omega": grid[1].ravel()}
    fixed = {name: np.full(SIZE, value) for name, value in REGIONS[region].items() if name not in points}
    return take(points | fixed, order[:count])


@cache
def reference(region: str) -> np.ndarray:
    """Spectral radii of the first ``CHECKED`` points."""
    columns = columns_of(region, CHECKED)
    points = [{name: float(columns[name][i]) for name in NAMES} for i in range(CHECKED)]
    return np.array([float(precise_radius(point)) for point in points])


def error_of(region: str, radii: np.ndarray, notice: str = "") -> Judged:
    """The error of the first points of ``radii``; points without a number count as failed."""
    failed = int(np.sum(~np.isfinite(radii)))
    remark = notice or ("nan" if failed else "")
    errors = np.abs(radii[:CHECKED] / reference(region) - 1)
    return Judged(float(np.nanmax(errors)) if np.isfinite(errors).any() else np.nan, failed, remark)


def package_error(region: str, rtol: float, results: Mapping[str, np.ndarray]) -> Judged:
    """The error of a result of the package; notices are outcomes, and bounds that cover an error above ``rtol``."""
    radii, bounds = results["spectral_radius"], results["spectral_radius_error"]
    judged = error_of(region, radii, told(results["outcome"]))
    errors = np.abs(radii - np.pad(reference(region), (0, len(radii) - CHECKED), constant_values=np.nan))[:CHECKED]
    covered = bool(np.all(errors <= bounds[:CHECKED]))
    if not judged.noticed and judged.error > rtol and covered:
        return judged._replace(noticed=f"bound {np.max(bounds[:CHECKED]):.0e}")
    return judged


def package(region: str, method: str, rtol: float, count: int = SIZE, **options: Any) -> Contender:
    """A method of the package for single points."""
    scene = columns_scene(
        "cardan", "floquet", OUTPUTS, columns_of(region, count), options={"method": method, "rtol": rtol, **options}
    )
    name = f"package, diffrax {options['solver']}" if options else f"package, {method}"
    judged = partial(package_error, region, rtol)
    return Contender("cardan", region, name, f"rtol={rtol:g}", count, partial(engine_job, scene), judged)


def atlas(region: str, rtol: float) -> Contender:
    """The atlas of the region's box, built and evaluated on its grid."""
    scene = {
        "system": "cardan", "analysis": "floquet", "outputs": OUTPUTS,
        "axes": {name: {"values": values.tolist()} for name, values in axes(region).items()},
        "fixed": {name: value for name, value in REGIONS[region].items() if name not in ("beta", "Omega")},
        "options": {"method": "atlas", "rtol": rtol},
    }  # fmt: skip

    def prepare() -> Callable[[], Any]:
        import drivetrain_jax as dt

        dt.run(scene, threads=1)
        return lambda: dt.run(scene, threads=1)

    def judged(result: Any) -> Judged:
        flat = {name: result[name].values.ravel() for name in (*OUTPUTS, "outcome")}
        first = np.r_[CENTRE, 0, np.setdiff1d(np.arange(SIZE), (0, CENTRE))]
        return package_error(region, rtol, {name: values[first] for name, values in flat.items()})

    return Contender("cardan", region, "package, atlas", f"rtol={rtol:g}", SIZE, prepare, judged)


def constant_steps(region: str, solver: str, steps: int) -> Contender:
    """diffrax on the equations as published, over the whole period, with equal steps."""
    count = FEW if solver == IMPLICIT else SOME
    columns = columns_of(region, count)

    def prepare() -> Callable[[], np.ndarray]:
        compiled = _constant(solver, count)
        return lambda: spectral_radius(np.asarray(compiled(columns, np.pi / steps)))

    judged = partial(error_of, region)
    return Contender("cardan", region, f"diffrax {solver}, constant", f"steps={steps}", count, prepare, judged)


@once
def _constant(solver: str, count: int) -> Callable[[Columns, float], Any]:
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix

    from drivetrain_jax.analysis.floquet.diffrax_solvers import diffrax_propagator
    from drivetrain_jax.analysis.floquet.propagator import EqualStepSize
    from drivetrain_jax.systems.cardan import Cardan

    # Without a step size controller the root finder of an implicit scheme needs tolerances of its own. The default chord
    # method of diffrax fails at these, because its slope is that of another time.
    settings = {"root_finder": optimistix.Newton(rtol=1e-10, atol=1e-12)} if solver == IMPLICIT else {}

    def one(values: Mapping[str, Any], step: Any) -> Any:
        form = Cardan.of(values).floquet_model().natural
        steps = EqualStepSize(jnp.round(np.pi / step).astype(int))
        return diffrax_propagator(form, getattr(diffrax, solver)(**settings), stepsize_controller=steps)[0]

    kinds = {name: jax.ShapeDtypeStruct((count,), float) for name in NAMES}
    return jax.jit(jax.vmap(one, in_axes=(0, None))).lower(kinds, jax.ShapeDtypeStruct((), float)).compile()


def scipy_points(region: str, method: str, rtol: float) -> Contender:
    """``solve_ivp`` point by point."""
    columns = columns_of(region, CHECKED)
    points = [{name: columns[name][i] for name in NAMES} for i in range(CHECKED)]

    def job() -> np.ndarray:
        return np.array([spectral_radius(monodromy(point, method, rtol, rtol)) for point in points])

    return Contender(
        "cardan", region, f"scipy {method}", f"rtol={rtol:g}", CHECKED, lambda: job, partial(error_of, region)
    )


def scipy_stacked(region: str, rtol: float) -> Contender:
    """``solve_ivp`` with 64 points in one state."""
    columns = columns_of(region, SOME)

    def job() -> np.ndarray:
        return spectral_radius(stacked_monodromy(columns, rtol, rtol))

    judged = partial(error_of, region)
    return Contender("cardan", region, "scipy DOP853, stacked", f"rtol={rtol:g}", SOME, lambda: job, judged)


def heyoka_batch(region: str, tolerance: float) -> Contender:
    """heyoka's batch Taylor integrator in its best form."""
    columns = columns_of(region)

    def prepare() -> Callable[[], np.ndarray]:
        from benchmarks.peers import HeyokaBatch

        solver = HeyokaBatch("half", tolerance, 8)
        return lambda: spectral_radius(solver.monodromy(columns))

    judged = partial(error_of, region)
    return Contender("cardan", region, "heyoka batch", f"tolerance={tolerance:g}", SIZE, prepare, judged)


def tolerances(region: str, method: str, quick: bool) -> tuple[float, ...]:
    """The tolerances of an integrator; tighter ones would take minutes a point with implicit methods of order 5."""
    if quick:
        return (1e-9,)
    if method == IMPLICIT:
        return (1e-6,) if region == _SLOW[1] else (1e-6, 1e-9)
    if method == "Radau":
        return (1e-3, 1e-5) if region == _SLOW[1] else (1e-5, 1e-7, 1e-9)
    return (1e-5, 1e-9, 1e-12) if method == "DOP853" else (1e-6, 1e-10) if method == "Dopri8" else (1e-5, 1e-9)


def contenders_of(region: str, quick: bool) -> list[Contender]:
    """All methods in one region."""
    found = [package(region, "direct", rtol) for rtol in ((1e-9,) if quick else (1e-5, 1e-9, 1e-13))]
    found += [atlas(region, rtol) for rtol in ((1e-9,) if quick else (1e-7, 1e-9))]
    for solver in ("Dopri8",) if quick else SOLVERS:
        count = FEW if solver == IMPLICIT else SOME
        found += [package(region, "diffrax", r, count, solver=solver) for r in tolerances(region, solver, quick)]
    for solver in ("Dopri8",) if quick else SOLVERS:
        found += [constant_steps(region, solver, steps) for steps in ((256,) if quick else STEPS)]
    for method in ("RK45", "DOP853") if quick else ("RK45", "DOP853", "LSODA", "Radau"):
        found += [scipy_points(region, method, rtol) for rtol in tolerances(region, method, quick)]
    found += [scipy_stacked(region, rtol) for rtol in tolerances(region, "DOP853", quick)]
    if find_spec("heyoka"):
        found += [heyoka_batch(region, t) for t in ((1e-9,) if quick else (1e-5, 1e-7, 1e-9, 1e-11, 1e-13))]
    return found


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions, and the difference of the two references."""
    regions = _QUICK if quick else tuple(REGIONS)
    notes = [
        "; ".join(f"{region}: DOP853 at 1e-13 differs from the reference by {_apart(region):.0e}" for region in regions)
    ]
    if not find_spec("heyoka"):
        notes.append("heyoka is not installed: left out")
    return [contender for region in regions for contender in contenders_of(region, quick)], notes


def _apart(region: str) -> float:
    independent = spectral_radius(stacked_monodromy(columns_of(region, CHECKED), 1e-13, 1e-13))
    return float(np.abs(independent / reference(region) - 1).max())


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_cardan", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
