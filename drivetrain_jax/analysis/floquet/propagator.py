"""Propagators of linear periodic systems by Gauss collocation, as a solver of diffrax whose single step is the whole span.

A system ``q' = p, p' = P q + E p`` is marched in its second derivatives, any other system in its slopes
(:mod:`~drivetrain_jax.analysis.numerics.collocation`). A step marches a coarse and a fine number of panels, compares the
monodromy matrices and doubles the panels until they agree or differ by rounding alone. Under ``jax.vmap`` each block of
lanes is one kernel with all of this, so that a difficult point repeats only its own block. The number of panels is a traced
integer: one compilation serves every accuracy. The entries of ``A`` at all nodes of a panel are evaluated together, so that
common expressions are computed once (:func:`staged`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, DebugInfo, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from drivetrain_jax.analysis.floquet.direct import Monodromy, Propagator, compare, unknown
from drivetrain_jax.analysis.numerics.collocation import Scheme, first_order, gauss, panel, second_order, small_panel
from drivetrain_jax.analysis.numerics.kernels import any_lane, in_one_kernel, on_cpu, stored, suits_one_kernel
from drivetrain_jax.analysis.numerics.lanes import Constants, blocks_first, blocks_joined, lanes_last, traced_once
from drivetrain_jax.analysis.numerics.linear_algebra import largest, matmul, square_sum
from drivetrain_jax.systems import LinearPeriodic

# A function of changing and of fixed values, split so that nothing is computed twice.
#
# A march evaluates the entries of its matrix at every stage of every step, for every lane. :func:`staged` splits such a
# function. Values that do not depend on the argument are computed once, before the march. Values that depend on the argument
# and are used by several results are computed once for each evaluation and stored (see
# :mod:`~drivetrain_jax.analysis.numerics.kernels`). The operations of the function and their order do not change.


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
        for taken, made, run in parts:
            values.update(zip(made, stored(run)(*(values[v] for v in taken)), strict=True))
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


def _part(equations: Sequence[JaxprEqn], outputs: list[Var]) -> tuple[list[Var], list[Var], Callable]:
    made = {v for equation in equations for v in equation.outvars}
    taken = [
        v for v in dict.fromkeys(v for e in equations for v in e.invars if not isinstance(v, Literal)) if v not in made
    ]
    return taken, outputs, _function(taken, outputs, equations)


def _function(
    inputs: Sequence[Var], outputs: Sequence[Var], equations: Sequence[JaxprEqn]
) -> Callable[..., list[Array]]:
    names = DebugInfo("part", "staged", tuple(map(str, inputs)), tuple(map(str, outputs)))
    return jaxpr_as_fun(ClosedJaxpr(Jaxpr((), inputs, outputs, equations, debug_info=names), ()))


def _variables(atoms: Iterable[Any]) -> set[Var]:
    return {atom for atom in atoms if not isinstance(atom, Literal)}


# Nodes of a panel, and order of the errors.
STAGES, ORDER = 5, 10
# Lanes per block: with 8 or 16 the compiler unrolls to scalar code, and the data of 64 leave the innermost cache.
LANES = 32
# Unknowns of a node, and states, beyond which the compiler of jax 0.10.2 fails on one kernel with all of a march; and states
# of a chain, beyond which it shares products among threads.
_SMALL, _FEW, _LONG = 6, 8, 12
# Most doublings of the predicted number of panels, and most panels.
_MAX_REFINEMENTS, MAX_PANELS = 6, 2**19
# Relative truncation below which panels are short enough to show the order of the scheme.
_SMALL_TRUNCATION = 1e-9
# Gauss schemes of s stages turn a decay by exp(-D), if it is fast, into a decay by exp(-2 s (s + 1) n^2/D) in n panels.
_UNDAMPED = 2.0 * STAGES * (STAGES + 1)
# Angle of an oscillation in a panel beyond which two numbers of panels may agree by accident.
_RESOLVED = 4.0
# Decay over the span beyond which damping is strong.
_STRONG = 8.0
# Periods of the iteration for small multipliers, and the largest logarithm of a ratio in it.
_PERIODS, _FARTHEST = 5, 600.0
# States beyond this size, or below its inverse, are scaled: far from overflow, even squared and after another panel.
_FAR = 1e60

Entries = dict[tuple[int, int], Array]


class LinearTerm(diffrax.AbstractTerm):
    """A linear periodic system as a term of diffrax."""

    system: LinearPeriodic

    def vf(self, t: Any, y: Any, args: Any) -> Array:
        """``A(t) y``."""
        return self.system.vf(t, y, args)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        """The time between ``t0`` and ``t1``."""
        return t1 - t0

    def prod(self, vf: Any, control: Any) -> Any:
        """``vf`` times the time."""
        return vf * control


class EqualStepSize(diffrax.ConstantStepSize):
    """``count`` equal steps, which may be traced."""

    count: Any

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: None, args: Any, func: Any, error_order: Any) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        """End of the first step, and the state."""
        return super().init(terms, t0, t1, y0, (t1 - t0) / self.count, args, func, error_order)


class Gauss(diffrax.AbstractSolver):
    """Gauss collocation of order 10 for a :class:`LinearTerm`, in one step over the span of its system.

    The step takes ``panels / ratio`` panels, rounded up, then ``ratio`` times as many, then twice as many, until the
    monodromy matrices of two numbers of panels agree to ``rtol``. The state is the matrix of the propagator, or vectors. The
    solver's state is the :class:`~drivetrain_jax.analysis.floquet.direct.Monodromy` matrix with its error.
    """

    panels: Any
    rtol: Any
    ratio: Any = 2
    # Of the batch that the point is expected to be a part of: its trace is that of the batch.
    lanes: int = eqx.field(static=True, default=1)
    # A small program, whose compilation takes less time and whose panels take more.
    small: bool = eqx.field(static=True, default=False)
    term_structure: ClassVar = LinearTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: LinearTerm) -> int:
        """Order of the errors."""
        return ORDER

    def init(self, terms: LinearTerm, t0: Any, t1: Any, y0: Array, args: Any) -> Monodromy:
        """No matrix yet."""
        return unknown(len(y0))

    def func(self, terms: LinearTerm, t0: Any, y0: Array, args: Any) -> Array:
        """``A(t) y``."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: LinearTerm, t0: Any, t1: Any, y0: Array, args: Any, solver_state: Monodromy, made_jump: Any
    ) -> tuple[Array, None, dict[str, Array], Monodromy, diffrax.RESULTS]:
        """The state at the end of the span."""
        system = terms.system if isinstance(terms, LinearTerm) else terms.term.system
        propagator, monodromy = self.solved(system)
        y1 = matmul(propagator, y0.reshape(len(y0), -1)).reshape(y0.shape)
        return y1, None, {"y0": y0, "y1": y1}, monodromy, diffrax.RESULTS.successful

    def solved(self, system: LinearPeriodic) -> tuple[Array, Monodromy]:
        """The propagator over the span, and the monodromy matrix."""
        shared = jnp.asarray(self.panels), jnp.asarray(self.rtol, float), jnp.asarray(self.ratio)
        return _of_one(_refined_by_small if self.small else _refined, system, shared, self.lanes)


def monodromy(
    system: LinearPeriodic, panels: Array, rtol: Any, ratio: Any = 2, lanes: int = 1, small: bool = False
) -> Monodromy:
    """The monodromy matrix of one point of a batch of ``lanes``, from ``panels`` predicted panels on.

    ``small``: by a program that compiles sooner and computes longer.
    """
    end = diffrax.diffeqsolve(
        LinearTerm(system),
        Gauss(panels, rtol, ratio, lanes, small),
        t0=0.0,
        t1=1.0,
        dt0=None,
        y0=jnp.eye(system.size),
        stepsize_controller=EqualStepSize(1),
        saveat=diffrax.SaveAt(solver_state=True),
        adjoint=diffrax.ForwardMode(),
        max_steps=1,
        throw=False,
    )
    return end.solver_state  # pyright: ignore[reportReturnType]


def march(system: LinearPeriodic, count: Array) -> Propagator:
    """The propagator of one point over the span, in ``count`` panels between two breakpoints."""
    state = _State.start(system.size, 1)
    for part in system.parts:
        panels = Panels(part)
        state = panels.through(panels.fixed, state, count, jnp.array(True))
    return jax.tree.map(lambda x: x[..., 0], state.propagator(count * len(system.parts)))


def factored(system: LinearPeriodic, panels: Array, lanes: int = 1) -> Factored:
    """The :class:`Factored` matrix of one point of a batch, in ``panels`` panels and in twice as many, the first axis."""
    return _of_one(_in_factors, system, (jnp.asarray(panels),), lanes)


def _of_one(compute: Callable[..., Any], system: LinearPeriodic, shared: tuple[Array, ...], lanes: int) -> Any:
    """``compute(constants, arrays, shared)`` of one system, the last axis of its results being the lanes."""
    arrays, rest = eqx.partition(system, eqx.is_array)
    if not jax.tree.leaves(arrays) or not system.is_pytree:
        # No arrays to batch, or a function that may depend on unknown arrays.
        return jax.tree.map(lambda x: x[..., 0], compute(Constants(rest), arrays, shared))
    return lanes_last(partial(traced_once, compute), Constants(rest), arrays, shared, expected=lanes)


def _in_factors(fixed: Constants, arrays: LinearPeriodic, shared: tuple[Array]) -> Factored:
    return _by_blocks(_factors_of_block, fixed, arrays, shared, _FEW)


def _refined(fixed: Constants, arrays: LinearPeriodic, shared: tuple[Array, Array, Array]) -> tuple[Array, Monodromy]:
    """The propagator and the monodromy matrix of all lanes, the last axis of ``arrays``."""
    return _by_blocks(partial(_agreeing, False), fixed, arrays, shared, _LONG)


def _refined_by_small(
    fixed: Constants, arrays: LinearPeriodic, shared: tuple[Array, Array, Array]
) -> tuple[Array, Monodromy]:
    """:func:`_refined` by a small program."""
    return _by_blocks(partial(_agreeing, True), fixed, arrays, shared, _LONG)


def _by_blocks(
    compute: Callable[..., Any], fixed: Constants, arrays: LinearPeriodic, shared: tuple[Array, ...], longest: int
) -> Any:
    """``compute(marches, fixed values, ends, determinant, lanes, *shared)`` of all lanes, in one kernel if possible.

    ``longest``: most states of a chain for which ``compute`` compiles as one kernel.
    """
    lanes = max((x.shape[-1] for x in jax.tree.leaves(arrays) if x.ndim), default=1)
    size = LANES if lanes > LANES and on_cpu() else lanes
    blocks = jax.tree.map(lambda x: blocks_first(x, size) if x.ndim and x.shape[-1] == lanes else x, arrays)
    marches: list[Panels] = []

    def prepared(arrays: LinearPeriodic) -> tuple[Any, Any, Any]:
        """Values that do not change during the march, for all blocks at once."""
        system = eqx.combine(arrays, fixed.tree)
        marches[:] = [Panels(part) for part in system.parts]
        return [march.fixed for march in marches], system.ends(), system.log_determinant and system.log_determinant()

    axes = jax.tree.map(lambda x, cut: 0 if cut.ndim > x.ndim else None, arrays, blocks)
    leaves, tree = jax.tree.flatten(jax.vmap(prepared, (axes,), axis_size=-(-lanes // size))(blocks))
    # One array for each shape, because equal inputs of a kernel crash the compiler of jax 0.10.2.
    kinds = list(dict.fromkeys(x.shape for x in leaves))
    packed = [jnp.stack([x for x in leaves if x.shape == kind], axis=1) for kind in kinds]

    def all_blocks(shared: tuple[Array, ...], packed: list[Array]) -> Any:
        def block(packed: list[Array]) -> Any:
            rows = {kind: iter(stack) for kind, stack in zip(kinds, packed, strict=True)}
            values, ends, determinant = jax.tree.unflatten(tree, [next(rows[x.shape]) for x in leaves])
            return compute(marches, values, ends, determinant, size, *shared)

        return jax.lax.map(block, packed)

    small = [march.d <= _SMALL and march.size <= (longest if march.chain else _FEW) for march in marches]
    in_one = all(small) and all(march.suits for march in marches)
    mark = in_one_kernel if in_one else lambda function: function
    return jax.tree.map(lambda x: blocks_joined(x, lanes), mark(all_blocks)(shared, packed))


def _agreeing(
    small: bool,
    marches: list[Panels],
    fixed: list[Fixed],
    ends: Array | None,
    determinant: Array | None,
    lanes: int,
    panels: Array,
    rtol: Array,
    ratio: Array,
) -> tuple[Array, Monodromy]:
    """The finer of two propagators whose monodromy matrices agree, for one block of ``lanes``."""
    n = marches[0].size

    def run(count: Array, records: Array) -> Propagator:
        state = _State.start(n, lanes)
        for march, values in zip(marches, fixed, strict=True):
            state = march.through(values, state, count, records, small)
        propagator = state.propagator(len(marches) * count)
        squared = propagator.squared if marches[0].d == n else jnp.maximum(propagator.decay, 0.0) / _STRONG
        return propagator._replace(squared=squared)

    def unfinished(state: tuple) -> Array:
        number, count, propagator, z, stalled = state
        going = ~z.met & ~stalled & (jnp.isfinite(propagator.matrix[0, 0]) | (number < 4))
        return (number < 2) | ((number < 2 + _MAX_REFINEMENTS) & (count <= MAX_PANELS) & any_lane(going))

    def refine(state: tuple) -> tuple:
        number, count, coarse, before, _ = state
        recorded = number != 1
        fine = run(count, recorded)
        coarse = coarse.in_units_of(fine.log_scale)
        fine = Propagator(*fine[:2], *(jnp.where(recorded, *pair) for pair in zip(fine[2:], coarse[2:], strict=True)))
        missed = (fine.stiffness > _RESOLVED * count) & (fine.decay < fine.stiffness)
        undamped = jnp.where(fine.decay > 0, -_UNDAMPED * (1.0 * count) ** 2 / fine.decay, -jnp.inf)
        fine = fine._replace(undamped=jnp.where(missed, jnp.inf, undamped))
        # Half as many panels may not show the order yet, unless the system predicts how many it needs: count on less.
        gain = jnp.where(number == 1, count / first, 2.0) ** jnp.where(ratio > 2, ORDER, ORDER - 3)
        z = jax.lax.cond(
            number > 0, lambda: compare(ends, determinant, coarse, fine, len(marches) * count, gain, rtol), lambda: none
        )
        # Twice the panels divide a small truncation by hundreds; what stays is rounding, which grows with their number.
        stalled = (number > 1) & (z.truncation < _SMALL_TRUNCATION) & (z.truncation > before.truncation / 4)
        # The whole ratio: with 5 panels after 2 the bound would be 100 times that of 8 after 2.
        return number + 1, jnp.where(number == 0, ratio * first, 2 * count), fine, z, stalled

    first = jnp.maximum(-(-panels // ratio), 1)
    start = _State.start(n, lanes).propagator(first)
    none = jax.tree.map(lambda x: jnp.broadcast_to(x[..., None], (*x.shape, lanes)), unknown(n))
    stalled = jnp.zeros(lanes, bool)
    _, _, propagator, z, _ = jax.lax.while_loop(unfinished, refine, (jnp.int32(0), first, start, none, stalled))
    return propagator.matrix, z


class Factored(NamedTuple):
    """A monodromy matrix by QR decompositions of its factors, whose small multipliers keep their relative accuracy.

    In an orthogonal basis the matrix is ``turn exp(logs) upper``: ``turn`` ``(n, n)`` is orthogonal and nearly block
    triangular, ``logs`` ``(n,)`` fall, and ``upper`` ``(n, n)`` is triangular with unit diagonal. ``rounding`` ``(n,)`` is
    the sum over all factors of their norm in units of the diagonal entry, the growth of relative errors.
    """

    turn: Array
    logs: Array
    upper: Array
    rounding: Array


def _factors_of_block(
    marches: list[Panels], fixed: list[Fixed], ends: Array | None, determinant: Array | None, lanes: int, panels: Array
) -> Factored:
    """By simultaneous iteration over several periods: subspaces of separate moduli are those of the last period."""
    n = marches[0].size
    unit = jnp.broadcast_to(jnp.eye(n)[..., None], (n, n, lanes))
    # No subspace of a decoupled system may be missing from the first vectors.
    mixed = jnp.broadcast_to(np.linalg.qr(np.vander(np.arange(1, n + 1) / n))[0][..., None], (n, n, lanes))
    none = jnp.zeros((n, lanes))

    def through(march: Panels, values: Fixed, count: Array, number: Array, state: Factored) -> Factored:
        back = number >= count
        factor = march.propagator(values, count, jnp.where(back, 2 * count - 1 - number, number))
        if ends is not None:
            start, end = ends.reshape(2, n, n, -1)
            factor = jnp.where(back, jnp.swapaxes(factor, 0, 1), factor)
            factor = jnp.where(number == count, stored(matmul)(factor, end), factor)
            factor = jnp.where(number == 2 * count - 1, stored(matmul)(start, factor), factor)
        return stored(_multiplied)(factor, state)

    def period(count: Array, turn: Array) -> tuple[Factored, Array]:
        state = Factored(turn, none, unit, none)
        for march, values in zip(marches, fixed, strict=True):
            length = count if ends is None else 2 * count
            state = jax.lax.fori_loop(0, length, partial(through, march, values, count), state)
        return state._replace(turn=stored(matmul)(jnp.swapaxes(turn, 0, 1), state.turn)), state.turn

    def of_count(count: Array) -> Factored:
        start = Factored(unit, none, unit, none), mixed
        return jax.lax.fori_loop(0, _PERIODS, lambda _, last: period(count, last[1]), start)[0]

    return jax.lax.map(of_count, jnp.stack([panels, 2 * panels]))


def _multiplied(factor: Array, state: Factored) -> Factored:
    """``factor`` times the product so far: its QR decomposition (Gram and Schmidt, twice), in the scales of ``state``."""
    n, columns, rows = len(factor), [], []
    moved = matmul(factor, state.turn)
    norm = jnp.sqrt(square_sum(factor))
    for j in range(n):
        column, row = moved[:, j], [jnp.zeros_like(norm)] * n
        for _ in range(2):
            for i, unit in enumerate(columns):
                part = sum(unit[k] * column[k] for k in range(n))
                column, row[i] = column - part * unit, row[i] + part
        row[j] = jnp.sqrt(sum(x**2 for x in column))
        columns.append(column / row[j])
        rows.append(jnp.stack(row))
    triangle, turn = jnp.stack(rows, axis=1), jnp.stack(columns, axis=1)
    scale = jnp.stack([triangle[i, i] for i in range(n)])
    # The scales of earlier columns are larger, once the subspaces are sorted.
    ratio = jnp.exp(jnp.clip(state.logs - state.logs[:, None], -_FARTHEST, _FARTHEST))
    upper = matmul(triangle / scale[:, None] * ratio, state.upper)
    return Factored(turn, state.logs + jnp.log(scale), upper, state.rounding + norm / scale)


class _State(NamedTuple):
    """``exp(log_scale) matrix`` at a time t, with three records of the march so far.

    ``covariance`` is that of errors at t which were made at the ends of all panels: independent, and in each row as large as
    the terms of its products. With the propagator P of a panel it obeys ``C' = P C P^T + D``, where D is the diagonal of
    ``terms terms^T``, with the ``terms = |P| |matrix|`` of the last product. ``stiffness`` is the integral of the largest
    rate max |a_ij a_ji|^(1/2), which no scaling of states changes, and ``decay`` that of ``-tr A``.
    """

    matrix: Array
    log_scale: Array
    covariance: Array
    terms: Array
    stiffness: Array
    decay: Array

    @classmethod
    def start(cls, n: int, lanes: int) -> _State:
        unit = jnp.broadcast_to(jnp.eye(n)[..., None], (n, n, lanes))
        return cls(unit, jnp.zeros(lanes), jnp.zeros_like(unit), unit, jnp.zeros(lanes), jnp.zeros(lanes))

    def scaled_rows(self, d: int, factor: Any) -> _State:
        """The states from number ``d`` on in another unit."""
        n = len(self.matrix)
        if d == n:
            return self
        rows = jnp.where((np.arange(n) < d)[:, None], 1.0, factor)
        covariance = self.covariance * rows[:, None] * rows
        matrix, terms = self.matrix * rows[:, None], self.terms * rows[:, None]
        return self._replace(matrix=matrix, covariance=covariance, terms=terms)

    def propagator(self, panels: Any) -> Propagator:
        n = len(self.matrix)
        variance = sum(self.covariance[i, i] for i in range(n)) / (n * panels)
        return Propagator(
            self.matrix,
            self.log_scale,
            jnp.sqrt(variance),
            self.terms,
            self.stiffness,
            self.decay,
            0 * self.decay,
            0 * self.decay - jnp.inf,
        )


class Fixed(NamedTuple):
    """Values of a system that do not change during the march: of its entries, the span, and the unit of displacements."""

    values: list[Array]
    span: Array
    unit: Array


class Panels:
    """Panels of equal length over the span of a system without breakpoints."""

    def __init__(self, system: LinearPeriodic) -> None:
        unit, tableau = system.displacement_unit, gauss(STAGES)
        self.size, self.basis = system.size, system.basis
        self.scheme: Scheme = first_order(tableau) if unit is None else second_order(tableau)
        self.d = system.size // len(self.scheme.start)
        times = jnp.zeros((STAGES, 1))
        split = staged(system.entries, *jax.eval_shape(system.basis, times))
        self.moving = split.moving
        # Only neighbours are coupled, as in a chain of more than two.
        places = jax.eval_shape(lambda *at: system.entries(*at), *jax.eval_shape(system.basis, times))
        couplings = [(i - self.d, j % self.d) for i, j in places if i >= self.d]
        self.chain = unit is not None and self.d > 2 and all(abs(i - j) < 2 for i, j in couplings)
        self.suits = suits_one_kernel(lambda t: system.rows(*system.basis(t)), times)
        self.fixed = Fixed(split.fixed, jnp.asarray(system.span, float), jnp.asarray(1.0 if unit is None else unit))

    def propagator(self, fixed: Fixed, count: Array, number: Array, few: bool = False) -> Array:
        """The propagator of one of ``count`` panels, ``(n, n, lanes)``, by a small program for ``few`` lanes."""
        h = fixed.span / count
        rows = jnp.where((np.arange(self.size) < self.d)[:, None], 1.0, h * fixed.unit)
        return self._panel(self.coefficients(fixed, h, number), few) * rows / rows[:, None]

    def _panel(self, coefficients: tuple[Array, ...], small: bool) -> Array:
        """P of one panel, by a ``small`` program where the compiler takes longer than the computation."""
        if small and not self.chain:
            return small_panel(self.scheme, coefficients)
        return panel(self.scheme, coefficients, self.chain)

    def through(self, fixed: Fixed, state: _State, count: Array, records: Array, small: bool = False) -> _State:
        """The state after ``count`` panels; with ``records`` its covariance and stiffness too."""
        h = fixed.span / count
        # The displacements' second state is their change in a panel.
        unit = h * fixed.unit
        onward = partial(self._onward, fixed, h, records, small)
        state = jax.lax.fori_loop(0, count, onward, state.scaled_rows(self.d, unit))
        return state.scaled_rows(self.d, 1 / unit)

    def coefficients(self, fixed: Fixed, h: Array, number: Array) -> tuple[Array, ...]:
        """``E_t`` of the scheme at the nodes of one panel, ``(s, d, d, lanes)``."""
        times = (number + self.scheme.nodes[:, None]) * h
        entries = self.moving(fixed.values, *self.basis(times))
        return stored(self._blocks)(entries, h, h * fixed.unit)

    def _blocks(self, entries: Entries, h: Array, unit: Array) -> tuple[Array, ...]:
        if self.d == self.size:
            return (self._block(entries, 0, 0, h),)
        return self._block(entries, self.d, self.d, h), self._block(entries, self.d, 0, h * unit)

    def _block(self, entries: Entries, row: int, column: int, factor: Any) -> Array:
        places = list(np.ndindex(self.d, self.d))
        block = [jnp.atleast_1d(factor * entries.get((row + i, column + j), jnp.zeros(()))) for i, j in places]
        lanes = max(entry.shape[-1] for entry in block)
        block = [jnp.broadcast_to(entry, (STAGES, lanes)) for entry in block]
        if self.d > 2:
            return jnp.stack(block, axis=1).reshape(STAGES, self.d, self.d, lanes)
        # For few entries a sum is cheaper: the compiler turns a concatenation into a choice for every number.
        masks = np.eye(len(places)).reshape(-1, self.d, self.d, 1)
        return sum(mask * entry[:, None, None] for mask, entry in zip(masks, block, strict=True))  # pyright: ignore[reportReturnType]

    def _onward(self, fixed: Fixed, h: Array, records: Array, small: bool, number: Array, state: _State) -> _State:
        coefficients = self.coefficients(fixed, h, number)
        moved = self._panel(coefficients, small)
        matrix = stored(matmul)(moved, state.matrix)
        factor = stored(_factor)(matrix)
        matrix = stored(jnp.multiply)(matrix, factor)

        def recorded() -> tuple[Array, ...]:
            carried = stored(matmul)(moved, state.covariance)
            terms = stored(matmul)(jnp.abs(moved), jnp.abs(state.matrix))
            covariance = stored(_covariance)(carried, moved, factor, terms)
            stiffness, decay = stored(self._rates)(coefficients)
            return covariance, stored(jnp.multiply)(terms, factor), state.stiffness + stiffness, state.decay + decay

        records_now = state[2:]
        records_now = jax.lax.cond(records, recorded, lambda: records_now)
        # Logarithms cost as much as half a panel.
        log_scale = jax.lax.cond(
            any_lane(factor != 1), lambda: state.log_scale - jnp.log(factor), lambda: state.log_scale
        )
        return _State(matrix, log_scale, *records_now)

    def _rates(self, coefficients: tuple[Array, ...]) -> tuple[Array, Array]:
        """The largest rate and ``-tr A``, integrated over the panel."""
        first = coefficients[0]
        pairs = [jnp.abs(first[:, i, j] * first[:, j, i]) for i in range(self.d) for j in range(i + 1)]
        pairs += [jnp.abs(e[:, i, i]) for e in coefficients[1:] for i in range(self.d)]
        weights = self.scheme.left[-1][:, None]
        largest_rate = jnp.sqrt(reduce(jnp.maximum, pairs))
        decay = reduce(jnp.subtract, (first[:, i, i] for i in range(self.d)), jnp.zeros(()))
        integrals = [reduce(jnp.add, weights * x) for x in (largest_rate, decay)]
        return integrals[0], integrals[1]


def _covariance(carried: Array, moved: Array, factor: Array, terms: Array) -> Array:
    squares = jnp.asarray(sum(terms[:, j] ** 2 for j in range(len(terms))))
    return (matmul(carried, jnp.swapaxes(moved, 0, 1)) + squares[:, None] * np.eye(len(terms))[..., None]) * factor**2


def _factor(matrix: Array) -> Array:
    """The factor that brings a matrix far from 1 back to 1."""
    size = largest(matrix)
    return jnp.where((size > _FAR) | ((size < 1 / _FAR) & (size > 0)), 1 / size, 1.0)
