"""Counts of work, which are exact where times are not: no count may grow by more than a tenth without a reason.

One scene per system counts traced operations, steps, evaluations, compiled kernels, and written bytes. A change that needs
more must give the reason and store the new number here. A change that needs much less must store its number as well, so
that a later increase is noticed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds import frequency_roots as shaft_roots
from drivetrain_jax.analysis.history import integration as history
from drivetrain_jax.analysis.impacts.piecewise_march import march, prepare, start
from drivetrain_jax.analysis.numerics import singular_values
from drivetrain_jax.runs.job import Block
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems.rattle import PRESETS, Rattle

SCENES: dict[str, dict[str, Any]] = {
    "cardan": {
        "system": "cardan", "analysis": "floquet", "outputs": ["spectral_radius", "verdict"],
        "axes": {"beta": {"start": 0.0, "stop": 1.5, "num": 31}, "Omega": {"start": 0.1, "stop": 2.0, "num": 50}},
        "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}, "options": {"method": "direct"},
    },
    "bicardan": {
        "system": "bicardan", "analysis": "critical_speeds", "outputs": ["natural_frequency"],
        "axes": {"k_A": {"start": 1e6, "stop": 1e9, "num": 24, "scale": "log"}},
        "fixed": {"length": [0.07, 0.59, 0.25], "EI": [64427.0, 22157.0, 8350.0], "rhoA": [15.3, 2.81, 5.51], "k_D": 2e7},
    },
    "planetary": {
        "system": "planetary", "analysis": "modes", "outputs": ["natural_frequency"],
        "axes": {"k_sp": {"start": 1e8, "stop": 1e9, "num": 16}},
        "fixed": {"planet_angle": [0.0, 2 * math.pi / 3, 4 * math.pi / 3]},
    },
    "rattle": {
        "system": "rattle", "analysis": "steady_state", "outputs": ["u_max", "u_min"],
        "axes": {"omega": {"start": 0.3, "stop": 1.5, "num": 16}}, "fixed": PRESETS["table1"],
    },
    "tripod": {
        "system": "tripod", "analysis": "history", "outputs": ["phi"],
        "points": {"zeta": [0.0016]}, "fixed": {"element": "input", "beta": math.radians(9), "chi_n": 0.0026},
        "options": {"stop": 0.01, "num": 11},
    },
}  # fmt: skip
COUNTS = {
    # Operations in the trace of one chunk, nested ones once; results that nobody requests would add to them. 600 of those of
    # cardan are the loop of diffrax.
    "operations cardan": 8226,
    # 500 of those of bicardan eliminate what supports hold: which frequencies are undefined, and the number of modes.
    "operations bicardan": 1397,
    "operations rattle": 4891,
    # Steps that the plan predicts for the 1,550 cells of the chart, padding included.
    "predicted panels cardan": 59_904,
    # One panel, whose nodes come from power series. It is near the limit of rounding, so slightly worse nodes would be
    # rejected.
    "solves cardan, mu = 20": 64,
    # 144 brackets in parallel, 22 steps until the last one is closed.
    "evaluations bicardan": 3168,
    # QR sweeps of two chunks for 18 singular values, each chunk with the sweeps of its slowest lane.
    "sweeps planetary": 27,
    # 16 lanes over ten periods of the drive: 14 steps a period.
    "steps rattle": 2226,
    # 31 strobes, 23 steps each at the tolerance of a default history and 18 in the run that estimates the error.
    "steps tripod": 1294,
    # One kernel, nothing else: shapes, padding and files are NumPy's.
    "compilations bicardan": 1,
    # 1,152 of these bytes are frequencies, the others the scene, units, names and versions.
    "bytes bicardan": 20_691,
}


def complaint(name: str, found: int) -> str:
    """The excess of ``found`` over the stored count in words; empty if it is within bounds."""
    stored = COUNTS[name]
    if found > 1.1 * stored:
        return f"{name}: {found}, stored is {stored}"
    return f"{name}: {found} is so much less than {stored} that it should be stored" if found < 0.7 * stored else ""


def operations(jaxpr: Any) -> int:
    """Equations of a trace, those of nested functions included."""
    inner = (part for equation in jaxpr.eqns for value in equation.params.values()
             for part in (value if isinstance(value, (tuple, list)) else (value,)))  # fmt: skip
    bodies = (getattr(part, "jaxpr", part) for part in inner)
    return len(jaxpr.eqns) + sum(operations(body) for body in bodies if hasattr(body, "eqns"))


@pytest.mark.full
@pytest.mark.parametrize("system", ["cardan", "bicardan", "rattle"])
def test_operations(system):
    engine = resolve(load_scene(SCENES[system]))
    solver = engine.solvers[engine.plan(Block(0))[0].solver]
    columns = {name: jax.ShapeDtypeStruct((8,), float) for name in engine.grid.columns(np.arange(1))}
    traced = jax.make_jaxpr(lambda c, effort: solver.solve(engine.grid.bind(c), effort))(columns, np.int64(1))
    assert not complaint(f"operations {system}", operations(traced.jaxpr))


def test_panels_of_the_chart():
    chunks = resolve(load_scene(SCENES["cardan"])).plan(Block(0))
    assert not complaint("predicted panels cardan", sum(chunk.effort * chunk.size for chunk in chunks))


@pytest.mark.full
def test_solves_of_an_atlas():
    scene = SCENES["cardan"] | {"options": {"method": "atlas", "rtol": 1e-10}}
    scene["fixed"] = scene["fixed"] | {"mu": 20.0}
    assert not complaint("solves cardan, mu = 20", int(dt.run(scene).attrs["atlas_solves"]))


@pytest.fixture
def tally() -> Callable[[Any], None]:
    """A function that adds the amounts reported by a running kernel in ``tally.total``."""

    def add(amount: Any) -> None:
        jax.debug.callback(lambda n: setattr(add, "total", add.total + int(n)), amount)

    add.total = 0
    return add


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """A list of the compiler's events during the test."""
    events: list[str] = []

    def heard(event: str, duration: float, **_: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(heard)
    yield events
    jax.monitoring.unregister_event_duration_listener(heard)


def test_shafts(monkeypatch, tally, compilations, tmp_path):
    """Evaluations of the characteristic function, kernels, and the size of the file."""
    plain = shaft_roots.characteristic

    def counted(shaft, q):
        tally(jnp.int64(q.size))
        return plain(shaft, q)

    monkeypatch.setattr(shaft_roots, "characteristic", counted)
    first = dt.run(SCENES["bicardan"], out=tmp_path / "first.nc", threads=1)
    jax.effects_barrier()
    assert not complaint("evaluations bicardan", tally.total)
    assert not complaint("compilations bicardan", len(compilations))
    assert not complaint("bytes bicardan", (tmp_path / "first.nc").stat().st_size)
    compilations.clear()
    np.testing.assert_array_equal(dt.run(SCENES["bicardan"]).natural_frequency, first.natural_frequency)
    assert not compilations, "a second run compiles again"


@pytest.mark.full
def test_sweeps_of_gears(monkeypatch, tally):
    plain = singular_values._sweep

    def counted(*arguments):
        tally(1)
        return plain(*arguments)

    monkeypatch.setattr(singular_values, "_sweep", counted)
    dt.run(SCENES["planetary"] | {"title": "counted"}, threads=1)
    jax.effects_barrier()
    assert not complaint("sweeps planetary", tally.total)


def test_steps_of_rattle():
    omega = np.linspace(0.3, 1.5, 16)

    @jax.jit
    def steps(omega):
        lanes = prepare(Rattle.models["basins"].build(PRESETS["table1"] | {"omega": omega}))
        return march(lanes, start(lanes, 0 * omega, 0 * omega, jnp.full(16, 10, jnp.int32)), 100_000).steps

    assert not complaint("steps rattle", int(steps(omega).sum()))


@pytest.mark.full
def test_steps_of_a_history(monkeypatch, tally):
    plain = diffrax.diffeqsolve

    def counted(*arguments, **options):
        solution = plain(*arguments, **options)
        tally(solution.stats["num_steps"])
        return solution

    monkeypatch.setattr(history.diffrax, "diffeqsolve", counted)
    dt.run(SCENES["tripod"], threads=1)
    jax.effects_barrier()
    assert not complaint("steps tripod", tally.total)
