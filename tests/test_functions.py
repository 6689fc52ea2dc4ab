"""The analyses as pure functions: the same numbers as scenes, under transformations as well, and their derivatives."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax import systems
from drivetrain_jax.analyses import Result, _tangents
from drivetrain_jax.analysis import OUTCOME, Outcome, get_analysis
from drivetrain_jax.analysis._base import make_request
from drivetrain_jax.analysis.floquet import propagator
from drivetrain_jax.invariants import check
from drivetrain_jax.runs import kernel
from drivetrain_jax.runs.kernel import compile_kernel, result_variables
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.systems import (
    Component,
    Flow,
    LinearPeriodic,
    Smoothness,
    System,
    Variable,
    get_system,
    parameter,
    serves,
)
from tests.sizes import but_full

BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
SHAFT = dt.Cardan(beta=0.3, Omega=1.416, **BASE)


GEARS = dt.Rattle(omega=0.7, **dt.Rattle.presets["table1"])
TRIPOD = dt.Tripod(element="input", beta=0.157, zeta=0.0016, chi_n=0.3)

CASES = {
    "cardan floquet": (dt.floquet, SHAFT, "beta", np.linspace(0.05, 1.4, 37), 1e-11),
    "tripod floquet": (dt.floquet, TRIPOD, "excitation_frequency", np.linspace(2000.0, 4000.0, 5), 1e-11),
    "cardan forced": (dt.forced, SHAFT, "Omega", np.linspace(0.9, 1.1, 3), 1e-9),
    "tripod history": (lambda s, **o: dt.history(s, times=(1e-4, 1e-3), **o), TRIPOD, "zeta", [0.001, 0.01], 1e-9),
    "bicardan critical_speeds": (
        dt.critical_speeds, dt.Bicardan(**dt.Bicardan.presets["paper"]), "k_A", [1e7, 85e6, 1e9], 1e-12
    ),
    "planetary modes": (dt.modes, dt.Planetary(), "k_p", [5e7, 1e8, 2e8], 1e-9),
    "rattle steady_state": (dt.steady_state, GEARS, "omega", [0.6, 0.7, 0.9], 1e-9),
}  # fmt: skip


def replaced(system, name, value):
    return type(system).of(system.values | {name: value})


@pytest.mark.full
@pytest.mark.parametrize("case", CASES)
def test_a_batch_equals_the_loop_and_the_sweep(case):
    function, system, name, values, rtol = CASES[case]
    batch = jax.vmap(lambda x: replaced(system, name, x))(jnp.asarray(values))
    found = jax.jit(jax.vmap(function))(batch)
    alone = [function(replaced(system, name, float(x))) for x in (values[0], values[-1])]
    own = case.split()[1]
    options = {"times": [1e-4, 1e-3]} if own == "history" else {}
    swept = dt.sweep(getattr(dt, own), system, over={name: values}, **options)
    for key in found:
        together = np.asarray(found[key])
        scale = np.abs(together).max() if together.dtype.kind in "fc" else 1
        if not key.endswith("_error"):
            np.testing.assert_allclose(together, swept[key].values, rtol=rtol, atol=rtol * scale)
            for one, lane in zip(alone, (together[0], together[-1]), strict=True):
                np.testing.assert_allclose(one[key], lane, rtol=rtol, atol=rtol * scale)


@pytest.mark.full
def test_nested_batches_are_one():
    betas, speeds = jnp.linspace(0.1, 1.2, 3), jnp.linspace(0.5, 1.5, 4)

    def radius(beta, Omega):
        return dt.floquet(dt.Cardan(beta=beta, Omega=Omega, **BASE)).spectral_radius

    nested = jax.vmap(lambda b: jax.vmap(lambda s: radius(b, s))(speeds))(betas)
    for i, beta in enumerate(betas):
        np.testing.assert_allclose(nested[i], jax.vmap(lambda s, b=beta: radius(b, s))(speeds), rtol=1e-11)


SYSTEMS = {
    "cardan": SHAFT, "tripod": TRIPOD, "rattle": GEARS, "planetary": dt.Planetary(),
    "bicardan": dt.Bicardan(**dt.Bicardan.presets["paper"]),
}  # fmt: skip
# Results that the system, or the method that is used here, does not have.
ABSENT = {
    "cardan floquet": ["floquet_exponent"],
    "rattle history": ["amplitude", "phase"],
    "rattle frequency_response": ["residual", "peak_amplitude", "peak_frequency", "backbone_amplitude", "fit_range"],
}
OPTIONS = {
    "history": {"stop": 1e-3, "num": 5}, "critical_speeds": {"operating_max": 3000.0}, "modes": {"track": "k_p"},
    "harmonic_response": {"stop": 1e3, "num": 5},
}  # fmt: skip


SLOW = (
    *(
        "cardan forced",
        "cardan history",
        "cardan lyapunov",
        "cardan frequency_response",
        "tripod history",
        "tripod lyapunov",
    ),
    *(
        "tripod poincare",
        "rattle frequency_response",
        "bicardan critical_speeds",
        "planetary harmonic_response",
        "planetary modes",
        "rattle basins",
        "tripod floquet",
    ),
)


@pytest.mark.parametrize(
    "case", but_full([f"{s} {a}" for s in SYSTEMS for a in get_system(s).models if a in dt.__all__], *SLOW)
)
def test_results_have_the_declared_shapes_and_types(case):
    """Of a batch of three; dimensions of one name have one length, that of their coordinate if there is one."""
    kind, name = case.split()
    system, options = SYSTEMS[kind], OPTIONS.get(name, {})
    analysis = get_analysis(name).for_system(type(system))
    if path := analysis.path_axis(type(system), make_request(type(system), analysis, None, options)):
        system = replaced(system, path, np.linspace(0.5, 0.9, 4) * system.values[path])
    outputs = [v.name for v in analysis.variables if v.name not in ABSENT.get(case, [])]
    request = make_request(type(system), analysis, outputs, options)
    own = {d.name: len(d.values) or d.name for d in analysis.dimensions(type(system), request, system.values)}
    swept = next(n for n, x in system.values.items() if isinstance(x, float) and n != path)
    found = jax.eval_shape(
        jax.vmap(lambda x: getattr(dt, name)(replaced(system, swept, x), outputs=outputs, **options)), jnp.ones(3)
    )
    assert outputs and set(found) == {*outputs, "outcome"}
    with jaxtyping.jaxtyped("context"):
        for variable in (*map(analysis.variable, outputs), OUTCOME):
            dims = " ".join(["3", *(["4"] if path else []), *(str(own[d]) for d in variable.dims)])
            declared = getattr(jaxtyping, variable.dtype.capitalize())[jax.ShapeDtypeStruct, dims]
            assert isinstance(found[variable.name], declared), (variable, found[variable.name])


def calls_of_diffeqsolve(monkeypatch, scene) -> list[bool]:
    """For every solver of a scene: whether the term that diffrax is given is batched by vmap."""
    calls, original = [], diffrax.diffeqsolve

    def watched(terms, *given, **more):
        calls.append(any("Batch" in type(x).__name__ for x in jax.tree.leaves(terms)))
        return original(terms, *given, **more)

    monkeypatch.setattr(propagator.diffrax, "diffeqsolve", watched)
    engine = resolve(load_scene(scene))
    for solver in engine.solvers:
        before = len(calls)
        compile_kernel(solver, engine.grid, 16, result_variables(engine.scene), few=True)
        assert len(calls) > before
    return calls


@pytest.mark.parametrize("analysis", [pytest.param("floquet", marks=pytest.mark.full), "atlas"])
def test_diffrax_under_vmap_is_the_engine(monkeypatch, analysis):
    """Of charts, and of the nodes that an atlas solves directly."""
    axes = {"beta": {"start": 0.1, "stop": 1.0}, "Omega": {"start": 0.5, "stop": 1.0}}
    if analysis == "floquet":
        axes = {name: axis | {"num": 8} for name, axis in axes.items()}
        scene = {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": BASE}
        assert all(calls_of_diffeqsolve(monkeypatch, scene))
    else:
        calls, original = [], diffrax.diffeqsolve
        monkeypatch.setattr(propagator.diffrax, "diffeqsolve", lambda *a, **k: calls.append(1) or original(*a, **k))
        # What another test has traced is not traced again.
        kernel._compiled.cache_clear()
        jax.clear_caches()
        dt.run({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": BASE})
        assert calls


def swept(function, over=None, **options):
    """A sweep of ``function`` over entries of a dict, by default of ``a``."""
    return dt.sweep(
        function, {"a": 1.0, "k": jnp.arange(3.0), "l": [1.0, 2.0]}, over=over or {"a": [0.0, 0.5]}, **options
    )


def declared(units="1", roles=(), model=None, **serving):
    """A new system with the parameter ``omega``."""
    own = {"name": "own", "title": "own", "__annotations__": {"omega": float}, "roles": dict(roles)}

    def build(self):
        return model

    build = serves("floquet", **serving)(build)
    return type("Own", (System,), own | {"omega": parameter(units, "speed"), "build": build})


def named(parameter_name):
    """A new system with one parameter of this name."""
    own = {"name": "own", "title": "own", "__annotations__": {parameter_name: float}}
    return type("Own", (System,), own | {parameter_name: parameter("1", "any")})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: declared(units="N/furlong"), "Own.omega: units = 'N/furlong'; expected 1 or units such as"),
        (lambda: declared(roles={"speed": "omeg"}), r"Own: roles\['speed'\]: 'omeg' is not a parameter "),
        (lambda: declared(smooth=Smoothness({"kk": None})), "Own: smooth of floquet: 'kk' is not a parameter"),
        (lambda: dt.floquet(declared()(omega=1.0)), "Own.build returned NoneType; expected a model of the class Fl"),
        (lambda: dt.floquet(declared(model=1.0)(omega=1.0)), "Own.build returned float; expected a model of the class Fl"),
        (lambda: LinearPeriodic(lambda t: ((1.0,),), -1.0), "span = -1: expected 0 < span"),
        (lambda: declared(parameters=("om",)), "Own: parameters of floquet: 'om' is not a parameter"),
        (lambda: replace(get_analysis("modes"), methods={"m": ("zz",)}), r"methods\['m'\] of analysis modes: 'zz' is not"),
        (lambda: dt.Cardan(beta=17, Omega=1.4, **BASE), "beta = 17: expected -1.57"),
        (lambda: dt.Cardan(beta=0.1, Omega=1.4), "zeta: missing; expected 0 <= zeta"),
        (lambda: dt.Cardan(beta=np.array([0.1, 2.0]), Omega=1.4, **BASE), "beta = 2.0: expected"),
        (lambda: dt.floquet(SHAFT, rtol=1.0), "rtol = 1.0: expected"),
        (lambda: dt.floquet(SHAFT, rtoll=1e-9), "rtoll = 1e-09: not used by method auto"),
        (lambda: dt.floquet(SHAFT, outputs="radius"), "outputs: 'radius' is not a result of floquet"),
        (lambda: dt.modes(SHAFT), "'modes': unknown to cardan; expected one of floquet, atlas, history, lyapunov, forced"),
        (lambda: dt.forced(dt.Planetary()), "'forced': unknown to planetary; expected one of"),
        (lambda: jax.hessian(lambda s: dt.floquet(s).spectral_radius)(SHAFT), "floquet: got a second derivative"),
        (lambda: dt.floquet(3.0), "system: got a float; expected a system"),
        (lambda: dt.floquet(replaced(SHAFT, "beta", jnp.ones(3))), r"parameters of the shape \(3,\)"),
        (lambda: dt.history(dt.Tripod(element="input", beta=0.1, zeta=0.1, equation="26"), stop=1.0), "equation = '26'"),
        (lambda: dt.sweep(dt.floquet, SHAFT, over={}), "over: empty"),
        (lambda: dt.sweep(dt.floquet, SHAFT, over={"bet": [0.1]}), "bet: unknown parameter"),
        (lambda: dt.sweep(dt.floquet, dt.Cardan, over={"beta": [0.1]}), "system: got the class Cardan; expected a system"),
        (lambda: dt.sweep(dt.floquet, SHAFT, over={"beta": [[0.1]]}), r"axes.beta.values = \[\[0.1\]\]: expected"),
        (lambda: swept(lambda p: {"outcome": p["a"]}), "outcome: the function returns float64 of the shape"),
        (lambda: swept(lambda p: {"y": jnp.bfloat16(p["a"])}, {"a": [0.5, 1.0]}), "returns 'y' as bfloat16; expected num"),
        (lambda: named("values"), "Own.values: a name that every system or result has; expected another"),
        (lambda: named("outcome"), "Own.outcome: a name that every system or result has; expected another"),
        (lambda: swept(len, {"k": [0.0, 1.0]}), r'k: an array cannot vary as a whole; expected one entry, .* "k\[0\]"'),
        (lambda: swept(len, {"l": [0.0, 1.0]}), "over.l: a list cannot vary as a whole"),
        (lambda: swept(len, {"k[3]": [0.0, 1.0]}), r"over.k\[3\]: expected k\[0\] to k\[2\]"),
        (lambda: swept(len, {"a[0]": [0.0, 1.0]}), r"over.a\[0\]: a is not a list; expected a"),
        (lambda: swept(len, {"a": [0.0, np.nan]}), "over.a = nan: expected -inf < a < inf"),
        (lambda: swept(len, {"a": [0.0, 0.0, 1.0]}), "over.a: the value 0 occurs twice; expected distinct values"),
        (lambda: dt.sweep(len, TRIPOD, over={"element": ["input", "output"]}), "over.element: a word cannot vary"),
        (lambda: dt.sweep(len, SHAFT, over={"beta": [0.1, 2.0]}), "over.beta = 2.0: expected -1.57"),
        (lambda: swept(lambda p: {"amp": p["a"]}, outputs="am"), r"'am' is not a result of lambda \(did you mean amp\?\)"),
        (lambda: swept(lambda p: {"amp": p["a"]}, outputs=[]), r"outputs = \[\]: expected one or more of amp"),
        (lambda: swept(lambda p: {"r": {"s": p["a"]}}), "returns a dict as 'r'; expected an array or a flat dict of"),
        (lambda: swept(lambda p: None), "function: returns a NoneType; expected an array or a flat dict of arrays"),
        (lambda: jax.jit(lambda x: swept(len, {"a": x}))(jnp.ones(2)), "sweep: does not work under jax.jit"),
        (lambda: jax.jit(lambda x: dt.sweep(dt.floquet, replaced(SHAFT, "beta", x), over={"Omega": [1.0]}))(0.1), "jax.jit"),
        (lambda: jax.grad(lambda x: swept(lambda p: x * p["a"]))(1.0), "sweep: does not work under jax.jit, jax.grad"),
        (lambda: swept(len, {"aa": [0.0, 1.0]}), r"over.aa: unknown to a dict \(did you mean a\?\); expected a, k, l"),
        (lambda: dt.sweep(len, SHAFT, over={"name": [1.0]}), "over.name: unknown to a Cardan.*; expected beta, Omega, "),
        (lambda: dt.sweep(abs, 1.0, over={"a": [0.0, 1.0]}), "system: got a float; expected a pytree"),
        (lambda: dt.sweep(lambda p: {"a": p["a"]}, {"a": 1.0}, over={"a": [1.0]}), "over: 'a' names two dimensions"),
        (lambda: swept(lambda p: {"r/s": p["a"]}), "returns a result 'r/s'; expected another name, without /"),
        (lambda: swept(lambda p: {"checksums": p["a"]}), "returns a result 'checksums'; expected another name"),
        (lambda: swept(lambda p: {"": p["a"]}), "returns a result ''; expected another name"),
        (lambda: dt.sweep(len, {"outcome": 1.0}, over={"outcome": [0.0]}), "over.outcome: the name of a result"),
        (lambda: swept(len, {"a": [True, False]}), r"over.a.values = \[True, False\]: expected .*, got `bool`"),
        (lambda: swept(len, {"a": np.ma.masked_equal([0.0, 1.0], 1.0)}), "over.a.values = .*: expected .*, got `null`"),
        (lambda: dt.Cardan(beta=np.ma.masked, Omega=1.4, **BASE), "beta: a masked value; expected numbers"),
        (lambda: dt.Cardan(beta=1 << 2000, Omega=1.4, **BASE), "beta: an integer of 2001 bits; expected"),
        (lambda: dt.sweep(dt.floquet, dt.Cardan(beta=0.1, Omega=jnp.ones(2), **BASE), over={"beta": [0.1]}),
            r"fixed.Omega = \[1.0, 1.0\]: expected "),
    ],
)  # fmt: skip
def test_wrong_input_is_one_line(call, message):
    with pytest.raises(dt.InputError, match=message) as raised:
        call()
    assert "\n" not in str(raised.value)


@pytest.mark.full
def test_a_result_without_a_derivative_spoils_no_other():
    results = {"known": jnp.array(3.0), "other": jnp.zeros(2), "other_error": jnp.array(0.1)}

    def tangents(direction):
        return _tangents(results, {"known": jnp.array([2.0])}, [direction])

    forward = tangents(jnp.array(1.0))
    assert forward["known"] == 2.0 and jnp.isnan(forward["other"]).all() and forward["other_error"] == 0.0
    known = jax.grad(lambda x: tangents(x)["known"])
    only = {name: jnp.where(name == "known", jnp.ones_like(x), 0.0) for name, x in results.items()}
    assert known(1.0) == jax.vjp(tangents, 1.0)[1](only)[0] == 2.0


def test_a_traced_array_is_a_list_as_a_concrete_one_is():
    def variation(angles):
        line = dt.Driveline(beta=angles, speed=100.0, k=[1e4] * 2, c=[0.1] * 2, J=[0.1, 1.0])
        return dt.phasing(line).speed_variation

    assert jax.eval_shape(jax.vmap(variation), jnp.ones((3, 2))).shape == (3,)
    lengths = dt.Bicardan.presets["paper"]["length"]
    traced = jax.jit(lambda x: dt.Bicardan(**dt.Bicardan.presets["paper"] | {"length": x}).length)(jnp.array(lengths))
    assert isinstance(traced, tuple) and list(map(float, traced)) == list(lengths)


def test_a_path_is_the_number_that_its_name_says():
    """And no other parameter that holds the same object."""
    speeds = np.linspace(0.5, 0.9, 3)
    with pytest.raises(dt.InputError, match=r"^frequency_response: parameters of the shape \(3,\)"):
        dt.frequency_response(dt.Rattle(**GEARS.values | {"omega": speeds, "B1": speeds}), method="describing_function")
    stiffness = 5e8
    gear = dt.Planetary(k_sp=stiffness, k_rp=stiffness)
    for track in ("planet_angle", "planet_angle[4]", "k_ps"):
        with pytest.raises(dt.InputError, match=rf"^{re.escape(track)}: not a number of planetary.*expected") as raised:
            dt.modes(gear, track=track)
        assert "\n" not in str(raised.value)


def test_an_empty_batch_has_empty_derivatives():
    slopes = jax.vmap(jax.grad(lambda s: dt.floquet(s).spectral_radius))(jax.tree.map(lambda _: jnp.zeros(0), SHAFT))
    assert slopes.beta.shape == (0,)


def test_any_function_is_swept_resumed_and_refused(tmp_path):
    """Points that are not finite are data; another function is not taken for this one."""
    out, pytree, over = tmp_path / "r.nc", {"a": 1.0, "b": 2.0}, {"a": [-1.0, 4.0, 9.0], "b": [1.0, 3.0]}

    def one(factor):
        def root(p):
            return {
                "root": factor * jnp.sqrt(p["a"]) * p["b"],
                "both": jnp.stack([p["a"], p["b"]]),
                "large": p["a"] > 5,
            }

        return root

    found = dt.sweep(one(1.0), pytree, over=over, out=out)
    assert found.root.dims == ("a", "b") and found.both.shape == (3, 2, 2)
    np.testing.assert_allclose(found.root, np.sqrt([[np.nan], [4], [9]]) * [1, 3])
    assert found.outcome.values.tolist() == [[4, 4], [0, 0], [0, 0]] and found.large.values[2].tolist() == [1, 1]
    before = out.stat().st_mtime_ns
    dt.sweep(one(1.0), pytree, over=over, out=out)
    assert out.stat().st_mtime_ns == before
    even = {"a": {"start": -1.0, "stop": 9.0, "num": 3}, "b": {"values": [1.0, 3.0]}}
    assert dt.sweep(one(1.0), pytree, over=even).equals(found)
    remedy = "differs?; --fresh replaces it \\(fresh=True in Python\\)"
    with pytest.raises(
        dt.InputError, match=f"another scene or version: the function, an option or a fixed value {remedy}"
    ):
        dt.sweep(one(2.0), pytree, over=over, out=out)
    assert dt.sweep(one(1.0), pytree, over=over, outputs="root").equals(found[["root", "outcome"]])
    with pytest.raises(dt.InputError, match=f"the values of over or the outputs {remedy}"):
        dt.sweep(one(1.0), pytree, over={"a": [4.0], "b": [1.0]}, out=out)
    with pytest.raises(dt.InputError, match="system = 'function': known only to the script"):
        dt.sweep(dt.floquet, SHAFT, over={"beta": [0.1]}, out=out)
    assert dt.sweep(one(2.0), pytree, over=over, out=out, fresh=True).root[1, 1] == 12.0


def test_a_subclass_may_declare_a_parameter_anew():
    base = named("a")
    anew = type("Anew", (base,), {"__annotations__": {"a": float}, "a": parameter("1", "any", lower=-1.0, default=0.5)})
    narrow = type("Narrow", (anew,), {"__annotations__": {"a": float}, "a": parameter("1", "any", lower=0.0)})
    assert [p.lower for p in anew.parameters] == [-1.0] and [p.default for p in narrow.parameters] == [None]
    assert anew().values == {"a": 0.5} and anew(a=-0.5).a == -0.5
    with pytest.raises(dt.InputError, match=r"^a = -0\.5: expected 0 <= a"):
        narrow(a=-0.5)


def test_help_and_results_show_what_they_hold():
    text = inspect.getdoc(dt.Cardan) or ""
    assert "zeta: damping ratio of the driving shaft; 0 <= zeta < inf; required." in text
    assert "theta1_0: twist of the driving shaft at tau = 0; -inf < theta1_0 < inf, in rad; default 0.0." in text
    assert repr(dt.Result({"z": jnp.array([1 + 2j, 3.0])})) == "Result(z=[(1+2j), (3+0j)])"
    assert repr(dt.Result({"z": jnp.ones(9, complex)})) == "Result(z=c128[9])"


def test_registered_classes_are_known_by_name(tmp_path, monkeypatch):
    """Until another one of this name replaces them; classes without a file, as in a notebook, do not share results."""
    monkeypatch.setattr(systems, "_REGISTERED", {})

    def made(factor):
        class Own(System):
            name, title = "own", "own"
            a: float = parameter("1", "a")

            @serves("parameters", results=(Variable("b", "1", "b"),))
            def constants(self):
                return {"b": factor * self.a}

        Own.__module__ = "no_file"
        return Own

    scene, out = {"system": "own", "analysis": "parameters", "axes": {"a": [1.0, 2.0]}}, tmp_path / "own.nc"
    with pytest.raises(dt.InputError, match="system = 'own': unknown"):
        dt.run(scene)
    assert dt.run(scene | {"system": made(2.0)}, out=out).b.values.tolist() == [2.0, 4.0]
    assert dt.run(scene, out=out).b.values.tolist() == [2.0, 4.0]
    dt.register(made(3.0))
    assert dt.run(scene).b.values.tolist() == [3.0, 6.0]
    with pytest.raises(dt.InputError, match=r"own\.nc"):
        dt.run(scene, out=out)
    assert dt.register(dt.Cardan) is dt.Cardan and not systems._REGISTERED.keys() - {"own"}
    same = type("Same", (made(1.0),), {"name": "cardan"})
    for wrong, message in ((3, "system = 3: expected a subclass of"), (same, "system = 'cardan': names an installed")):
        with pytest.raises(dt.InputError, match=message):
            dt.register(wrong)


@pytest.mark.full
def test_a_sweep_of_an_unregistered_class_has_the_dimensions_of_its_analysis():
    class Falling(System):
        name, title, time_units = "falling", "y'' = -g", "s"
        roles: ClassVar = {"speed": "g", "angle": "slope"}
        state = (Component("height", "m", "height"), Component("rate", "m/s", "rate"))
        g: float = parameter("m/s2", "acceleration")
        slope: float = parameter("1", "slope of the ground")

        @serves("history")
        def flow(self):
            return Flow(lambda angles, y: (y[1], -self.g), (0.0, 0.0), period=1.0)

    found = dt.sweep(dt.history, Falling(g=1.0, slope=0.0), over={"g": [1.0, 2.0]}, stop=2.0, num=3)
    assert found.attrs["title"] == "history of y'' = -g" and json.loads(found.attrs["roles"]) == {"speed": "g"}
    assert found.time.values.tolist() == [0.0, 1.0, 2.0] and found.height.attrs["units"] == "m"
    np.testing.assert_allclose(found.height[1], [0.0, -1.0, -4.0], atol=1e-9)


def test_a_sweep_along_a_path_needs_a_class_that_is_known_by_name():
    gears = type("Gears", (dt.Rattle,), {"name": "gears"})(**GEARS.values | {"omega": np.linspace(0.5, 0.9, 3)})
    for over in ({"omega": [0.5, 0.9]}, {"B1": [0.1, 0.2]}):
        with pytest.raises(dt.InputError, match=r"^system = Gears: .* dt\.register\(Gears\)"):
            dt.sweep(dt.frequency_response, gears, over=over, method="describing_function")


def test_arrays_inside_a_jitted_function_belong_to_it():
    def gain(table):
        return jax.jit(lambda p: p["a"] * jax.jit(lambda x: jnp.dot(x, x))(np.array(table)))

    for table, gain_of_table in (([1.0, 2.0], 5.0), ([3.0, 4.0], 25.0)):
        assert swept(gain(table))["lambda"].values[-1] == gain_of_table * swept(lambda p: p["a"])["lambda"].values[-1]


def test_what_python_computes_on_the_host_is_never_reused(tmp_path):
    def times(factor):
        shape = jax.ShapeDtypeStruct((), float)
        return lambda p: jax.pure_callback(lambda x: np.asarray(factor * x), shape, p["a"], vmap_method="sequential")

    out = tmp_path / "host.nc"
    assert swept(times(2.0), out=out)["lambda"].values.tolist() == [0.0, 1.0]
    assert swept(times(3.0))["lambda"].values.tolist() == [0.0, 1.5]
    with pytest.raises(dt.InputError, match="the function, an option or a fixed value differs"):
        swept(times(2.0), out=out)
    assert swept(times(3.0), out=out, fresh=True)["lambda"].values.tolist() == [0.0, 1.5]


def test_an_infinite_result_is_missing_and_codes_are_known():
    found = swept(lambda p: {"r": 1 / p["a"], "n": jnp.int32(3)})
    assert np.isnan(found.r[0]) and found.r[1] == 2.0 and found.n.values.tolist() == [3, 3]
    assert found.outcome.values.tolist() == [Outcome.NOT_FINITE, Outcome.SUCCESS]
    coded = swept(lambda p: {"r": p["a"], "outcome": jnp.where(p["a"] > 0, 300, 2)})
    assert coded.outcome.values.tolist() == [2, Outcome.NOT_FINITE]


def test_results_agree_with_the_outcome_that_a_function_returns():
    found = swept(
        lambda p: {"r": 1 / (p["a"] - 1), "n": jnp.int32(3), "outcome": jnp.where(p["a"] < 0.5, 2, 1)},
        over={"a": [0.0, 0.5, 1.0]},
    )
    np.testing.assert_array_equal(found.r, [np.nan, -2.0, np.nan])
    assert found.outcome.values.tolist() == [Outcome.NOT_CONVERGED, Outcome.TOLERANCE_NOT_MET, Outcome.NOT_FINITE]
    assert found.n.values.tolist() == [3, 3, 3]
    assert not [finding for finding in check(found) if finding.broken]


def test_gaps_in_the_result_of_an_analysis_stay():
    def undamped(p):
        return Result({"spectral_radius": p["a"], "floquet_multiplier": jnp.nan, "outcome": jnp.int8(0)})

    found = swept(undamped)
    assert found.spectral_radius.values.tolist() == [0.0, 0.5] and found.outcome.values.tolist() == [0, 0]
    assert not [finding for finding in check(found) if finding.broken]


@pytest.mark.full
@pytest.mark.parametrize("number", [np.float64, np.float32, np.array, jnp.array, jnp.float32])
def test_fixed_values_may_be_numbers_of_numpy_and_jax(number):
    shaft = dt.Cardan(beta=number(0.25), Omega=1.5, **{name: number(value) for name, value in BASE.items()})
    found = dt.sweep(dt.floquet, shaft, over={"Omega": [1.5, 1.75]}, outputs=["spectral_radius"])
    assert "\nbeta = 0.25\n" in found.attrs["scene"]
    assert found.spectral_radius[0] == pytest.approx(float(dt.floquet(shaft).spectral_radius), rel=1e-12)


@pytest.mark.parametrize("name", ["k[1]", "l[1]"])
def test_a_swept_entry_keeps_its_array_or_list(name):
    """Also an array of integers, whose type does not hold the value."""
    found = dt.sweep(
        lambda p: {"r": p["k"].sum() + (p["l"] + [0.0])[1]},
        {"k": np.arange(3), "l": [9.0, 1.0]},
        over={name: [0.5, 7.0]},
    )
    np.testing.assert_array_equal(found.r, [3.5, 10.0])


@pytest.mark.full
def test_a_chart_of_gradients():
    def slope(shaft):
        return jax.grad(lambda s: dt.floquet(s).spectral_radius)(shaft).zeta

    chart = dt.sweep(slope, SHAFT, over={"Omega": [1.41, 1.416]})
    assert float(chart.slope[1]) == pytest.approx(-4.592945, abs=1e-6)


FIRST = "import jax, drivetrain_jax as dt", "import drivetrain_jax as dt, jax"


@pytest.mark.full
@pytest.mark.parametrize("first", but_full(FIRST, FIRST[0]))
def test_the_first_use_may_be_inside_a_traced_function(first):
    code = f"""
{first}
@jax.jit
def radius(omega):
    return dt.floquet(dt.Cardan(beta=0.3, Omega=omega, zeta=1e-3, alpha=1.0, mu=1.0, gamma=100.0)).spectral_radius
found = radius(1.416)
assert found.dtype == "float64" and abs(found - 1.0319354931451954) < 1e-9, found
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.full
def test_who_embeds_the_package_may_keep_single_precision():
    code = """
import inspect
import os
os.environ["DRIVETRAIN_JAX_ENABLE_X64"] = "0"
import jax, drivetrain_jax as dt
gears = dt.Bicardan(**dt.Bicardan.presets["paper"])
with jax.enable_x64(True):
    assert dt.critical_speeds(gears).critical_speed.dtype == "float64"
    chart = dt.sweep(dt.critical_speeds, gears, over={"k_A": [1e7, 1e8]})
    assert chart.critical_speed.dtype == "float64" and (chart.outcome == 0).all()
assert not jax.config.jax_enable_x64 and jax.numpy.ones(1).dtype == "float32"
for call in (lambda: dt.critical_speeds(gears), lambda: dt.sweep(dt.critical_speeds, gears, over={"k_A": [1e7]})):
    try:
        call()
    except dt.InputError as error:
        assert "jax_enable_x64 = False" in str(error)
    else:
        raise AssertionError
"""
    # Commands run in this process before jax is imported turn on double precision through the environment.
    own = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    subprocess.run([sys.executable, "-c", code], check=True, env=own)


@pytest.mark.full
def test_a_result_and_a_gradient_show_their_numbers():
    found = dt.floquet(SHAFT, outputs=["spectral_radius"])
    assert re.fullmatch(r"Result\(outcome=0, spectral_radius=1\.03193549\d+\)", repr(found))
    assert "zeta=-0.5," in repr(jax.grad(lambda s: -0.5 * s.zeta)(SHAFT))
    assert "spectral_radius=f64[2]" in repr(jax.tree.map(lambda x: jnp.stack([x, x]), found))
