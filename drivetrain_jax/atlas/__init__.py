"""Atlases: smooth results as Chebyshev panels over parameters, evaluated anywhere with an error bound.

This layer uses no files and no scenes: it requests solves, receives values, and returns arrays.

- :func:`construct`: any :class:`Function` over a :class:`Domain`.
- :func:`floquet_atlas`: the propagator of a periodic system; :func:`stability_atlas` evaluates the resulting atlas.
- :func:`to_arrays`, :func:`from_arrays`: the arrays of a file.
"""

from __future__ import annotations

from drivetrain_jax.atlas.construction import Domain, Function, construct
from drivetrain_jax.atlas.floquet import (
    floquet_atlas,
    floquet_domain,
    method_of_solves,
    numbers_per_solve,
    prepare_judging,
    solve_rtol,
    stability_atlas,
)
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, from_arrays, to_arrays
from drivetrain_jax.atlas.stability import StabilityAtlas

__all__ = [
    "Atlas",
    "Domain",
    "Function",
    "Gap",
    "Panel",
    "StabilityAtlas",
    "construct",
    "floquet_atlas",
    "floquet_domain",
    "from_arrays",
    "method_of_solves",
    "numbers_per_solve",
    "prepare_judging",
    "solve_rtol",
    "stability_atlas",
    "to_arrays",
]
