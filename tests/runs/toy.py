"""A system and analyses that compile fast, for tests of the engine; as a script this module is ``drivetrain`` with them."""

from __future__ import annotations

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from drivetrain_jax import analysis, systems
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analysis import RTOL, Analysis, Outcome, Solver
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.runs import job, scene
from drivetrain_jax.systems import Model, Resonances, System, parameter

_USED = ("a", "b", "n", "kind", "length", "derived")


class Toy(System):
    name = "toy"
    title = "Toy"
    source = "nowhere"
    resonances = Resonances("a", ("b",), ("R1", "R2"), lambda v: np.stack([v["b"] * 1.0, v["b"] / 2], -1), "predicted")
    models = {name: Model(lambda values: values, _USED) for name in ("toy", "slow", "loose", "broken", "line")} | {
        "follow": Model(
            lambda values: values, ("b", "length", "weight", "stiffness"), lambda f: _lengths_and_weights(f)
        )
    }

    a: float = parameter("m", "first", lower=0.0, upper=10.0)
    b: float = parameter("s", "second", default=2.0, lower=0.0, open_lower=True)
    n: int = parameter("1", "count", default=3, lower=1, integer=True)
    kind: str = parameter("1", "sort", default="plain", choices=("plain", "fancy"))
    length: tuple = parameter("m", "lengths", default=(1.0, 2.0, 3.0), lower=0.0, listed=True)
    derived: float = parameter("1", "twice a", derived="2 a")
    unused: float = parameter("1", "not used by any analysis")
    weight: float = parameter("N/m", "weights", default=1.0, lower=0.0, listed=True, broadcast=True)
    stiffness: float = parameter("N/m", "stiffness of the support", default=float("inf"), lower=0.0, infinite=True)


VARIABLES = (
    Variable("value", "m", "sum of everything"),
    Variable("wave", "1", "complex result", ("part",), "complex128"),
    Variable("sign", "1", "a flag", dtype="int8", flags=("small", "large")),
    Variable("effort_seen", "1", "effort handed to the solver"),
)
LARGE = 5.0


def _solve(values: dict, effort, outputs: tuple[str, ...], bonus: float) -> dict:
    """The results of a point, or of a batch along the last axis; ``a > 9`` has no value."""
    a, b = jnp.asarray(values["a"]), values["b"]
    bonus = bonus + values.get("derived", 2 * a) - 2 * a
    total = a + b * values["n"] + sum(x * 10.0**k for k, x in enumerate(values["length"])) + bonus
    failed = a > 9
    results = {
        "value": jnp.where(failed, jnp.nan, total + (values["kind"] == "fancy") * 0.5),
        "wave": jnp.stack([jnp.exp(1j * a * k) + 0 * b for k in range(3)]),
        "sign": (a > LARGE).astype(jnp.int8),
        "effort_seen": jnp.asarray(effort, float) + 0 * a,
    }
    outcome = jnp.where(failed, Outcome.NOT_FINITE, Outcome.SUCCESS).astype(jnp.int8)
    return {name: results[name] for name in outputs} | {"outcome": outcome}


def _solvers(system: System, request) -> tuple[Solver, ...]:
    """Two solvers: small ``a`` is cheaper with the broadcasting one, large ``a`` is impossible for it."""
    small = Solver(
        "broadcasting",
        lambda values, effort: _solve(values, effort, request.outputs, 0.0),
        lambda c: np.where(c["a"] > LARGE, np.inf, 10 * c["a"]),
        chunk=32,
    )
    large = Solver(
        "mapped",
        over_lanes(lambda v, e: _solve(v, e, request.outputs, 0.0)),
        lambda c: 100 * c["b"],
        unit_cost=2.0,
        chunk=16,
    )
    hopeless = "hopeless" == request.method
    return (small,) if hopeless else (small, large)


def _slow_solvers(system: System, request) -> tuple[Solver, ...]:
    def solve(values: dict, effort) -> dict:
        results = _solve(values, effort, request.outputs, 0.0)
        wait = jax.pure_callback(
            lambda x: (time.sleep(0.05), np.float64(0))[1], jax.ShapeDtypeStruct((), float), effort
        )
        return results | {"value": results["value"] + wait}

    return (Solver("slow", solve, lambda c: 1 + c["a"], chunk=8),)


def _loose_solvers(system: System, request) -> tuple[Solver, ...]:
    """Values with ``a > 8`` miss their target."""

    def solve(values: dict, effort) -> dict:
        results = _solve(values, effort, request.outputs, 0.0)
        missed = (jnp.asarray(values["a"]) > 8) & (results["outcome"] == Outcome.SUCCESS)
        outcome = jnp.where(missed, Outcome.TOLERANCE_NOT_MET, results["outcome"])
        return results | {"outcome": outcome.astype(jnp.int8)}

    return (Solver("loose", solve, lambda c: 1 + c["a"], chunk=8),)


def _broken_solvers(system: System, request) -> tuple[Solver, ...]:
    def solve(values: dict, effort) -> dict:
        raise RuntimeError("no luck\ntoday")

    return (Solver("broken", solve, lambda c: 1 + c["a"]),)


def _line_solvers(system: System, request) -> tuple[Solver, ...]:
    """A solver of running sums along the path ``b``, which need the whole line."""

    def solve(values: dict, effort) -> dict:
        running = jnp.cumsum(values["b"]) * values["a"]
        both = jnp.stack([running, jnp.cumsum(values["b"][::-1])[::-1]], axis=1)
        return {"response": both, "outcome": jnp.zeros(running.shape, jnp.int8)}

    return (Solver("line", over_lanes(solve), lambda c: np.full(c["a"].shape, c["b"].size), chunk=4),)


def _follow_solvers(system: System, request) -> tuple[Solver, ...]:
    """A solver of sums of ``weight * length`` along the path; the batch is the last axis, ``stiffness`` may be infinite."""

    def solve(values: dict, effort) -> dict:
        pieces, weight = values["length"], values["weight"]
        weights = weight if isinstance(weight, tuple) else (weight,) * len(pieces)
        lanes = jnp.asarray(values["b"] + 0 / values["stiffness"])
        step = [jnp.asarray(x * w, float) for x, w in zip(pieces, weights, strict=True)]
        path = max(x.size for x in step)
        load = jnp.stack([jnp.cumsum(jnp.broadcast_to(x, path)) for x in step], axis=1)[..., None] + 0 * lanes
        return {"load": load, "outcome": jnp.zeros((path, lanes.size), jnp.int8)}

    return (Solver("follow", solve, lambda c: c["b"], chunk=4),)


def _lengths_and_weights(fixed) -> None:
    weight = fixed.get("weight")
    if isinstance(weight, tuple) and len(weight) != len(fixed["length"]):
        counts = f"{len(weight)} entries where length has {len(fixed['length'])}"
        raise ValueError(f"weight = {list(weight)}: {counts}; expected equally many")


def _analysis(name: str, solvers, methods=None) -> Analysis:
    return Analysis(
        name=name,
        title="toy analysis",
        variables=VARIABLES,
        default_outputs=("value",),
        methods=methods or {"plain": ("rtol",)},
        options=(RTOL, Parameter("knob", "1", "an option", default=1.0)),
        solvers=solvers,
        dimensions=lambda *_: (Dimension("part", "part of the wave", ()),),
    )


ANALYSES = {
    "toy": _analysis("toy", _solvers, {"plain": ("rtol",), "other": ("rtol", "knob"), "hopeless": ()}),
    "slow": _analysis("slow", _slow_solvers),
    "loose": _analysis("loose", _loose_solvers),
    "broken": _analysis("broken", _broken_solvers),
    "line": Analysis(
        name="line",
        title="toy with a path",
        variables=(Variable("response", "1", "running sum", ("direction",)),),
        default_outputs=("response",),
        methods={"plain": ()},
        options=(),
        solvers=_line_solvers,
        dimensions=lambda *_: (Dimension("direction", "direction of the sum", ("up", "down")),),
        path_axis=lambda *_: "b",
    ),
    "follow": Analysis(
        name="follow",
        title="toy whose path is an option",
        variables=(Variable("load", "N", "weight times length, summed along the path", ("piece",)),),
        default_outputs=("load",),
        methods={"plain": ("track",)},
        options=(Parameter("track", "1", "axis along which the sum runs", default="a", text=True),),
        solvers=_follow_solvers,
        dimensions=lambda system, request, fixed: (
            Dimension("piece", "number of the piece", tuple(range(1, 1 + len(fixed["length"])))),
        ),
        path_axis=lambda _, request: request.options["track"],
    ),
}


def names(replace=setattr) -> None:
    """Make the toys known to scenes; ``replace`` may be ``monkeypatch.setattr``."""
    replace(systems, "_REGISTERED", {**systems._REGISTERED, "toy": Toy})
    known, names_of = analysis.get_analysis, analysis.analysis_names
    replace(analysis, "analysis_names", lambda: (*names_of(), *ANALYSES))
    for module in (analysis, scene):
        replace(module, "get_analysis", lambda name: ANALYSES[name] if name in ANALYSES else known(name))


def small_blocks(replace=setattr) -> None:
    """Let a block have the points of one chunk."""
    replace(job, "_SECONDS", 1e-4)
    replace(job, "_LEAST_CHUNKS", 1)


if __name__ == "__main__":
    from drivetrain_jax.cli import main

    names()
    small_blocks()
    sys.exit(main())
