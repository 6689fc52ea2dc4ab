"""The atlas of the floquet analysis of a system: quantity, tolerance of the solves, and evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivetrain_jax.atlas.construction import MAX_SOLVES, Domain, Rounds, construct
from drivetrain_jax.atlas.floquet_quantity import floquet_quantity
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.atlas.series import series_nodes
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.systems import LinearPeriodic, Smoothness, System

# Ratio of the tolerance of direct solves to that of the atlas, and the smallest tolerance that rounding allows.
_SHARPER, _FINEST = 3e-2, 1e-13


def solve_rtol(tolerance: float) -> float:
    """``rtol`` of the analysis ``floquet_propagator`` for the solves of an atlas."""
    return max(_SHARPER * tolerance, _FINEST)


def floquet_domain(system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, Any]) -> Domain:
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
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    tolerance: float,
    max_solves: int = MAX_SOLVES,
) -> Rounds:
    """The construction of an atlas of the propagator, as :func:`~drivetrain_jax.atlas.construct`.

    It requests the variables of the analysis ``floquet_propagator``, in one array, with ``rtol = solve_rtol(tolerance)``.
    """
    domain = floquet_domain(system, ranges, fixed)
    quantity = floquet_quantity(_form(system, domain))
    return construct(domain, quantity, tolerance, source=series_nodes(system, domain, tolerance), max_solves=max_solves)


def numbers_per_solve(
    system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float]
) -> int:
    """Number of values per solve for :func:`floquet_rounds`: entries of the propagator, and their errors."""
    return 2 * floquet_quantity(_form(system, floquet_domain(system, ranges, fixed))).size


def prepare_judging(
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    rtol: float,
    outputs: Sequence[str],
) -> None:
    """Compile the kernel that decides single cells of :func:`stability_atlas`, by evaluating a zero atlas.

    This takes seconds, in which other cores can compile and run the solves for the real atlas.
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


def _form(system: type[System], domain: Domain) -> LinearPeriodic:
    middle = {name: (a + b) / 2 for name, a, b in zip(domain.parameters, domain.lower, domain.upper, strict=True)}
    return system.models["floquet"].build({**domain.fixed, **middle}).reduced


def stability_atlas(atlas: Atlas, system: type[System], rtol: float) -> StabilityAtlas:
    """Spectral radius, bound and verdict from an atlas of :func:`floquet_rounds`; ``rtol`` determines outcomes."""
    return StabilityAtlas(atlas, system.models["floquet"].build, rtol)
