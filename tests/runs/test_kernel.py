"""Precision and compiler options."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis.numerics import kernels
from drivetrain_jax.atlas import charts
from drivetrain_jax.runs import kernel
from drivetrain_jax.runs.axes import Grid
from drivetrain_jax.runs.job import Block, Job
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene, result_variables
from drivetrain_jax.runs.work import DIRECT


def test_double_precision():
    assert jax.config.jax_enable_x64 and jnp.ones(1).dtype == jnp.float64


@pytest.fixture
def unset_precision():
    yield lambda: jax.config.update("jax_enable_x64", False)
    jax.config.update("jax_enable_x64", True)


TWO = {
    "system": "tripod",
    "analysis": "parameters",
    "outputs": ["mean_inertia"],
    "axes": {"beta": {"values": [0.1, 0.2]}},
    "fixed": {"element": "input", "zeta": 0.01},
}


def test_double_precision_is_turned_on_again(unset_precision):
    expected = dt.run(TWO).mean_inertia
    unset_precision()
    assert dt.run(TWO).mean_inertia.equals(expected)
    # A context of jax affects only this thread, not the threads that compute.
    unset_precision()
    with jax.enable_x64(True):
        assert dt.run(TWO).mean_inertia.equals(expected)


def test_a_call_within_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(dt.InputError, match="jax_enable_x64 = False"):
        dt.run(TWO)


def test_full_vector_width_only_with_avx512(monkeypatch):
    # Assume the options of jaxlib 0.10; the next test asks another version.
    monkeypatch.setattr(kernels, "compiler_knows", lambda option, value: True)
    monkeypatch.setattr(kernels, "instruction_set", lambda: {"x86_64", "avx2"})
    assert kernels.compiler_options() == {}
    monkeypatch.setattr(kernels, "instruction_set", lambda: {"x86_64", "avx512f"})
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert kernels.compiler_options(march=True) == {}
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    assert kernels.compiler_options() == {"xla_cpu_prefer_vector_width": 512}
    # At full width the compiler needs tens of gigabytes for four lanes (seen with jax 0.10.2).
    assert kernels.compiler_options(4) == {}
    assert kernels.compiler_options(4, march=True) == {"xla_cpu_use_fusion_emitters": False}
    assert kernels.compiler_options(4, short_loops=True) == {"xla_backend_optimization_level": 1}


def test_options_unknown_to_the_compiler_are_left_out(monkeypatch):
    monkeypatch.setattr(kernels.jaxlib, "__version__", "0.99.0")
    kernels.compiler_knows.cache_clear()
    # The installed compiler is asked.
    assert kernels.compiler_knows("xla_backend_optimization_level", 0)
    assert not kernels.compiler_knows("xla_cpu_no_such_option", 1)
    monkeypatch.setattr(kernels, "compiler_knows", lambda option, value: option != "xla_cpu_use_fusion_emitters")
    assert kernels.compiler_options(4, march=True) == {}
    assert set(kernels.options_for_few()) == {"xla_backend_optimization_level"}


def chart(method):
    axes = {"beta": {"start": 0.1, "stop": 1.2, "num": 30}, "Omega": {"start": 0.4, "stop": 2.0, "num": 40}}
    fixed = {"mu": 3.0, "alpha": 2.0, "zeta": 0.001, "gamma": 1.0}
    return {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": fixed, "options": {"method": method}}


GEARS = {
    "system": "planetary",
    "analysis": "modes",
    "axes": {"k_sp": {"start": 1e8, "stop": 1e9, "num": 300}},
    "fixed": {"planet_angle": [0.0, 1.5, 3.1, 4.7]},
}


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(chart("direct"), id="march", marks=pytest.mark.full),
        pytest.param(chart("atlas"), id="tiles", marks=pytest.mark.full),
        pytest.param(GEARS, id="matrices", marks=pytest.mark.full),
    ],
)
def test_an_accelerator_gets_wide_batches_and_gives_the_same_results(monkeypatch, scene):
    """The code path of an accelerator (wide chunks, all lanes at once, no compiler marks) runs on the CPU."""
    expected, solver = dt.run(scene), resolve(load_scene(scene)).solvers[0]
    caches = kernel._compiled, charts.tile_kernel
    with monkeypatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        for cache in caches:
            cache.cache_clear()
        assert resolve(load_scene(scene)).solvers[0].chunk == min(64 * solver.chunk, 1 << 15) > solver.chunk
        found = dt.run(scene)
    for cache in caches:
        cache.cache_clear()
    name = next(iter(expected.data_vars))
    assert float(abs(found[name] - expected[name]).max()) < 1e-10 * float(abs(expected[name]).max())


def test_kernels_with_lapack_calls_take_turns():
    """Two such kernels at a time can block each other forever."""
    scene = load_scene({"system": "toy", "analysis": "toy", "axes": {"a": {"values": [1.0, 2.0]}}})
    for function, waits in ((jnp.linalg.eigvals, True), (jnp.sin, False)):

        def solve(values, effort, function=function):
            matrix = jnp.full((4, 4), values["a"][0])
            return {"value": jnp.sum(jnp.real(function(matrix))), "outcome": jnp.int8(0)}

        solver = replace(scene.solvers[0], solve=solve)
        compiled = kernel.compile_kernel(solver, Grid.of(scene), 2, result_variables(scene))
        assert (compiled.turn is kernel._LAPACK) is waits


def test_scenes_of_few_points_are_compiled_without_optimising(monkeypatch):
    """Scenes of lengthy points and rounds of an atlas are optimised, the latter because later rounds share their kernels."""
    given = []
    monkeypatch.setattr(kernel, "compile_kernel", lambda *of: given.append(of[4]) or object())
    kernel._compiled.cache_clear()
    cases = (
        (128, {}, False),
        (129, {}, False),
        (2, {"lengthy": True}, False),
        (2, {}, True),
        (2, {"unit_cost": 1e5}, False),
    )
    for count, change, full_size in cases:
        scene = load_scene({"system": "toy", "analysis": "toy", "axes": {"a": {"start": 0, "stop": 1, "num": count}}})
        engine = Job(scene, DIRECT, full_size=full_size)
        engine.solvers = tuple(replace(solver, **change) for solver in engine.solvers)
        engine.prepare(engine.plan(Block(0)))
        assert all(future.result() for future in engine._kernels.values())
        kernel._compiled.cache_clear()
    assert given == [True, False, False, False, False]


@pytest.mark.full
def test_other_fixed_numbers_need_no_compilation():
    dt.run(chart("direct"))
    before = kernel._compiled.cache_info().misses
    other = chart("direct") | {"fixed": {"mu": 2.0, "alpha": 1.5, "zeta": 0.002, "gamma": 3.0}}
    found = dt.run(other)
    assert kernel._compiled.cache_info().misses == before
    beta, omega = float(found.beta[7]), float(found.Omega[11])
    point = dt.point("cardan", "floquet", beta=beta, Omega=omega, **other["fixed"])
    assert float(found.spectral_radius[7, 11]) == pytest.approx(point["spectral_radius"].item(), rel=1e-9)


def test_kernels_of_lists_and_paths_are_bounded(monkeypatch):
    """Every fixed list is a constant of its own kernel: 20 lists compile 20, of which the latest stay in memory."""
    made, original = [], kernel.compile_kernel

    def counted(*of):
        found = original(*of)
        made.append(weakref.ref(found.compiled))
        return found

    monkeypatch.setattr(kernel, "compile_kernel", counted)
    kernel._compiled.cache_clear()
    scene = {"system": "toy", "analysis": "toy", "outputs": ["value"], "axes": {"a": {"values": [1.0, 2.0]}}}
    lists = [[float(i), 2.0, 3.0] for i in range(1, 21)]
    for length in (*lists, *lists[-16:]):
        assert dt.run(scene | {"fixed": {"length": length, "b": 1.5 + length[0]}}).value[0] > 0
    gc.collect()
    assert len(made) == len(lists)
    assert sum(each() is not None for each in made) == kernel._KEPT == 16
