"""Sweeps of functions: an analysis of the package, or any JAX function of a pytree, over a grid of its parameters."""

from __future__ import annotations

import hashlib
import re
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax import analyses
from drivetrain_jax._errors import InputError, nearest, shown
from drivetrain_jax._quantities import FIRST_FAILURE, Dimension, Parameter, Variable
from drivetrain_jax.analysis import OUTCOME, Analysis, Outcome, Request, Solver, analysis_names
from drivetrain_jax.analysis._base import dimensions_of, make_request
from drivetrain_jax.analysis.numerics.lanes import over_lanes
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.axes import Axis, axis_table, axis_values, entry_of
from drivetrain_jax.runs.run import run
from drivetrain_jax.runs.scene import FUNCTION, Scene
from drivetrain_jax.systems import Model, System, get_system, system_names

if TYPE_CHECKING:
    import xarray as xr

# The fixed word that identifies what a function computes.
_COMPUTES = "computes"
# Names that files can store, and names that they use themselves.
_STORED_NAME, _RESERVED = re.compile(r"(?!\.{1,2}$)[^/\x00-\x1f]+"), ("checksums", "provenance")


def sweep(
    function: Callable[..., Any],
    system: Any,
    over: Mapping[str, Any],
    out: str | Path | None = None,
    outputs: Sequence[str] | None = None,
    *,
    fresh: bool = False,
    **options: Any,
) -> xr.Dataset:
    """One labelled dataset with the results of ``function(system)`` on the outer product of ``over``.

    Args:
        function: an analysis such as :func:`drivetrain_jax.floquet`, or any JAX function of a pytree that returns an array,
            a dict of arrays, or the result of an analysis.
        system: the pytree; values that are not in ``over`` stay fixed.
        over: values ``(N,)`` by name of a parameter, an entry of a list or array (``"length[1]"``), a key or an attribute.
            A value may be a text with a unit, ``"18 deg"``.
        out: a netCDF file. The next call resumes unfinished work, and only reads a finished result. A function that calls
            Python back (``jax.pure_callback``) is computed again, with ``fresh=True``.
        outputs: variables to compute; default: the default of the analysis, or all.
        fresh: compute all points again and replace what is at ``out``, such as the result of another function.
        options: options of the analysis, or keyword arguments of the function.

    Returns: a dataset with one dimension for each entry of ``over``, in that order. A point with a result that is not
    finite is NaN and has a failed ``outcome``; other points are not affected. A function may return the code ``outcome``
    itself; from 2 (failed) on its numbers become NaN.

    Raises: :class:`~drivetrain_jax.InputError` for an unknown name or a value out of range, before anything is computed.

    >>> import drivetrain_jax as dt, numpy as np
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.4, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> chart = dt.sweep(dt.floquet, shaft, over={"beta": np.linspace(0, 1, 3), "Omega": [1.3, 1.4]}, outputs=["verdict"])
    >>> chart.verdict.dims, chart.verdict.shape
    (('beta', 'Omega'), (3, 2))
    """
    if not callable(function):
        raise InputError(f"function = {shown(function)}: expected a function, such as drivetrain_jax.floquet")
    if not isinstance(over, Mapping) or not over:
        value = f" = {shown(over)}" if over else ": empty"
        raise InputError(f"over{value}; expected values by the name of a parameter")
    _check_concrete(system, over, options)
    outputs = [outputs] if isinstance(outputs, str) else outputs
    of_another_package = isinstance(function, analyses.AnalysisFunction)
    name = function.name if of_another_package else getattr(function, "__name__", "")
    results, dims = (), ()
    if of_another_package or (name in analysis_names() and getattr(analyses, name, None) is function):
        analysis = analyses.checked_analysis(name, system)
        if system.name in system_names() and get_system(system.name) is type(system):
            return run(_scene_table(name, system, over, outputs, options), out=out, fresh=fresh)
        # A scene names its system, so any other class is that of a function.
        request = make_request(type(system), analysis, outputs, options, {*over})
        if (along := analysis.path_axis(type(system), request)) is not None:
            own = type(system).__name__
            raise InputError(f"system = {own}: {name} follows {along}; expected a class after dt.register({own})")
        results, dims = analysis.variables, dimensions_of(analysis, type(system), request, system.values)
    return run(_function_scene(function, system, over, outputs, options, results, dims), out=out, fresh=fresh)


def _scene_table(
    name: str, system: System, over: Mapping[str, Any], outputs: Sequence[str] | None, options: Mapping[str, Any]
) -> dict[str, Any]:
    conversions = system.physical.conversions if system.physical else ()
    varied = {*over, *(rule.parameter for rule in conversions if rule.needs[0] in over)}
    # An empty list stands for a default of none.
    fixed = {
        key: value
        for key, value in system.values.items()
        if not (key in varied or (isinstance(value, tuple) and not value))
    }
    axes = {key: value if isinstance(value, Mapping) else {"values": value} for key, value in over.items()}
    table = {"system": system.name, "analysis": name, "axes": axes, "fixed": fixed, "options": dict(options)}
    return table if outputs is None else table | {"outputs": list(outputs)}


def _function_scene(
    function: Callable[..., Any],
    system: Any,
    over: Mapping[str, Any],
    outputs: Sequence[str] | None,
    options: Mapping[str, Any],
    results: Sequence[Variable] = (),
    dims: tuple[Dimension, ...] = (),
) -> Scene:
    """The scene of a function: its parameters vary, and a fixed word identifies the computation.

    ``results`` with ``dims`` are those of a function that is an analysis, which takes ``outputs`` as an argument.
    """
    if jax.tree_util.treedef_is_leaf(jax.tree.structure(system)):
        raise InputError(f"system: got a {type(system).__name__}; expected a pytree, such as a dict of numbers")
    known = {p.name: p for p in system.parameters} if isinstance(system, System) else {}
    values, parameters = {}, []
    if OUTCOME.name in over:
        raise InputError(f"over.{OUTCOME.name}: the name of a result; expected another name")
    for name, entries in over.items():
        described = known.get(entry_of(name)[0], Parameter(name, "1", name))
        if described.choices or described.text:
            raise InputError(f"over.{name}: a word cannot vary; expected numbers")
        scalar = replace(described, name=name, listed=False, broadcast=False)
        table, _ = axis_table(scalar, name, toml.plain(entries), "over", keep=False)
        values[name] = axis_values(table, f"over.{name}")
        parameters.append(Parameter(name, described.units, described.long_name))
    name = re.sub(r"\W", "_", getattr(function, "__name__", "function")).strip("_") or "value"
    keywords = {"outputs": outputs} if results and outputs is not None else {}

    def one(point: Mapping[str, Any]) -> dict[str, Array] | analyses.Result:
        return _named(function(replaced(system, point), **options, **keywords), name)

    example = {key: jax.ShapeDtypeStruct((), float) for key in values}
    traced, shapes = jax.make_jaxpr(one, return_shape=True)(example)
    _check_concrete(traced.consts)
    offered = [key for key in shapes if key != OUTCOME.name]
    wanted = [key for key in (offered if outputs is None else outputs) if key != OUTCOME.name]
    if (lacking := next((key for key in wanted if key not in offered), None)) is not None:
        raise InputError(f"outputs: {lacking!r} is not a result of {name}{nearest(str(lacking), offered)}")
    if offered and not wanted:
        raise InputError(f"outputs = {shown(outputs)}: expected one or more of {', '.join(offered)}")
    content = [re.sub(r"0x[0-9a-f]+", "", str(traced.jaxpr)), *(np.asarray(x).tobytes() for x in _constants(traced))]
    if " callback=" in content[0]:
        # What Python computes on the host may change unseen.
        content.append(uuid.uuid4().hex)
    computes = hashlib.blake2b(repr(content).encode(), digest_size=16).hexdigest()
    words = {variable.name: variable for variable in results}
    for key in wanted:
        shape, dims_of_key = shapes[key], tuple(f"{key}_{i}" for i in range(len(shapes[key].shape)))
        dtype = "int8" if shape.dtype == bool else str(shape.dtype)
        words.setdefault(key, Variable(key, "1", key, dims_of_key, dtype))
    variables = tuple(words[key] for key in wanted)
    kind, analysis = _kind(_Once(one), name, tuple(parameters), type(system), variables, dims, computes)
    axes = tuple(Axis(key, kind.parameter(key), None, numbers) for key, numbers in values.items())
    names = [*(axis.dim for axis in axes), *wanted, *dict.fromkeys(dim for v in variables for dim in v.dims)]
    if double := [label for label in names if names.count(label) > 1]:
        raise InputError(f"over: {double[0]!r} names two dimensions or results; expected distinct names")
    text = f'system = "{kind.name}"\nanalysis = "{name}"\n\n[fixed]\n{_COMPUTES} = "{computes}"\n'
    request, fixed = Request(tuple(wanted), "function", {}), {_COMPUTES: computes}
    return Scene(kind, analysis, request, axes, False, fixed, f"{name} of {kind.title}", text)


@dataclass(frozen=True)
class _Once:
    """A function that compares equal to any other; the digest in the cache key distinguishes functions."""

    call: Callable[..., Any] = field(compare=False)


@lru_cache(maxsize=16)
def _kind(
    one: _Once,
    name: str,
    parameters: tuple[Parameter, ...],
    of: type,
    variables: tuple[Variable, ...],
    dims: tuple[Dimension, ...],
    computes: str,
) -> tuple[type[System], Analysis]:
    """A system whose parameters vary, and its analysis; cached, so the same function is compiled once."""
    varies = tuple(parameter.name for parameter in parameters)
    computing = Parameter(_COMPUTES, "1", "digest of what the function computes", text=True)

    def solve(values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
        returned = one.call({key: values[key] for key in varies})
        results = {v.name: returned[v.name].astype(v.dtype) for v in variables}
        code = dict(returned).get(OUTCOME.name)
        return _with_outcome(results, code, isinstance(returned, analyses.Result))

    entries = {dim: v.name for v in variables for dim in v.dims}
    numbered = {dim: Dimension(dim, f"number of the entry of {name}", ()) for dim, name in entries.items()}
    dimensions = tuple((numbered | {d.name: d for d in dims if d.name in entries}).values())
    models = {name: Model(lambda values: values, varies)}
    body = {"name": FUNCTION, "title": of.__name__, "parameters": (*parameters, computing), "models": models}
    if issubclass(of, System):
        # Analyses ask for them, and figures show them.
        body |= {key: getattr(of, key) for key in ("state", "state_axis", "displacements")}
        body |= {"title": of.title, "roles": {role: key for role, key in of.roles.items() if key in varies}}
    outputs, methods, solver = (tuple(v.name for v in variables), {"function": ()}, Solver(name, over_lanes(solve)))
    given = (name, f"function {name}", variables, outputs, methods, (), lambda *_: (solver,), lambda *_: dimensions)
    return type("Function", (System,), body), Analysis(*given)


def _with_outcome(results: Mapping[str, Array], code: Array | None, of_analysis: bool) -> dict[str, Array]:
    """``results`` and their outcome, the ``code`` of the function, 0 without one.

    A success with a number that is not finite becomes a failure, and the numbers of a failure become NaN. The results
    ``of_analysis`` stay as they are, because an analysis knows which of its numbers may be NaN.
    """
    state = jnp.int64(Outcome.SUCCESS) if code is None else code
    state = jnp.where((state >= 0) & (state <= max(Outcome)), state, Outcome.NOT_FINITE).astype(jnp.int8)
    if of_analysis:
        return {**results, OUTCOME.name: state}
    inexact = {name for name, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact)}
    finite = jnp.all(jnp.array([True, *(jnp.all(jnp.isfinite(results[name])) for name in inexact)]))
    state = jnp.where(finite | (state >= FIRST_FAILURE), state, jnp.int8(Outcome.NOT_FINITE))
    kept = {n: jnp.where(state < FIRST_FAILURE, x, jnp.nan) if n in inexact else x for n, x in results.items()}
    return {**kept, OUTCOME.name: state}


def _named(result: Any, name: str) -> dict[str, Array] | analyses.Result:
    if isinstance(result, analyses.Result):
        return analyses.Result(cast("dict[str, Array]", _named(result.variables, name)))
    named, arrays = result if isinstance(result, Mapping) else {name: result}, {}
    for key, value in named.items():
        try:
            arrays[str(key)] = jnp.asarray(value)
        except (TypeError, ValueError):
            what = f"a {type(value).__name__}" + (f" as {key!r}" if named is result else "")
            raise InputError(f"function: returns {what}; expected an array or a flat dict of arrays") from None
        if not _STORED_NAME.fullmatch(str(key)) or key in _RESERVED:
            raise InputError(f"function: returns a result {key!r}; expected another name, without /")
        array = arrays[str(key)]
        if getattr(array.dtype, "kind", "") not in tuple("biufc"):
            raise InputError(f"function: returns {key!r} as {array.dtype}; expected numbers that files can store")
        if key == OUTCOME.name and (array.ndim or not jnp.issubdtype(array.dtype, jnp.integer)):
            allowed = f"expected one integer, a code of the outcome from 0 to {max(Outcome)}, or another name"
            raise InputError(f"outcome: the function returns {array.dtype} of the shape {array.shape}; {allowed}")
    return arrays


def _constants(traced: Any) -> list[Any]:
    """The constants of a jaxpr and of the ones inside it, such as those of functions under ``jax.jit``."""
    consts, jaxpr = list(getattr(traced, "consts", ())), getattr(traced, "jaxpr", traced)
    for value in (value for eqn in jaxpr.eqns for value in jax.tree.leaves(list(eqn.params.values()))):
        if hasattr(value, "eqns") or hasattr(value, "jaxpr"):
            consts += _constants(value)
        elif hasattr(value, "dtype") and hasattr(value, "shape"):
            consts.append(value)
    return consts


def _check_concrete(*values: Any) -> None:
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values)):
        raise InputError(
            "sweep: does not work under jax.jit, jax.grad or jax.vmap; expected numbers outside of them, "
            "or jax.vmap(function) in place of the sweep"
        )


def replaced(system: Any, point: Mapping[str, Any]) -> Any:
    """``system`` with these parameters, keys or attributes, or entries of them, replaced."""
    for name, value in point.items():
        base = entry_of(name)[0]
        if isinstance(system, Mapping):
            names, old = list(system), system.get(base)
        else:
            fallback = list(getattr(system, "_fields", getattr(system, "__dict__", ())))
            names = [field.name for field in fields(system)] if is_dataclass(system) else fallback
            old = getattr(system, base, None)
        if base not in names:
            raise InputError(f"over.{name}: unknown to a {type(system).__name__}{nearest(base, names)}")
        value = _replaced(system, old, name, value)
        if isinstance(system, Mapping):
            system = {**system, base: value}
        else:
            system = eqx.tree_at(lambda s, base=base: getattr(s, base), system, value, is_leaf=lambda x: x is None)
    return system


def _replaced(system: Any, old: Any, name: str, value: Array) -> Any:
    """``old`` with ``value`` in its place, or in place of the entry that ``name`` names."""
    (base, entry), listed = entry_of(name), isinstance(old, (list, tuple)) or getattr(old, "ndim", 0) > 0
    if entry is None:
        # A number of a system may be missing.
        declared = isinstance(system, System) and system.parameter(name).is_number
        if declared or old is None or (jax.tree_util.all_leaves([old]) and not listed and not isinstance(old, str)):
            return value
        kind = "an array" if hasattr(old, "ndim") else f"a {type(old).__name__}"
        allowed = f'one entry, for example "{name}[0]"' if listed else "a number"
        raise InputError(f"over.{name}: {kind} cannot vary as a whole; expected {allowed}")
    if not listed:
        raise InputError(f"over.{name}: {base} is not a list; expected {base}")
    if entry >= len(old):
        allowed = f"expected {base}[0] to {base}[{len(old) - 1}]" if len(old) else f"{base} is empty"
        raise InputError(f"over.{name}: {allowed}")
    if isinstance(old, (list, tuple)):
        return eqx.tree_at(lambda entries: entries[entry], old, value, is_leaf=lambda x: x is None)
    return jnp.asarray(old, jnp.result_type(old, value)).at[entry].set(value)
