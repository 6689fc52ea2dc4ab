"""The direct solver of a periodic system: Gauss collocation, refined in blocks of lanes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis._base import Solver
from drivetrain_jax.analysis.floquet.direct import Monodromy
from drivetrain_jax.analysis.floquet.effort import fastest_rate, panels_needed, strongly_damped, traced_panels
from drivetrain_jax.analysis.numerics.lanes import lane_count, over_lanes
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.analysis.floquet.propagator import Factored
    from drivetrain_jax.systems import FloquetModel, LinearPeriodic

# Ratio of the panels of the two solutions behind an error estimate, and the loosest target for it. The ratio needs a system
# that predicts its panels: elsewhere so few panels may not show the order of the scheme.
_RATIO, _FINE = 4, 1e-8
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
) -> tuple[Solver, ...]:
    """The solvers that return ``results(model, monodromy, factors)`` from the monodromy matrix of ``form(model)``.

    ``rtol`` predicts the effort; every point is refined to the error ``target``. With ``damped`` a second solver takes the
    points with strong damping, in the model's form for them.
    """
    build = system.models["floquet"].build

    def solver(name: str, form: Form, effort: Callable[[Mapping[str, Any]], np.ndarray]) -> Solver:
        def solve(values: Mapping[str, Any], panels: Array) -> dict[str, Array]:
            # Local import: diffrax takes as long as jax, and only tracing needs it.
            from drivetrain_jax.analysis.floquet.propagator import factored, monodromy

            model, lanes = build(values), lane_count(values)
            ratio = jnp.where(target <= _FINE, _RATIO, 2) if model.panels is not None else 2

            def one(own: Mapping[str, Any], panels: Array) -> Monodromy:
                return monodromy(form(build(own)), panels, target, ratio, lanes)

            def factors() -> Factored:
                # Gauss schemes need panels in proportion to fast decays and growths.
                count = jnp.maximum(panels, jnp.minimum(fastest_rate(form(model)), _MOST_FACTORS).astype(int))
                return over_lanes(lambda own, count: factored(form(build(own)), count, lanes))(values, count)

            return results(model, over_lanes(one)(values, panels), factors)

        return Solver(
            f"direct: Gauss collocation of order 10{name}",
            solve,
            effort,
            lambda values: traced_panels(build, values, rtol),
            seconds=1e-6,
            chunk=chunk,
            march=True,
            short_loops=True,
        )

    def effort(columns: Mapping[str, Any], strong: bool) -> np.ndarray:
        panels = panels_needed(system, columns, rtol)
        return np.where(strongly_damped(system, columns) == strong, panels, np.inf) if damped else panels

    plain = solver("", form, lambda columns: effort(columns, False))
    strong = solver(
        ", form for strong damping", lambda model: model.damped or form(model), lambda columns: effort(columns, True)
    )
    return (plain, strong) if damped else (plain,)
