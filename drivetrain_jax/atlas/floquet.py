"""The atlas of the floquet analysis of a system: what to construct, how sharply to solve, how to evaluate it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax import Array

from drivetrain_jax.analysis.numerics.predictions import predicted
from drivetrain_jax.analysis.periodic.direct import stable_steps
from drivetrain_jax.analysis.periodic.floquet_effort import explicit_effort
from drivetrain_jax.atlas.construction import MAX_SOLVES, Domain, Rounds, construct, construct_from_parts
from drivetrain_jax.atlas.floquet_quantity import floquet_quantity
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, Smoothness, System

# Steps of the explicit scheme to a part where they are most; with three parameters and more fewer nodes are worth more.
_STEPS, _STEPS_OF_MANY, _MOST_PARTS = 18, 8, 32
# Steps that decay takes for stability alone: with more of them a corner is stiff, and each counts as so many of those that
# accuracy takes, since panels have to follow what decays, too.
_STIFF, _FOLLOWED = 50, 30
# Below this tolerance rounding of the parts shows in their product.
_TOO_FINE = 5e-13
# Direct solves are to be this much better than the atlas, as far as rounding allows.
_SHARPER, _FINEST = 3e-2, 1e-13


def solve_rtol(tolerance: float) -> float:
    """``rtol`` of the analysis ``floquet_propagator`` for the solves of an atlas."""
    return max(_SHARPER * tolerance, _FINEST)


def floquet_domain(system: System, ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float]) -> Domain:
    """The box ``ranges`` (name to lower and upper value) of ``system`` with the coordinates that the system declares."""
    smooth = system.models["atlas"].smooth or Smoothness({})
    names = tuple(ranges)
    return Domain(
        names,
        tuple(float(ranges[name][0]) for name in names),
        tuple(float(ranges[name][1]) for name in names),
        tuple(smooth.coordinate(name) for name in names),
        dict(fixed),
    )


def floquet_rounds(
    system: System,
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    tolerance: float,
    max_solves: int = MAX_SOLVES,
    parts: int = 1,
) -> Rounds:
    """The construction of an atlas of the propagator, as :func:`~drivetrain_jax.atlas.construct`.

    It asks for the variables of the analysis ``floquet_propagator``, side by side, with the options
    ``rtol = solve_rtol(tolerance)`` and ``parts``, for which :func:`span_parts` has a proposal.
    """
    domain = floquet_domain(system, ranges, fixed)
    quantity = floquet_quantity(_form(system, domain))
    if parts == 1:
        return construct(domain, quantity, tolerance, max_solves=max_solves)
    return construct_from_parts(domain, quantity, parts, tolerance, max_solves=max_solves)


def span_parts(
    system: System, ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float], tolerance: float
) -> int:
    """Into how many parts the span is to be cut, by the steps that the slowest corner takes and by the largest decay.

    One where a corner is stiff: the product of parts is then small against them, and their rounding shows in it.
    """
    if tolerance < _TOO_FINE:
        return 1
    domain = floquet_domain(system, ranges, fixed)
    corners = np.array(list(itertools.product(*zip(domain.lower, domain.upper, strict=True))))
    columns = {**domain.fixed, **dict(zip(domain.parameters, corners.T, strict=True))}
    rtol = solve_rtol(tolerance)
    decay = np.max(predicted(_stable_steps, (system.models["floquet"].build,), columns))
    if decay > _STIFF:
        return 1
    steps = explicit_effort(system, columns, rtol)
    most = np.max(steps[np.isfinite(steps)], initial=1.0) + _FOLLOWED * decay
    each = _STEPS if len(ranges) < 3 else _STEPS_OF_MANY
    return int(np.clip(np.round(most / each), 1, _MOST_PARTS))


def _stable_steps(build: Callable[..., FloquetModel], values: Mapping[str, Any]) -> Array:
    return stable_steps(build(values).reduced)


def numbers_per_solve(
    system: System, ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float], parts: int
) -> int:
    """How many numbers a solve for :func:`floquet_rounds` gives: entries of the parts, and errors of their product."""
    return (parts + 1) * floquet_quantity(_form(system, floquet_domain(system, ranges, fixed))).size


def prepare_judging(
    system: System,
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    rtol: float,
    outputs: Sequence[str],
) -> None:
    """Compile what judges single cells of :func:`stability_atlas`, by evaluating an atlas that is zero.

    It takes seconds, in which the solves for the real one can be compiled and made on the other cores.
    """
    domain = floquet_domain(system, ranges, fixed)
    middle = [(a + b) / 2 for a, b in zip(domain.lower, domain.upper, strict=True)]
    quantity = floquet_quantity(_form(system, domain))
    nothing = np.zeros((1, quantity.size))
    box = domain.box()
    panel = Panel(
        box.lower, box.upper, nothing.reshape(*[1] * len(middle), -1), 0.0, np.zeros_like(quantity.derived(nothing)[0])
    )
    zero = Atlas(
        parameters=domain.parameters,
        coordinates=domain.coordinates,
        lower=np.array(domain.lower),
        upper=np.array(domain.upper),
        fixed=domain.fixed,
        panels=(panel,),
        gaps=(),
        tolerance=0.0,
        solves=0,
    )
    stability_atlas(zero, system, rtol).by_eigenvalues(np.array([middle]), tuple(outputs))


def _form(system: System, domain: Domain) -> LinearPeriodic:
    middle = {name: (a + b) / 2 for name, a, b in zip(domain.parameters, domain.lower, domain.upper, strict=True)}
    return system.models["floquet"].build({**domain.fixed, **middle}).reduced


def stability_atlas(atlas: Atlas, system: System, rtol: float) -> StabilityAtlas:
    """Spectral radius, bound and verdict from an atlas that :func:`floquet_rounds` made; ``rtol`` judges outcomes."""
    return StabilityAtlas(atlas, system.models["floquet"].build, rtol)
