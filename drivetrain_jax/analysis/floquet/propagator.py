"""Propagators of linear periodic systems by diffrax, with two solvers of equal steps: explicit of order 8, or L-stable.

Both return ``Phi`` over ``[0, span]`` of a :class:`~drivetrain_jax.systems.LinearPeriodic` with the number of steps as a
traced integer, so that one compilation serves every accuracy. A step of diffrax is a piece of the span, and a piece is many
steps of the scheme. Under ``jax.vmap`` the explicit scheme marches each block of lanes as one kernel and keeps every matrix
as rows of shape ``(n, lanes)``. The entries of ``A`` at all stages of a step are evaluated together, so that common
expressions are computed once (:mod:`~drivetrain_jax.analysis.numerics.staged`).
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics import dop853
from drivetrain_jax.analysis.numerics.kernels import in_one_kernel, stored, suits_one_kernel
from drivetrain_jax.analysis.numerics.lanes import Constants, lanes_last
from drivetrain_jax.analysis.numerics.linear_algebra import matmul, solve
from drivetrain_jax.analysis.numerics.radau import radau_iia
from drivetrain_jax.analysis.numerics.staged import staged
from drivetrain_jax.systems import LinearPeriodic


class Propagator(NamedTuple):
    """``Phi = exp(log_scale) matrix``, shape ``(n, n, ...)``.

    ``growth`` is the factor by which earlier errors have grown at the end T, against errors made at T: the root mean square
    of ``|Phi(T, t)| |Phi(t, 0)| / |Phi(T, 0)|`` (1 at t = T) over the ends t of the pieces.
    """

    matrix: Array
    log_scale: Array
    growth: Array


# Order of the explicit scheme; stages of the implicit scheme, and its order for stiff problems (the stage order, instead of
# the classical order 15).
EXPLICIT_ORDER, STAGES, IMPLICIT_ORDER = 8, 8, 8
# Lanes per block: the data of a step fit into the innermost caches.
LANES = 32
# States whose largest entry is beyond exp(70), or below exp(-70), are scaled: far from overflow, even squared.
_FAR = 70.0
# Most pieces of the span; the growth of errors is measured between pieces.
PIECES = 16

Rows = list[Array]
Entries = dict[tuple[int, int], Array]
_NOTHING = Constants(())


class _Record(NamedTuple):
    """``y(t) = exp(log_scale) state``, and the covariance at t of errors made at the ends of all steps so far.

    Errors are independent, and each is as large as ``y`` at its time. With the propagator P of a step the covariance obeys
    ``C' = P C P^T + |y|^2 I``.
    """

    log_scale: Array
    covariance: Array


class LinearTerm(diffrax.AbstractTerm):
    """A linear periodic system as a term of diffrax."""

    system: LinearPeriodic

    def vf(self, t: Any, y: Any, args: Any) -> Array:
        """``A(t) y``."""
        return self.system.vf(t, y, args)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        """The time between ``t0`` and ``t1``."""
        del kwargs
        return t1 - t0

    def prod(self, vf: Any, control: Any) -> Any:
        """``vf`` times the time."""
        return vf * control


class EqualSteps(diffrax.AbstractSolver):
    """A solver of linear periodic terms: each step of diffrax is ``count`` equal steps of its scheme.

    The state is a vector or a matrix of vectors. A state far from 1 is scaled, and the solver's state holds the logarithm
    of the scale.
    """

    count: Any
    ORDER: ClassVar[int]
    term_structure: ClassVar = LinearTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: LinearTerm) -> int:
        """Order of the errors, for stiff problems too."""
        return self.ORDER

    def init(self, terms: LinearTerm, t0: Any, t1: Any, y0: Array, args: Any) -> _Record:
        """The record at the start: no scaling and no errors."""
        return _Record(jnp.zeros(()), jnp.zeros((len(y0), len(y0))))

    def func(self, terms: LinearTerm, t0: Any, y0: Array, args: Any) -> Array:
        """``A(t) y``."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: LinearTerm, t0: Any, t1: Any, y0: Array, args: Any, solver_state: _Record, made_jump: Any
    ) -> tuple[Array, None, dict[str, Array], _Record, diffrax.RESULTS]:
        """The state at t1."""
        del args, made_jump
        system, forwards = _unwrapped(terms)
        given = (*self.piece(system, forwards * t0, forwards * t1), y0.reshape(len(y0), -1), solver_state)
        y1, record = lanes_last(_onward, _NOTHING, given, ())
        y1 = y1.reshape(y0.shape)
        return y1, None, {"y0": y0, "y1": y1}, record, diffrax.RESULTS.successful

    @abc.abstractmethod
    def piece(self, system: LinearPeriodic, t0: Any, t1: Any) -> tuple[Array, Array]:
        """The propagator from t0 to t1 as a matrix ``(n, n)`` and the logarithm of its factor."""


def _unwrapped(terms: Any) -> tuple[LinearPeriodic, Any]:
    """The system of a term that diffrax may have wrapped, and 1, or -1 if it solves backwards."""
    return (terms.system, 1) if isinstance(terms, LinearTerm) else (terms.term.system, terms.direction)


class Order8(EqualSteps):
    """The 12-stage Runge-Kutta scheme of order 8 (DOP853) in equal steps, for blocks of lanes under ``jax.vmap``."""

    ORDER: ClassVar = EXPLICIT_ORDER

    def piece(self, system: LinearPeriodic, t0: Any, t1: Any) -> tuple[Array, Array]:
        """See :class:`EqualSteps`."""
        # The other fields of the system are not used.
        arrays, rest = eqx.partition(LinearPeriodic(system.rows, 1.0, system.basis), eqx.is_array)
        shared = jnp.asarray(t0, float), jnp.asarray(t1, float), self.count
        if not jax.tree.leaves(arrays) or not system.is_pytree:
            # No arrays to batch, or a function that may depend on unknown arrays.
            matrix, log_scale = explicit_march(system, *shared)
            return matrix[..., 0], log_scale[0]
        return lanes_last(_block, Constants(rest), arrays, shared, LANES)


def _block(rest: Constants, arrays: LinearPeriodic, shared: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    return explicit_march(eqx.combine(arrays, rest.tree), *shared)


class Radau(EqualSteps):
    """Radau IIA collocation with 8 stages (order 15, L-stable) in equal panels."""

    ORDER: ClassVar = IMPLICIT_ORDER

    def piece(self, system: LinearPeriodic, t0: Any, t1: Any) -> tuple[Array, Array]:
        """See :class:`EqualSteps`. The product is rescaled after each panel, so that strong damping does not underflow.

        The stage values solve ``Y_i - h sum_j a_ij A(t_j) Y_j = I``; the last one is the panel's propagator.
        """
        a, c = radau_iia(STAGES)
        h, n = (t1 - t0) / self.count, system.size
        right = jnp.tile(jnp.eye(n), (STAGES, 1))
        at_nodes = jax.vmap(system.matrix)

        def body(step: Array, carry: tuple) -> tuple:
            product, log_scale = carry
            blocks = jnp.einsum("ij,jkl->ikjl", h * a, at_nodes(t0 + (step + c) * h)).reshape(STAGES * n, STAGES * n)
            product = solve(jnp.eye(STAGES * n) - blocks, right)[-n:] @ product
            size = jnp.max(jnp.abs(product))
            size = jnp.where(size > 0, size, 1.0)
            return product / size, log_scale + jnp.log(size)

        return jax.lax.fori_loop(0, self.count, body, (jnp.eye(n), jnp.zeros(())))


class EqualStepSize(diffrax.ConstantStepSize):
    """``count`` equal steps, which may be traced."""

    count: Any

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: None, args: Any, func: Any, error_order: Any) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        """End of the first step, and the state."""
        return super().init(terms, t0, t1, y0, (t1 - t0) / self.count, args, func, error_order)


def propagator(
    system: LinearPeriodic, steps: Array, pieces: Array | int = 1, solver: type[EqualSteps] = Order8
) -> Propagator:
    """``Phi`` of one point by ``steps`` equal steps (or panels) of ``solver``, a multiple of ``pieces``.

    The growth of errors is measured between the ``pieces`` of the span, at most ``PIECES``. Between two breakpoints there
    are as many steps as in a span without any.
    """
    return through(system.parts, steps, pieces, solver)


def through(
    parts: Sequence[LinearPeriodic], steps: Array, pieces: Array | int = 1, solver: type[EqualSteps] = Order8
) -> Propagator:
    """The :func:`propagator` over the spans of ``parts`` one after another, in ``steps`` steps each."""
    matrix, record = jnp.eye(parts[0].size), None
    for part in parts:
        end = diffrax.diffeqsolve(
            LinearTerm(part),
            solver(steps // pieces),
            t0=0.0,
            t1=part.span,
            dt0=None,
            y0=matrix,
            stepsize_controller=EqualStepSize(pieces),
            saveat=diffrax.SaveAt(t1=True, solver_state=True),
            adjoint=diffrax.ForwardMode(),
            max_steps=PIECES,
            throw=False,
            solver_state=record,
        )
        matrix, record = end.ys[0], end.solver_state  # pyright: ignore[reportOptionalSubscript]
    count = len(matrix) * len(parts) * pieces
    growth = jnp.sqrt(jnp.trace(record.covariance) / (count * jnp.sum(matrix**2)))  # pyright: ignore[reportOptionalMemberAccess]
    return Propagator(matrix, record.log_scale, growth)  # pyright: ignore[reportOptionalMemberAccess]


def _onward(_: Constants, varying: tuple[Array, Array, Array, _Record], __: tuple) -> tuple[Array, _Record]:
    """State and record after a step, all with the lanes as last axis."""
    matrix, log_scale, state, record = varying
    state, moved = stored(_moved)(matrix, state, record.covariance)
    size = jnp.max(jnp.abs(state), axis=(0, 1))
    total = log_scale + jnp.log(jnp.where(size > 0, size, 1.0))
    near = jnp.abs(total) <= _FAR
    factor = jnp.where(near, jnp.exp(log_scale), 1 / jnp.where(size > 0, size, 1.0))
    state = state * factor
    unit = jnp.eye(len(matrix)).reshape(*matrix.shape[:2], *(1,) * (matrix.ndim - 2))
    covariance = moved * factor**2 + jnp.sum(state**2, axis=(0, 1)) * unit
    return state, _Record(record.log_scale + jnp.where(near, 0.0, total), covariance)


def _moved(piece: Array, state: Array, covariance: Array) -> tuple[Array, Array]:
    return matmul(piece, state), matmul(matmul(piece, covariance), jnp.swapaxes(piece, 0, 1))


def explicit_march(system: LinearPeriodic, t0: Array, t1: Array, count: Array | int) -> tuple[Array, Array]:
    """``Phi`` from t0 to t1 of all lanes, the last axis of arrays that vary, by ``count`` steps."""
    varying = jax.tree.leaves((eqx.filter(system, eqx.is_array), t0, t1))
    lanes = max((np.shape(x)[-1] for x in varying if np.ndim(x)), default=1)
    times = jnp.zeros((dop853.STAGES, np.size(t0)))
    split = staged(system.entries, *jax.eval_shape(system.basis, times))
    suits = suits_one_kernel(lambda t: system.rows(*system.basis(t)), times)
    mark = in_one_kernel if suits else lambda function: function

    def march(count: Array | int, start: Array, h: Array, fixed: list[Array]) -> Rows:
        step = partial(_explicit_step, system.basis, partial(split.moving, fixed), start, h)
        return jax.lax.fori_loop(0, count, step, identity(system.size, lanes))

    rows = mark(march)(count, t0, (t1 - t0) / count, split.fixed)
    return jnp.stack(rows), jnp.zeros(lanes)


def identity(n: int, lanes: int) -> Rows:
    """The rows of the unit matrix."""
    return [jnp.concatenate([jnp.full((1, lanes), float(i == j)) for j in range(n)]) for i in range(n)]


def _explicit_step(
    basis: Callable[[Array], tuple[Array, ...]],
    entries: Callable[..., Entries],
    start: Array,
    h: Array,
    number: Array,
    y: Rows,
) -> Rows:
    """One step from ``start + number * h``: the entries at all stages first, then stage after stage."""
    at_stages = entries(*basis(start + (number + jnp.asarray(dop853.C)[:, None]) * h))
    slopes: list[Rows] = []
    for stage, weights in enumerate(dop853.A):
        state = advanced(y, h, weights[:stage], slopes)
        slopes.append(stored(partial(slopes_at, stage))(at_stages, state))
    return advanced(y, h, dop853.B, slopes)


def slopes_at(stage: int, at_stages: Entries, state: Rows) -> Rows:
    """``A y`` at one stage."""
    slopes: Rows = [0] * len(state)  # pyright: ignore[reportAssignmentType]
    for (i, j), entry in at_stages.items():
        slopes[i] = slopes[i] + _at(entry, stage) * state[j]
    return slopes


def _at(entry: Array, stage: int) -> Array:
    return entry[min(stage, entry.shape[0] - 1)] if entry.ndim > 1 else entry


def advanced(y: Rows, h: Array, weights: Any, slopes: list[Rows]) -> Rows:
    """``y + h sum(weights * slopes)``."""
    terms = [(float(w), slope) for w, slope in zip(weights, slopes, strict=True) if w != 0]
    if not terms:
        return y

    def moved(y: Rows, h: Array, *used: Rows) -> Rows:
        return [x + h * sum(w * k[i] for (w, _), k in zip(terms, used, strict=True)) for i, x in enumerate(y)]

    return stored(moved)(y, h, *(slope for _, slope in terms))
