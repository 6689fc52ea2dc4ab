"""What an analysis is: named results of one point (or of one line of a path axis), and the solvers that give them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import FIRST_FAILURE, Dimension, Parameter, Variable
from drivetrain_jax.systems import System


class Outcome(IntEnum):
    """What became of a point. From ``NOT_CONVERGED`` (``FIRST_FAILURE``) on, what could not be computed is NaN."""

    SUCCESS = 0
    TOLERANCE_NOT_MET = 1  # the value is stored with its error, which exceeds the target
    NOT_CONVERGED = 2
    STEP_LIMIT = 3
    NOT_FINITE = 4
    LOST = 5  # the process that computed it died every time

    @property
    def has_value(self) -> bool:
        return self < FIRST_FAILURE


OUTCOME = Variable(
    "outcome", "1", "outcome of the computation", dtype="int8", flags=tuple(o.name.lower() for o in Outcome)
)
RTOL = Parameter("rtol", "1", "target relative error of the results", default=1e-10, lower=1e-14, upper=1e-2)
# Solvers of diffrax that an option may name: explicit ones of order 8 and 5, and a stiff one.
DIFFRAX_SOLVERS = ("Dopri8", "Dopri5", "Tsit5", "Kvaerno5")
# Seconds beyond which no motion is asked for, thirty years of it; and steps beyond which none is begun: at a microsecond
# each they would take eleven days.
MOST_SECONDS, MOST_STEPS = 1e9, 1e12


@dataclass(frozen=True)
class Request:
    """What a scene asks of an analysis: the results wanted, its method and options (defaults filled in)."""

    outputs: tuple[str, ...]
    method: str
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Solver:
    """One way to compute the requested results of one point.

    ``solve(values, effort)`` returns every requested variable and ``outcome``, the lanes as LAST axis. ``values`` holds all
    parameters of the model: those that vary as JAX arrays of lanes ``(N,)``, the others as numbers
    (:func:`~drivetrain_jax.analysis.numerics.lanes.over_lanes` makes that of a function of one point). The values of a path
    axis arrive as a whole, a NumPy array ``(L,)``; results have the path as FIRST axis, and ``chunk`` counts lines.
    ``effort`` is a traced integer, the largest that ``effort(columns)`` predicts in the batch (columns: NumPy arrays
    of shape ``(N,)``; a count of steps or the like; by default the same for all points). The engine gives every point
    to the solver for which ``effort * unit_cost`` is smallest and runs batches of ``chunk`` points of similar effort.
    ``steps(values)`` predicts the effort of every lane from traced values, if ``solve`` makes use of it.
    ``march`` marks integrations in time, ``short_loops`` what works through its lanes by some tens: both are compiled
    otherwise (``numerics.kernels.compiler_options``). One point of a ``lengthy`` solver takes as long as a compilation.
    """

    name: str
    solve: Callable[[Mapping[str, Any], Array], dict[str, Array]]
    effort: Callable[[Mapping[str, np.ndarray]], np.ndarray] = lambda columns: np.ones(())
    steps: Callable[[Mapping[str, Any]], Array] | None = None
    unit_cost: float = 1.0
    chunk: int = 256
    march: bool = False
    short_loops: bool = False
    lengthy: bool = False


def stacked(jacobian: Any) -> Array:
    """A pytree of derivatives by each parameter as one Jacobian ``(..., P)``."""
    return jnp.stack(jax.tree.leaves(jacobian), axis=-1)


def forward_derivatives(
    solvers: Callable[[type[System], Request], tuple[Solver, ...]],
    system: type[System],
    request: Request,
    parameters: Any,
    constants: Any,
    results: Mapping[str, Array],
) -> dict[str, Array]:
    """Jacobians by forward differentiation of the first of ``solvers`` itself, see :class:`Analysis`."""
    solve = solvers(system, request)[0].solve
    names = [n for n, x in results.items() if jnp.issubdtype(x.dtype, jnp.inexact) and not n.endswith("_error")]

    def found(parameters: Any) -> dict[str, Array]:
        solved = solve(eqx.combine(parameters, constants.tree), jnp.int64(1))
        return {name: solved[name] for name in names}

    jacobians = jax.jacfwd(found)(parameters)
    return {name: stacked(jacobian) for name, jacobian in jacobians.items()}


@dataclass(frozen=True, eq=False)
class Analysis:
    """Named results and how to get them.

    ``methods`` maps each method to the names of the options it uses, the first method being the default; ``options``
    describes all of them, ``method_titles`` the methods.
    ``solvers(system, request)`` gives the candidates of the requested method.
    ``dimensions(system, request, fixed)`` describes the dimensions of the results besides those of the sweep; ``fixed``
    holds the parameters that do not vary (a list is whole also if one entry varies). It raises
    :class:`~drivetrain_jax._errors.InputError` where a request and these parameters do not fit together.
    ``lacks(system)`` maps the results and methods that cannot be had of a system to what messages say of them.
    ``derivatives(system, request, parameters, constants, results)`` gives Jacobians ``(..., P)`` of results at one point by
    all P ``parameters`` (arrays; ``constants`` hold the rest), as far as there are any.
    ``path_axis(request)`` names the axis that is consumed whole, if there is one. A ``continuous`` analysis takes ranges
    for axes and gives a function of the parameters instead of values on a grid.
    """

    name: str
    title: str
    variables: tuple[Variable, ...]
    default_outputs: tuple[str, ...]
    methods: Mapping[str, tuple[str, ...]]
    options: tuple[Parameter, ...]
    solvers: Callable[[type[System], Request], tuple[Solver, ...]]
    dimensions: Callable[[type[System], Request, Mapping[str, Any]], tuple[Dimension, ...]] = lambda *_: ()
    lacks: Callable[[type[System]], Mapping[str, str]] = lambda _: {}
    path_axis: Callable[[Request], str | None] = lambda _: None
    derivatives: Callable[..., Mapping[str, Array]] | None = None
    continuous: bool = False
    method_titles: Mapping[str, str] = field(default_factory=dict)

    def variable(self, name: str) -> Variable:
        """The result called ``name``; ``KeyError`` if there is none."""
        return {v.name: v for v in self.variables}[name]
