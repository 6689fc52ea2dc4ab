"""Linear periodic systems: the models of the analyses ``floquet`` and ``forced``."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax.systems._rows import Rows, dense

# Distance from a breakpoint at which its two sides are evaluated, over the span: more than the rounding of a time.
_ASIDE = 1e-15
# Fractions of the span, spread by the golden ratio, at which a matrix is tested for damping.
_INSTANTS = np.arange(1, 17) * 0.6180339887498949 % 1


def _vanishes(entry: Any) -> bool:
    return isinstance(entry, int) and entry == 0


def _time(t: Any) -> tuple[Any, ...]:
    return (t,)


def _tuples(matrix: Any) -> Rows | None:
    return None if matrix is None else tuple(tuple(map(float, row)) for row in matrix)


# The reversor that exchanges the first two of four states with the others.
SWAP = _tuples(np.kron(np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(2)))


class _Piece(eqx.Module):
    """The rows of a system between two breakpoints, at the fraction s of the piece, which is the unit of time."""

    rows: Callable[..., Rows]
    start: Any
    length: Any
    aside: Any
    basis: Callable[[Any], tuple[Any, ...]] = eqx.field(static=True)

    def __call__(self, s: Any) -> Rows:
        # The ends of a piece are evaluated on its own side of the breakpoints.
        t = self.start + jnp.clip(s * self.length, self.aside, self.length - self.aside)
        rows = self.rows(*self.basis(t))
        return tuple(tuple(0 if _vanishes(entry) else self.length * entry for entry in row) for row in rows)


class LinearPeriodic(eqx.Module):
    """The linear system ``x' = A(t) x`` over one interval ``[0, span]`` of its clock ``t``.

    ``basis(t)`` returns the functions of the clock alone, which all points of a batch share. ``rows(*basis(t))`` is the
    matrix as nested tuples; an entry that vanishes identically is the integer ``0``. A span that depends on parameters is
    marched in fractions of itself, without a common ``basis``. Without ``reversor`` the interval is the period and the
    monodromy matrix is the propagator ``Phi`` itself. With the reversor ``X`` (``X X = I``) the interval is half the period
    and the monodromy matrix is similar to ``X Phi^T X Phi``. With ``reversal()``, two matrices ``(R0, R1)`` as rows, the
    monodromy matrix is similar to ``R0 Phi^T R1 Phi``. ``log_determinant()`` is the exact logarithm of the determinant of
    the monodromy matrix (Liouville's formula), if known. ``breakpoints`` are the instants, rising within the span, at which
    the matrix jumps or has a kink: steps of integrations end there.

    The system is a pytree if its functions are pytrees, such as the bound methods of an Equinox module. Its term for any
    solver of diffrax is ``diffrax.ODETerm(system.vf)``.
    """

    rows: Callable[..., Rows]
    span: Any
    basis: Callable[[Any], tuple[Any, ...]] = eqx.field(default=_time, static=True)
    reversor: Rows | None = eqx.field(default=None, static=True, converter=_tuples)
    log_determinant: Callable[[], Any] | None = None
    reversal: Callable[[], tuple[Rows, Rows]] | None = None
    breakpoints: tuple[Any, ...] = ()

    def __check_init__(self) -> None:
        ends = (0.0, *self.breakpoints, self.span)
        # Values of a batch are not checked: a lane with a wrong one has no value.
        if any(isinstance(x, jax.core.Tracer) or np.ndim(x) for x in ends):
            return
        if not self.span > 0:
            raise InputError(f"span = {self.span:g}: allowed is 0 < span")
        for i, value in enumerate(self.breakpoints):
            if not ends[i] < value < self.span:
                raise InputError(
                    f"breakpoints[{i}] = {value:g}: allowed is {ends[i]:g} < breakpoints[{i}] < {self.span:g}"
                )

    @property
    def parts(self) -> tuple[LinearPeriodic, ...]:
        """The system between its breakpoints, in order: one of span 1 for each piece.

        Without breakpoints, and with a plain number as span, the system itself. A piece of negative length, from a
        breakpoint outside of the span, is NaN.
        """
        if not self.breakpoints and isinstance(self.span, float | int):
            return (self,)
        ends = [jnp.asarray(x, float) for x in (0.0, *self.breakpoints, self.span)]
        pieces = []
        for start, end in pairwise(ends):
            length = jnp.where(end > start, end - start, jnp.nan)
            aside = jnp.minimum(_ASIDE * self.span, length / 2)
            pieces.append(LinearPeriodic(_Piece(self.rows, start, length, aside, self.basis), 1.0))
        return tuple(pieces)

    @property
    def is_pytree(self) -> bool:
        """True if all functions are pytrees; any other function may depend on unknown arrays."""
        rows = self.rows.rows if isinstance(self.rows, _Piece) else self.rows
        functions = rows, self.log_determinant, self.reversal
        return all(isinstance(f, eqx.Module | jax.tree_util.Partial | None) for f in functions)

    @property
    def halves(self) -> int:
        """Number of spans in a period: 1 or 2."""
        return 1 if self.reversor is None and self.reversal is None else 2

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.square_rows(*self.basis(0.0)))

    @property
    def displacement_unit(self) -> Any:
        """u if the system is ``q' = u p, p' = P q + E p`` with a constant u, which its rows show as the numbers 0 and 1."""
        rows, unit = (self.rows.rows, self.rows.length) if isinstance(self.rows, _Piece) else (self.rows, 1.0)
        matrix = rows(*self.basis(0.0))
        half = len(matrix) // 2
        upper = [(entry, j == i + half) for i in range(half) for j, entry in enumerate(matrix[i])]
        is_pair = len(matrix) == 2 * half and all(isinstance(x, int | float) and x == one for x, one in upper)
        return unit if is_pair else None

    def ends(self) -> tuple[Rows, Rows] | None:
        """``R0`` and ``R1`` of the reversal, or the reversor twice; None over a whole period."""
        if self.reversal is not None:
            return self.reversal()
        return None if self.reversor is None else (self.reversor, self.reversor)

    @property
    def exchanges_halves(self) -> bool:
        """True if there are four states, and the reversor exchanges the first two with the others."""
        return self.reversor == SWAP

    def square_rows(self, *basis: Any) -> Rows:
        """``rows(*basis)``; raises :class:`~drivetrain_jax.InputError` unless they are as many as the entries of each."""
        rows = self.rows(*basis)
        if not isinstance(rows, (tuple, list)) or not all(isinstance(row, (tuple, list)) for row in rows):
            raise InputError(
                f"rows: {type(rows).__name__}; allowed are tuples of tuples, ((a, b), (c, d)) for two states"
            )
        for i, row in enumerate(rows):
            if len(row) != len(rows):
                raise InputError(f"rows[{i}]: {len(row)} entries; allowed are {len(rows)}, as many as there are rows")
        return rows

    def entries(self, *basis: Any) -> dict[tuple[int, int], Array]:
        """The entries of ``A`` that do not vanish identically, by row and column."""
        rows = self.square_rows(*basis)
        return {
            (i, j): jnp.asarray(x, float) for i, row in enumerate(rows) for j, x in enumerate(row) if not _vanishes(x)
        }

    def matrix(self, t: Any) -> Array:
        """``A(t)``, shape ``(n, n, ...)``."""
        return dense(self.square_rows(*self.basis(t)))

    def vf(self, t: Any, y: Any, args: Any) -> Array:
        """``A(t) y`` of a state or a matrix of states ``y``."""
        del args
        # Written as sums: under vmap small matrix products are slower.
        rows = self.square_rows(*self.basis(t))
        return jnp.stack([sum(a * y[j] for j, a in enumerate(row) if not _vanishes(a)) + 0 * y[0] for row in rows])


class FloquetModel(eqx.Module):
    """The model of the analysis ``floquet``.

    ``natural`` is the system as published, over its full period in its own time. ``reduced`` is an equivalent form (same
    multipliers) of an atlas. ``direct`` integrates ``marched``, a form over the same clock; None stands for ``reduced``, and
    all may be the same object. It integrates ``damped`` where ``strongly_damped()`` is true, a form whose slow modes are not
    differences of large entries; None means nowhere. ``panels(rtol)`` predicts the panels of Gauss collocation, from
    parameters as NumPy arrays of shape ``(N,)`` or traced arrays; None leaves the prediction to the analysis.
    ``hamiltonian()`` is true where ``reduced`` is a Hamiltonian system (without damping), whose multipliers come in pairs
    sigma, 1/sigma; None: where the states of ``natural`` are coordinates and momenta, as for x'' = -K(t) x with symmetric K.
    """

    natural: LinearPeriodic
    reduced: LinearPeriodic
    marched: LinearPeriodic | None = None
    damped: LinearPeriodic | None = None
    strongly_damped: Callable[[], Any] | None = None
    panels: Callable[[float], Any] | None = None
    hamiltonian: Callable[[], Any] | None = None

    @property
    def direct(self) -> LinearPeriodic:
        """The form that ``direct`` integrates."""
        return self.reduced if self.marched is None else self.marched

    def is_hamiltonian(self) -> Any:
        """True without damping: as declared, else where ``J A`` of ``natural`` is symmetric at all of some instants."""
        if self.hamiltonian is not None:
            return self.hamiltonian()
        if self.natural.size % 2:
            return False
        half, found = self.natural.size // 2, jnp.bool_(True)
        for part in self.natural.parts:
            matrices = jax.vmap(part.matrix)(_INSTANTS * part.span)
            rotated = jnp.concatenate([matrices[:, half:], -matrices[:, :half]], axis=1)
            found &= jnp.all(rotated == jnp.swapaxes(rotated, 1, 2), axis=(0, 1, 2))
        return found


class ForcedModel(eqx.Module):
    """The model of the analysis ``forced``.

    ``field(t, y)`` is the nonlinear system ``y' = field(t, y)`` of period ``period`` and ``linear(t, y)`` its
    linearisation about ``y = 0``, forcing included. Both act on states of shape ``(n,)``. ``displacements`` are the
    indices of the components whose amplitude is reported.
    """

    field: Callable[[Any, Array], Array]
    linear: Callable[[Any, Array], Array]
    period: Any
    displacements: tuple[int, ...] = eqx.field(static=True)
