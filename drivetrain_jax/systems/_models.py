"""Models that systems return for analyses: linear periodic systems, flows, springs, shafts and piecewise oscillators.

Also sine and cosine of many angles, for fields of flows and closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError

# Matrices as nested tuples of entries; an entry that vanishes identically is the integer ``0``.


Rows = tuple[tuple[Any, ...], ...]


def dense(rows: Rows) -> Array:
    """The matrix of ``rows`` as an array, ``(n, n, ...)``."""
    shape = jnp.broadcast_shapes(*(jnp.shape(entry) for row in rows for entry in row))
    return jnp.stack([jnp.stack([jnp.broadcast_to(entry, shape) for entry in row]) for row in rows])


# Linear periodic systems: the models of the analyses ``floquet`` and ``forced``.


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
            raise InputError(f"span = {self.span:g}: expected 0 < span")
        for i, value in enumerate(self.breakpoints):
            if not ends[i] < value < self.span:
                raise InputError(
                    f"breakpoints[{i}] = {value:g}: expected {ends[i]:g} < breakpoints[{i}] < {self.span:g}"
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
        piece = self.rows
        whole, unit = (piece, piece.length) if isinstance(piece, _Piece) else (self, 1.0)
        matrix = whole.rows(*whole.basis(0.0))
        half = len(matrix) // 2
        upper = [(entry, j == i + half) for i in range(half) for j, entry in enumerate(matrix[i])]
        is_pair = len(matrix) == 2 * half and all(isinstance(x, int | float) and x == one for x, one in upper)
        return unit if is_pair else None

    def ends(self) -> Array | None:
        """``R0`` and ``R1`` of the reversal, or the reversor twice, ``(2, n, n, ...)``; None over a whole period."""
        if self.reversal is not None:
            return jnp.stack(jnp.broadcast_arrays(*map(dense, self.reversal())))
        return None if self.reversor is None else jnp.asarray((self.reversor, self.reversor))

    @property
    def exchanges_halves(self) -> bool:
        """True if there are four states, and the reversor exchanges the first two with the others."""
        return self.reversor == SWAP

    def square_rows(self, *basis: Any) -> Rows:
        """``rows(*basis)``; raises :class:`~drivetrain_jax.InputError` unless they are as many as the entries of each."""
        rows = self.rows(*basis)
        if not isinstance(rows, (tuple, list)) or not all(isinstance(row, (tuple, list)) for row in rows):
            raise InputError(f"rows: got {type(rows).__name__}, expected tuples ((a, b), (c, d)) for two states")
        for i, row in enumerate(rows):
            if len(row) != len(rows):
                raise InputError(f"rows[{i}]: {len(row)} entries; expected {len(rows)}, as many as there are rows")
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
        half, symmetric = self.natural.size // 2, jnp.bool_(True)
        for part in self.natural.parts:
            matrices = jax.vmap(part.matrix)(_INSTANTS * part.span)
            rotated = jnp.concatenate([matrices[:, half:], -matrices[:, :half]], axis=1)
            symmetric &= jnp.all(rotated == jnp.swapaxes(rotated, 1, 2), axis=(0, 1, 2))
        return symmetric


class ForcedModel(eqx.Module):
    """The model of the analysis ``forced``.

    ``field(t, y)`` is the nonlinear system ``y' = field(t, y)`` of period ``period`` and ``linear(t, y)`` its
    linearisation about ``y = 0``, forcing included. Both act on states of shape ``(n,)``. ``displacements`` are the
    indices of the components whose amplitude is reported, and ``torques`` the rows ``(k, n)`` that give the torques there
    from a state. ``size`` is n if it depends on the parameters.
    """

    field: Callable[[Any, Array], Array]
    linear: Callable[[Any, Array], Array]
    period: Any
    displacements: tuple[int, ...] = eqx.field(static=True)
    size: int | None = eqx.field(static=True, default=None)
    torques: Any = None

    def peaks(self, n: int, torques: bool) -> Array:
        """The rows of the displacements, and of the ``torques`` if they are asked for, in a state of size n."""
        rows = jnp.eye(n)[jnp.array(self.displacements)]
        return jnp.concatenate([rows, self.torques]) if torques else rows


Components = tuple[Any, ...]
# Turns are split at this binary digit: integer multiples of the upper part are exact up to 2^27 turns.
_SPLIT = 2.0**26


class Flow(eqx.Module):
    """An initial value problem whose explicit time enters through clocks: ``y' = f(theta_1, theta_2, ..., y)``.

    The angle of clock i turns ``turns[i]`` times per strobe. Time is counted as ``(strobe + fraction) * period`` with an
    integer strobe, so the angles are as accurate after millions of strobes as at the start. An autonomous system has no
    clock, and any interval can be its strobe.

    ``field(angles, y)`` returns the components of ``y'`` (per unit of time) from the angles of the clocks [rad] and the
    components of ``y``; each is a number or an array of shape ``(...)``, so a batch may be a trailing axis.

    - ``start``: components of ``y`` at t = 0.
    - ``period``: time between two strobes.
    - ``turns``: turns of each clock per strobe. A clock that defines the strobe has the integer 1; its angle is then the
      same for every member of a batch.
    - ``scale``: factor from one unit of each component to the reported units.
    - ``divergence(angles, y)``: trace of the field's Jacobian in closed form, if known. Its mean is the sum of all
      Lyapunov exponents.
    - ``phases``: components with a constant rate. Their exponents are always 0, so the verdict ignores them. (The clocks
      are not components.)
    - ``cyclic``: components that are angles up to whole turns. They may grow although the motion is bounded.
    - ``fastest``: largest angular frequency of the motion, if known; step sizes follow from it. Without ``fastest``,
      ``lyapunov`` makes 48 steps per strobe by default.
    """

    field: Callable[[Components, Any], Components]
    start: Components
    period: Any
    turns: Components = ()
    scale: tuple[Any, ...] | None = None
    divergence: Callable[[Components, Any], Any] | None = None
    phases: tuple[int, ...] = eqx.field(default=(), static=True)
    cyclic: tuple[int, ...] = eqx.field(default=(), static=True)
    fastest: Any = None

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.start)

    def angles(self, strobe: Any, fraction: Any) -> Components:
        """Angles of the clocks at ``(strobe + fraction) * period``, in [rad], reduced by the whole turns up to ``strobe``.

        ``strobe`` is an integer (array), ``fraction`` a number (array), usually in [0, 1]. The error is one rounding of the
        reduced angle, as long as no clock has made more than 2^27 turns.
        """
        return tuple(2 * math.pi * (_turned(turns, strobe) + turns * fraction) for turns in self.turns)

    def vector(self, strobe: Any, fraction: Any, y: Array) -> Array:
        """``y'`` as one array of shape ``(n, ...)`` for ``y`` of the same shape."""
        return jnp.stack(jnp.broadcast_arrays(*self.field(self.angles(strobe, fraction), y)))


def _turned(turns: Any, strobe: Any) -> Any:
    """Fractional part of ``turns * strobe``."""
    if isinstance(turns, int):
        return 0.0
    # The product with the upper part is exact; the product with the lower part is small.
    upper = jnp.round(turns * _SPLIT) / _SPLIT
    whole = upper * strobe
    return (whole - jnp.floor(whole)) + (turns - upper) * strobe


# Masses joined by springs: the models of the analyses ``modes`` and ``harmonic_response``.


class Block(eqx.Module):
    """An invariant part of a spring system: its natural angular frequencies are the singular values of ``factor``.

    ``factor`` has shape (rows, n, ...), rows >= n. The orthonormal ``basis`` (dofs, n, copies, ...) embeds the part into the
    mass-weighted coordinates ``M^(1/2) q``; every frequency occurs ``copies`` times. ``family`` (n,) is the family of each
    column of the orthonormal ``frame`` (n, n, ...), which is None for the identity. ``polar`` (n,) marks columns that are
    motions along x, to make the vectors of a pair of equal frequencies unique.
    """

    factor: Array
    family: np.ndarray
    polar: np.ndarray
    basis: Array
    frame: Array | None = None

    @property
    def copies(self) -> int:
        """Multiplicity of each frequency."""
        return self.basis.shape[2]


class SpringSystem(eqx.Module):
    """``M q'' + B^T diag(k) B q = 0`` with the diagonal mass matrix ``M``.

    ``extensions`` (springs, dofs, ...) is ``B``: the extension of each spring per unit of each coordinate;
    ``stiffness`` (springs, ...), ``mass`` (dofs, ...). ``blocks`` are an exact decomposition into invariant parts;
    ``whole`` is the system as one block. ``asymmetry`` (...), from 0 to 1, measures the coupling of the families. ``dofs``
    and ``body_names`` name coordinates and bodies; ``bodies`` (dofs,) is the number of the body of each coordinate.
    ``families`` is the number of families of modes.
    """

    extensions: Array
    stiffness: Array
    mass: Array
    blocks: tuple[Block, ...]
    whole: Block
    asymmetry: Array
    dofs: tuple[str, ...] = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)
    bodies: np.ndarray
    families: int = eqx.field(static=True)


class DrivenSprings(eqx.Module):
    """``M q'' + B^T diag(k) (B q - e) = f`` with harmonic errors e of the springs and forces f.

    ``force`` (dofs, ...), complex, is ``B^T diag(k) e + f``: amplitude times ``exp(i phase)`` for each coordinate.
    """

    springs: SpringSystem
    force: Array


def weighted_factor(extensions: Array, stiffness: Array, mass: Array) -> Array:
    """``diag(sqrt k) B M^(-1/2)``, shape (springs, dofs, ...)."""
    return jnp.sqrt(stiffness)[:, None] * extensions / jnp.sqrt(mass)


class PiecewiseLinearOscillator(eqx.Module):
    """A driven oscillator with a play in its spring: linear in each of three regions.

    ``u'' + damping u' + stiffness f_s(u) = B0 + B1 cos(omega t)`` with ``f_s = u - (1 - alpha) b`` for ``u > b``,
    ``alpha u`` for ``|u| <= b``, ``u + (1 - alpha) b`` for ``u < -b``. The damper acts always, or in contact only
    (``|u| > b``): the force then jumps at a flank, unless ``u' = 0`` there. Every field is a number or an array, all of one
    common shape ``(...)``.

    ``damping`` is c/I [1/s], ``stiffness`` k/I [1/s^2], ``alpha`` the stiffness within the play over the stiffness in
    contact [1], ``b`` half the play [m], ``B0`` and ``B1`` mean and amplitude of the drive [m/s^2], ``omega`` the frequency
    of the drive [rad/s].

    An ``unbalance`` [m] adds ``unbalance omega^2`` to B1 along a range of frequencies. The equation itself, and all that
    solves it at one frequency, take :meth:`driven_at`. The number 0.0 stands for none.

    ``damps_play`` is false if the damper acts in contact only; exact methods serve both.
    """

    damping: Any
    stiffness: Any
    alpha: Any
    b: Any
    B0: Any
    B1: Any
    omega: Any
    unbalance: Any = 0.0
    damps_play: bool = eqx.field(static=True, default=True)

    @staticmethod
    def check_method(damps_play: bool, method: str) -> None:
        """Raise :class:`InputError` for an approximate method, unless the damper always acts."""
        if not damps_play and method != "exact":
            raise InputError(f"options.method = {method!r}: expected 'exact' for a damper in contact only")

    @property
    def follows(self) -> bool:
        """True if the amplitude of the drive depends on its frequency."""
        return not (isinstance(self.unbalance, float) and self.unbalance == 0.0)

    def amplitude(self, omega: Any) -> Any:
        """``B1 + unbalance omega^2`` [m/s^2]."""
        return self.B1 + self.unbalance * omega**2 if self.follows else self.B1

    def driven_at(self, omega: Any) -> PiecewiseLinearOscillator:
        """The oscillator at the frequency ``omega``, its whole amplitude in B1."""
        return replace(self, omega=omega, B1=self.amplitude(omega), unbalance=0.0)

    @property
    def oscillates(self) -> Any:
        """True where free motion is underdamped in contact and within the play."""
        # A square that overflows is infinite, and so compares as it should.
        with np.errstate(over="ignore"):
            return (self.damping / 2) ** 2 < self.stiffness * jnp.minimum(1.0, self.alpha)

    @property
    def period(self) -> Any:
        """``T = 2 pi/omega`` [s]."""
        return 2 * np.pi / self.omega

    def restoring(self, u: Any) -> Array:
        """``f_s(u)`` in the units of ``u``, in the common shape of ``u`` and the parameters."""
        # u minus the force lost in the play is exact for b = 0 and continuous in floating point.
        return u - (1 - self.alpha) * jnp.clip(u, -self.b, self.b)

    def field(self, t: Any, state: Array) -> Array:
        """``(u', u'')`` of ``state = (u, u')``, shape ``(2, ...)``.

        Its derivative jumps where :meth:`switching` changes sign, and the field itself with a damper in contact only:
        integrators must locate the jumps.
        """
        u, v = state
        damping = self.damping if self.damps_play else jnp.where(jnp.abs(u) > self.b, self.damping, 0.0)
        drive = self.B0 + self.B1 * jnp.cos(self.omega * t)
        return jnp.stack(jnp.broadcast_arrays(v, drive - damping * v - self.stiffness * self.restoring(u)))

    def switching(self, state: Array) -> Array:
        """Distances ``(u - b, u + b)`` to the flanks, where the derivative jumps, shape ``(2, ...)``."""
        return jnp.stack(jnp.broadcast_arrays(state[0] - self.b, state[0] + self.b))


class UnderdampedOscillator(PiecewiseLinearOscillator):
    """An oscillator whose free motion oscillates in contact and within the play; kernels omit the overdamped flow."""


# The lateral vibration of a stepped shaft: the model of the analyses ``critical_speeds`` and ``whirl``.


class Shaft(NamedTuple):
    """A shaft of ``n`` uniform segments between ``n + 1`` nodes (the ends A, D and the joints).

    Every field is an array whose first axis counts segments, nodes or joints; further axes are lanes and broadcast
    against each other. ``None`` leaves an effect out of the computation altogether.

    ``length`` [m], ``EI`` [N m^2]: shape ``(n, ...)``, positive. ``rhoA`` [kg/m]: ``(n, ...)``, 0 for a segment without
    mass. ``k`` [N/m]: springs to ground at the nodes, ``(n + 1, ...)``, 0 to infinity (a rigid support). ``m`` [kg]: lumped
    masses at the nodes, ``(n + 1, ...)``.
    ``k_hinge`` [N m/rad]: rotational stiffness of the joints, ``(n - 1, ...)``, 0 (a hinge) to infinity (rigid).
    ``kGA`` [N]: shear stiffness ``(n, ...)``, infinity for a segment without shear; ``rhoI`` [kg m]: rotary inertia per
    length ``(n, ...)``. With one of these two a segment is a Timoshenko beam, otherwise an Euler-Bernoulli beam.
    ``k_rot`` [N m/rad]: rotational springs to ground at the nodes, ``(n + 1, ...)``, 0 between the ends, up to infinity (a
    clamped end). ``inertia`` [kg m^2]: rotary inertia of discs at the nodes, ``(n + 1, ...)``; half of it sits on each side
    of an elastic joint.
    ``polar`` [kg m^2]: polar inertia of the discs, ``(n + 1, ...)``; ``rhoIp`` [kg m]: that per length, ``(n, ...)``. They
    act if the shaft turns: ``spin``, ``(2, ...)``, holds its speed [rad/s], negative for backward whirl, and 1 over the
    order of critical speeds; see :meth:`turning`.
    ``k_y`` [N/m]: springs to ground at the nodes in a second plane, ``(n + 1, ...)``.
    """

    length: Any
    EI: Any
    rhoA: Any
    k: Any
    m: Any = None
    k_hinge: Any = None
    kGA: Any = None
    rhoI: Any = None
    k_rot: Any = None
    inertia: Any = None
    polar: Any = None
    rhoIp: Any = None
    spin: Any = None
    k_y: Any = None

    @property
    def segments(self) -> int:
        """The number of segments ``n``."""
        return len(self.length)

    @property
    def is_timoshenko(self) -> bool:
        """True if shear or rotary inertia is part of the model."""
        return self.kGA is not None or self.rhoI is not None or self.rhoIp is not None

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the lanes of all fields together."""
        return jnp.broadcast_shapes(*(field.shape[1:] for field in self if field is not None))  # pyright: ignore[reportReturnType]

    def mirrored(self) -> Shaft:
        """The same shaft seen from its other end."""
        return Shaft(*(None if field is None else field[::-1] for field in self))._replace(spin=self.spin)

    def turning(self, p: Array) -> Shaft:
        """The shaft whose rotary inertias include the gyroscopic effect, ``I - (spin[0]/p + spin[1]) I_p``.

        ``p`` has shape ``(..., *lanes)`` and so have these inertias, behind their first axis.
        """
        if self.spin is None:
            return self
        share = self.spin[0] / p + self.spin[1]
        axes = (slice(None), *(None,) * (p.ndim + 1 - self.length.ndim))

        def less(inertia: Any, polar: Any) -> Any:
            return inertia if polar is None else (0.0 if inertia is None else inertia[axes]) - share * polar[axes]

        return self._replace(inertia=less(self.inertia, self.polar), rhoI=less(self.rhoI, self.rhoIp))

    def spread(self) -> Shaft:
        """The same shaft with every field spread over all lanes."""
        lanes = self.lanes
        return Shaft(*(None if f is None else jnp.broadcast_to(f, (len(f), *lanes)) for f in self.arrays()))

    def arrays(self) -> Shaft:
        """The shaft with all fields as arrays in double precision, with the axes of the lanes."""
        fields = Shaft(*(None if field is None else stack(field) for field in self))
        axes = len(fields.lanes) + 1

        def aligned(field: Array) -> Array:
            return field.reshape(len(field), *(1,) * (axes - field.ndim), *field.shape[1:])

        return Shaft(*(None if field is None else aligned(field) for field in fields))


def entries_of(value: Any, count: int, none: float = 0.0) -> tuple[Any, ...]:
    """One entry for each of ``count`` places from a list, one number for all of them, or an empty list."""
    if not isinstance(value, tuple):
        return (value,) * count
    return value or (none,) * count


def stack(entries: Any) -> Array:
    """One array from numbers and arrays whose lanes broadcast, shape ``(len(entries), ...)``."""
    if hasattr(entries, "ndim"):
        return jnp.asarray(entries, float)
    return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(entry, float) for entry in entries)))


# Sine and cosine of many angles at once; XLA's own functions for double precision on the CPU work on one lane at a time.
#
# The method is argument reduction by three parts of pi/2 (Cody & Waite) with the polynomials of fdlibm (``__kernel_sin``,
# ``__kernel_cos``; S. Moshier, Sun Microsystems 1993). Errors are within 1.6 units in the last place of the larger of sine
# and cosine, for angles up to 2^20. Fused with other operations the functions are five to eight times faster than
# ``jnp.sin``.


_TWO_OVER_PI = 0.6366197723675814
# Parts of 33, 33 and 53 bits: multiples up to 2^20 of the first two are exact.
_HALF_PI = (
    float.fromhex("0x1.921fb54400000p+0"),
    float.fromhex("0x1.0b4611a600000p-34"),
    float.fromhex("0x1.3198a2e037073p-69"),
)
_SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


def horner(coefficients: tuple[float, ...], x: Array) -> Array:
    """The polynomial in ``x`` with these coefficients, highest power first."""
    total = jnp.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x + coefficient
    return total


@jax.custom_jvp
def sincos(x: Any) -> tuple[Array, Array]:
    """``(sin x, cos x)`` of an angle in [rad], any shape; |x| up to 2^20, NaN for NaN and infinity."""
    return _sincos(jnp.asarray(x, float))


# Compiled functions are traced once for all calls, which come by the hundred in the stages of a march.
@jax.jit
def _sincos(x: Array) -> tuple[Array, Array]:
    quarter = jnp.floor(x * _TWO_OVER_PI + 0.5)
    r = x - quarter * _HALF_PI[0] - quarter * _HALF_PI[1] - quarter * _HALF_PI[2]
    z = r * r
    sine = r + r * z * horner(_SINE, z)
    cosine = 1.0 - (0.5 * z - z * z * horner(_COSINE, z))
    # quarter mod 4 in floating point, because vectors of 64-bit integers are slower.
    turn = quarter - 4.0 * jnp.floor(0.25 * quarter)
    odd = (turn == 1.0) | (turn == 3.0)
    first, second = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(turn >= 2.0, -first, first), jnp.where((turn == 1.0) | (turn == 2.0), -second, second)


@sincos.defjvp
def _sincos_tangent(primals: tuple, tangents: tuple) -> tuple:
    sine, cosine = sincos(*primals)
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])


def sin(x: Any) -> Array:
    """``sin x``: see :func:`sincos`."""
    return sincos(x)[0]


def cos(x: Any) -> Array:
    """``cos x``: see :func:`sincos`."""
    return sincos(x)[1]
