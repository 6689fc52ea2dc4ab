"""Floquet analysis of a linear periodic system: multipliers, spectral radius with error bound, and verdict of one point.

``direct`` integrates a form of the system by diffrax with a solver for linear periodic terms, Gauss collocation of order 10.
``atlas`` evaluates a whole scene from polynomials compared with direct solves (see ``drivetrain_jax.atlas``), and solves
points in gaps. ``auto`` chooses the cheaper method.
``diffrax`` uses one of diffrax's own solvers: in equal steps for the reduced form, or in adaptive steps for the system as
published over its full period (``form = "published"``), with other coordinates, clock and factorisation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._quantities import Dimension, Parameter
from drivetrain_jax.analysis._base import DIFFRAX_SOLVERS, RTOL, Analysis, Request, Solver
from drivetrain_jax.analysis.floquet.direct import Monodromy
from drivetrain_jax.analysis.floquet.effort import (
    MAX_PANELS,
    fades,
    fastest_rate,
    panels_needed,
    strongly_damped,
    traced_panels,
)
from drivetrain_jax.analysis.floquet.results import VARIABLES, lacks, results
from drivetrain_jax.analysis.numerics.lanes import Constants, lane_count, over_lanes
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Factored
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Ratio of the panels of the two solutions behind an error estimate, and the loosest target for it. The ratio needs a system
# that predicts its panels, and modes that do not fade within them: elsewhere so few panels may not show the order of the
# scheme.
_RATIO, _FINE = 4, 1e-8
# Most panels of a single point by the small program.
_MOST_SINGLE = 1000
# Most panels for small multipliers.
_MOST_FACTORS = 4096

Form = Callable[["FloquetModel"], "LinearPeriodic"]
Results = Callable[["FloquetModel", Monodromy, Callable[[], "Factored"]], dict[str, Array]]


def direct_solvers(
    system: type[System],
    rtol: float,
    target: float,
    form: Form,
    results: Results,
    chunk: int = 512,
    damped: bool = False,
    few: bool = False,
    small: bool = False,
) -> tuple[Solver, ...]:
    """The solvers that return ``results(model, monodromy, factors)`` from the monodromy matrix of ``form(model)``.

    ``rtol`` predicts the effort; every point is refined to the error ``target``. With ``damped`` a second solver takes the
    points with strong damping, in the model's form for them, and a third a single point of few panels. For ``few`` points
    the program is not optimised. A ``small`` one compiles even sooner, and takes ten times as long to compute.
    """
    build = system.models["floquet"].build

    def solver(
        name: str, form: Form, effort: Callable[[Mapping[str, Any]], np.ndarray], small: bool = small, cost: float = 1.0
    ) -> Solver:
        def solve(values: Mapping[str, Any], panels: Array) -> dict[str, Array]:
            # Local import: diffrax takes as long as jax, and only tracing needs it.
            from drivetrain_jax.analysis.floquet.propagator import factored, monodromy

            model, lanes = build(values), lane_count(values)
            ratio: Any = 2
            if model.panels is not None:
                ratio = jnp.where((target <= _FINE) & ~fades(model.reduced, panels), _RATIO, 2)

            def one(point: Mapping[str, Any], panels: Array) -> Monodromy:
                return monodromy(form(build(point)), panels, target, ratio, lanes, small)

            def factors() -> Factored:
                # Gauss schemes need panels in proportion to fast decays and growths.
                count = jnp.maximum(panels, jnp.minimum(fastest_rate(form(model)), _MOST_FACTORS).astype(int))
                return over_lanes(lambda point, count: factored(form(build(point)), count, lanes))(values, count)

            return results(model, over_lanes(one)(values, panels), factors)

        return Solver(
            f"direct: Gauss collocation of order 10{name}", solve, effort, lambda values: traced_panels(build, values, rtol),
            unit_cost=cost, seconds=1e-6, chunk=chunk, march=True, short_loops=True, few=few,
        )  # fmt: skip

    def effort(columns: Mapping[str, Any], strong: bool) -> np.ndarray:
        own = strongly_damped(system, columns) == strong if damped else True
        # A chart seldom needs both solvers.
        return np.where(own, panels_needed(system, columns, rtol) if np.any(own) else np.inf, np.inf)

    plain = solver("", form, lambda columns: effort(columns, False))
    strong = solver(
        ", form for strong damping", lambda model: model.damped or form(model), lambda columns: effort(columns, True)
    )

    def single(columns: Mapping[str, Any]) -> np.ndarray:
        panels = effort(columns, False)
        return np.where(panels <= _MOST_SINGLE, panels, np.inf)

    alone = replace(solver(", one point", form, single, small=True, cost=0.99), single=True)
    return (plain, strong, alone) if damped else (plain,)


FORMS = ("reduced", "published")


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    if request.method == "diffrax":
        # diffrax takes as long to import as jax, and readers of results do not need it.
        from drivetrain_jax.analysis.floquet.diffrax_solvers import diffrax_solvers

        return diffrax_solvers(system, request)
    rtol = request.options["rtol"]

    def found(model: FloquetModel, z: Monodromy, factors: Callable[[], Factored]) -> dict[str, Array]:
        return results(z, request.outputs, rtol, model, factors=factors)

    return direct_solvers(system, rtol, rtol / 4, lambda model: model.direct, found, damped=True)


# Target of the predicted panels of derivatives, tight because derivatives lose some digits against multipliers.
_DERIVATIVES = 1e-13
# Relative error of the monodromy matrix from which on its derivatives have no value.
_RESOLVED = 1e-6


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    """Jacobians of multipliers, exponents and spectral radius; NaN where multipliers coalesce or panels are too few.

    ``results`` are not used, so a gradient alone computes no values.
    """
    from drivetrain_jax.analysis.floquet.derivatives import monodromy, multipliers, shares_modulus

    build = system.models["floquet"].build
    panels = traced_panels(build, eqx.combine(parameters, constants.tree), _DERIVATIVES)
    # Where no number would do, few panels take the least time.
    enough = panels < MAX_PANELS
    z, log_scale, error, pull = monodromy(build, parameters, constants, jnp.where(enough, panels, 2))
    sigma, by_entry, error = multipliers(jnp.where(enough & (error < _RESOLVED), z, jnp.nan), error)
    scale, n = jnp.exp(log_scale), len(sigma)
    unit = sigma / jnp.abs(sigma)
    # A radius that underflows has no derivative either.
    known = (scale * jnp.abs(sigma[0]) > 0) & ~shares_modulus(sigma, error)
    if not {"floquet_multiplier", "floquet_exponent"} & set(request.outputs):
        slope = pull((jnp.conj(unit[0]) * by_entry[0]).real[None])[0]
        return {"spectral_radius": jnp.where(known, scale * slope, jnp.nan)}
    slopes = pull(jnp.concatenate([by_entry.real, by_entry.imag]))
    moved = slopes[:n] + 1j * slopes[n:]
    outward = (jnp.conj(unit)[:, None] * moved).real
    jacobians = {"spectral_radius": jnp.where(known, scale * outward[0], jnp.nan), "floquet_multiplier": scale * moved}
    if "floquet_exponent" in request.outputs:

        def period(parameters: Any) -> Array:
            return jnp.asarray(build(eqx.combine(parameters, constants.tree)).natural.span, float)

        span, longer = jax.value_and_grad(period)(parameters)
        modulus = jnp.abs(sigma)
        rates = (jnp.log(modulus) + log_scale) / span
        jacobians["floquet_exponent"] = (
            outward / modulus[:, None] - rates[:, None] * jnp.stack(jax.tree.leaves(longer))
        ) / span
    return jacobians


ANALYSIS = Analysis(
    name="floquet",
    title="Floquet stability of the equilibrium",
    variables=VARIABLES,
    default_outputs=("spectral_radius", "spectral_radius_error", "verdict"),
    methods={"auto": ("rtol",), "atlas": ("rtol",), "direct": ("rtol",), "diffrax": ("rtol", "atol", "solver", "form")},
    method_titles={
        "auto": "atlas where that is cheaper, else direct",
        "atlas": "Chebyshev panels compared with direct solves, with their bound",
        "direct": "Gauss collocation of order 10 in equal panels",
        "diffrax": "equal steps of a solver of diffrax, or adaptive ones for the equations as published",
    },
    options=(
        RTOL,
        Parameter("atol", "1", "absolute tolerance of adaptive steps", default=1e-12, lower=0.0, upper=1e-2),
        Parameter("solver", "1", "diffrax solver", default="Dopri8", choices=DIFFRAX_SOLVERS),
        Parameter("form", "1", "form of the equations", default="reduced", choices=FORMS),
    ),
    solvers=_solvers,
    dimensions=lambda *_: (Dimension("multiplier", "number of the multiplier, by falling modulus", ()),),
    lacks=lambda system: {
        **lacks(system),
        **({} if "atlas" in system.models else {"atlas": f"{system.name} has no model for it"}),
    },
    undecided="the spectral radius is 1 within its error: a smaller rtol than {rtol:g} may decide",
    derivatives=_derivatives,
)
