"""What a system is: parameters with units and ranges, and the mathematical models its analyses need.

A system is data. It knows nothing of batches, files or analyses: under the name of each analysis it supports it
hands over a function from parameter values to the model which that analysis documents, for example a
:class:`LinearPeriodic` pair for ``floquet``. All model functions broadcast over a trailing axis: a parameter is a
scalar or an array of shape ``(...)``, and a matrix then has shape ``(n, n, ...)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._smooth import Smoothness

Values = Mapping[str, Any]
# The reversor that exchanges the first two of four states with the others.
SWAP = np.kron(np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(2))
Rows = tuple[tuple[Any, ...], ...]


def dense(rows: Rows) -> Array:
    """The matrix of these rows, ``(n, n, ...)``."""
    shape = jnp.broadcast_shapes(*(jnp.shape(entry) for row in rows for entry in row))
    return jnp.stack([jnp.stack([jnp.broadcast_to(entry, shape) for entry in row]) for row in rows])


@dataclass(frozen=True)
class LinearPeriodic:
    """The linear system ``x' = A(t) x`` over one interval ``[0, span]`` of its clock ``t``.

    ``basis(t)`` returns the functions of the clock alone (they are shared by all points of a batch) and
    ``rows(*basis(t))`` the matrix as nested tuples; an entry that vanishes identically is the integer ``0``.
    Without ``reversor`` the interval is the period and the monodromy matrix is the propagator ``Phi`` itself.
    With the reversor ``X`` (``X X = I``) the interval is half the period and the monodromy matrix is similar to
    ``X Phi^T X Phi``; with ``reversal()``, two matrices ``(R0, R1)`` as rows, to ``R0 Phi^T R1 Phi``.
    ``log_determinant()`` is the exact logarithm of its determinant (Liouville's formula), if known.
    """

    rows: Callable[..., Rows]
    span: float
    basis: Callable[[Any], tuple[Any, ...]] = lambda t: (t,)
    reversor: np.ndarray | None = None
    log_determinant: Callable[[], Any] | None = None
    reversal: Callable[[], tuple[Rows, Rows]] | None = None

    @property
    def halves(self) -> int:
        """How many of the interval make the period: 1 or 2."""
        return 1 if self.reversor is None and self.reversal is None else 2

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.rows(*self.basis(0.0)))

    @property
    def exchanges_halves(self) -> bool:
        """Whether there are four states, of which the reversor exchanges the first two with the others."""
        return self.reversor is not None and np.array_equal(self.reversor, SWAP)

    def matrix(self, t: Any) -> Array:
        """``A(t)``, shape ``(n, n, ...)``."""
        return dense(self.rows(*self.basis(t)))


@dataclass(frozen=True)
class FloquetModel:
    """The model of the analysis ``floquet``.

    ``natural`` is the system as published, over its full period in its own time; ``reduced`` is an equivalent form
    (same multipliers) that is cheaper or better conditioned. They may be the same object. ``explicit_steps(rtol)``
    predicts, from parameters given as NumPy arrays of shape ``(N,)``, how many steps ``reduced`` needs with the
    explicit scheme of order 8; None leaves the prediction to the analysis. ``hamiltonian()`` is true where ``reduced`` is a
    Hamiltonian system, whose multipliers come in pairs sigma, 1/sigma; None if it never is.
    ``stiff`` is one more form, in which the slow modes of strong damping are no differences of large entries; None if there
    is no better one than ``reduced``. The implicit scheme always takes it, the explicit one where ``strongly_damped()``
    says so, from NumPy arrays as well; None if nowhere.
    """

    natural: LinearPeriodic
    reduced: LinearPeriodic
    explicit_steps: Callable[[float], np.ndarray] | None = None
    hamiltonian: Callable[[], Any] | None = None
    stiff: LinearPeriodic | None = None
    strongly_damped: Callable[[], np.ndarray] | None = None


@dataclass(frozen=True)
class ForcedModel:
    """The model of the analysis ``forced``.

    ``field(t, y)`` is the nonlinear system ``y' = field(t, y)`` of period ``period`` and ``linear(t, y)`` its
    linearisation about ``y = 0``, forcing included. Both act on states of shape ``(n,)``. ``displacements`` are the
    indices of the components whose amplitude is reported.
    """

    field: Callable[[Any, Array], Array]
    linear: Callable[[Any, Array], Array]
    period: float
    displacements: tuple[int, ...]


@dataclass(frozen=True)
class Model:
    """How a system serves one analysis: ``build(values)`` gives the model from the values of ``parameters``.

    ``check(fixed)`` raises ``ValueError`` with one line, ``name = value: allowed is ...``, where parameters that are each
    in range do not fit together. ``fixed`` holds those that do not vary; a list is whole also if one entry varies.
    ``smooth`` tells in which coordinates an atlas of the results is best made. None: in the parameters themselves, and only
    where it is asked for (``method = "auto"`` then makes none).
    """

    build: Callable[[Values], Any]
    parameters: tuple[str, ...]
    check: Callable[[Values], None] | None = None
    smooth: Smoothness | None = None


@dataclass(frozen=True)
class Resonances:
    """Predicted values of the parameter ``axis`` at which something is expected, to be drawn over charts.

    ``values(parameters)`` maps the values of ``parameters`` (scalars or arrays of shape ``(...)``) to an array of
    shape ``(..., len(labels))``. ``multipliers`` says for each label which multiplier meets the unit circle there, ``+1``,
    ``-1`` or ``pair``, if that is known, and ``up_to(k)`` gives the same predictions for the orders 1 to k.
    """

    axis: str
    parameters: tuple[str, ...]
    labels: tuple[str, ...]
    values: Callable[[Values], np.ndarray]
    long_name: str
    multipliers: tuple[str, ...] = ()
    up_to: Callable[[int], Resonances] | None = None


@dataclass(frozen=True)
class System:
    """A drivetrain model: see the module's docstring. ``presets`` are named parameter sets of the source.

    An atlas is made of the results of ``floquet``: a model for ``atlas`` without one for it is refused (``ValueError``).

    ``time_units`` is the unit of the time of its equations, ``1`` if that is nondimensional. ``physical`` converts data in
    physical units to nondimensional parameters and back (pattern: ``cardan_units.PhysicalShaft``), None if the parameters
    have physical units themselves. ``roles`` names its ``speed`` (or frequency of excitation), which figures draw
    horizontally, and the ``angle`` and ``damping`` that design questions are about, as far as it has them.
    """

    name: str
    title: str
    source: str
    parameters: tuple[Parameter, ...]
    models: Mapping[str, Model]
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    resonances: Resonances | None = None
    time_units: str = "1"
    physical: type | None = None
    roles: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "atlas" in self.models and "floquet" not in self.models:
            raise ValueError(f"models of {self.name}: atlas needs floquet as well")

    def parameter(self, name: str) -> Parameter:
        """The parameter called ``name``; ``KeyError`` if there is none."""
        return {p.name: p for p in self.parameters}[name]
