"""A function of changing and of fixed values, split so that nothing is computed twice.

A march evaluates the entries of its matrix at every stage of every step, for every lane. :func:`staged` splits such a
function. Values that do not depend on the argument are computed once, before the march. Values that depend on the argument
and are used by several results are computed once for each evaluation and stored (see
:mod:`~drivetrain_jax.analysis.numerics.kernels`). The operations of the function and their order do not change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from drivetrain_jax.analysis.numerics.kernels import stored

# Operations that only change the shape. Before the march they would only enlarge its input.
_SHAPING = {"broadcast_in_dim", "reshape", "expand_dims", "squeeze"}


class Staged(NamedTuple):
    """``function(*arguments) = moving(fixed, *arguments)``.

    ``fixed`` holds one array for each shape, because duplicate or equal inputs of a kernel crash the compiler of jax 0.10.2.
    """

    fixed: list[Array]
    moving: Callable[..., Any]


def staged(function: Callable[..., Any], *examples: Any) -> Staged:
    """``function`` split for arguments of the shapes of ``examples``; it may use values of an outer trace."""
    # A method of a system that holds traced arrays cannot be a key of the cache of traces; a new function can.
    closed, shapes = jax.make_jaxpr(lambda *arguments: function(*arguments), return_shape=True)(*examples)
    tree = jax.tree.structure(shapes)
    jaxpr = closed.jaxpr
    before, during = _split(jaxpr)
    needed = _variables(jaxpr.outvars).union(*(_variables(equation.invars) for equation in during))
    known = [*jaxpr.constvars, *(v for equation in before for v in equation.outvars)]
    kinds: dict[Any, list[Var]] = {}
    for v in known:
        if v in needed:
            kinds.setdefault((v.aval.shape, v.aval.dtype), []).append(v)
    crossing = [v for group in kinds.values() for v in group]
    values = dict(zip(crossing, _function(jaxpr.constvars, crossing, before)(*closed.consts), strict=True))
    fixed = [jnp.stack([values[v] for v in group]) for group in kinds.values()]
    parts = _shared_once(during, jaxpr.outvars)

    def moving(fixed: Sequence[Array], *arguments: Any) -> Any:
        values = dict(zip(jaxpr.invars, arguments, strict=True))
        for group, packed in zip(kinds.values(), fixed, strict=True):
            values.update((v, packed[i]) for i, v in enumerate(group))
        for taken, given, run in parts:
            values.update(zip(given, stored(run)(*(values[v] for v in taken)), strict=True))
        return jax.tree.unflatten(tree, [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars])

    return Staged(fixed, moving)


def _split(jaxpr: Jaxpr) -> tuple[list[JaxprEqn], list[JaxprEqn]]:
    """Equations that do not depend on the arguments, and the others."""
    changing = set(jaxpr.invars)
    before, during = [], []
    for equation in jaxpr.eqns:
        if changing & _variables(equation.invars) or equation.primitive.name in _SHAPING:
            changing.update(equation.outvars)
            during.append(equation)
        else:
            before.append(equation)
    return before, during


def _shared_once(equations: Sequence[JaxprEqn], results: Iterable[Any]) -> list[tuple[list[Var], list[Var], Callable]]:
    """``(inputs, outputs, function)`` of the parts of ``equations``, in order.

    There is one part for each value that is a result or is used by several parts, with all values that only this part uses.
    """
    wanted = _variables(results)
    if any(len(equation.outvars) != 1 for equation in equations):
        return [_part(equations, [v for v in wanted if any(v in e.outvars for e in equations)])]
    head_of: dict[Var, Var] = {}
    users: dict[Var, set[Var]] = {}
    for equation in reversed(equations):
        (out,) = equation.outvars
        heads = users.get(out, set())
        # Values that do not depend on the lane are computed once.
        alone = len(heads) == 1 and out not in wanted and all(v.aval.size == out.aval.size for v in heads)  # pyright: ignore[reportAttributeAccessIssue]
        head_of[out] = next(iter(heads)) if alone else out
        for v in _variables(equation.invars):
            users.setdefault(v, set()).add(head_of[out])
    members: dict[Var, list[JaxprEqn]] = {}
    for equation in equations:
        members.setdefault(head_of[equation.outvars[0]], []).append(equation)
    made = [equation.outvars[0] for equation in equations]
    return [_part(members[head], [head]) for head in made if head in members]


def _part(own: Sequence[JaxprEqn], given: list[Var]) -> tuple[list[Var], list[Var], Callable]:
    made = {v for equation in own for v in equation.outvars}
    taken = [v for v in dict.fromkeys(v for e in own for v in e.invars if not isinstance(v, Literal)) if v not in made]
    return taken, given, _function(taken, given, own)


def _function(
    inputs: Sequence[Var], outputs: Sequence[Var], equations: Sequence[JaxprEqn]
) -> Callable[..., list[Array]]:
    names = DebugInfo("part", "staged", tuple(map(str, inputs)), tuple(map(str, outputs)))
    return jaxpr_as_fun(ClosedJaxpr(Jaxpr((), inputs, outputs, equations, debug_info=names), ()))


def _variables(atoms: Iterable[Any]) -> set[Var]:
    return {atom for atom in atoms if not isinstance(atom, Literal)}
