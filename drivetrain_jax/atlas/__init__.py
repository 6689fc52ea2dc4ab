"""Atlases: smooth results as Chebyshev panels over parameters, evaluated anywhere with an error bound.

This layer uses no files and no scenes: it requests solves, receives values, and returns arrays.

- :func:`construct`: any :class:`Quantity` over a :class:`Domain`, as a coroutine of rounds of solves; :func:`run` drives
  this coroutine.
- :func:`values_at`: the functions anywhere, with bounds, by direct solves in gaps.
- :func:`floquet_rounds`: the construction for the propagator of a periodic system; :func:`stability_atlas` evaluates the
  resulting atlas.
- :func:`to_arrays`, :func:`from_arrays`: the arrays of a file.
"""

from __future__ import annotations

from drivetrain_jax.atlas.construction import Domain, Rounds, construct, run
from drivetrain_jax.atlas.evaluation import values_at
from drivetrain_jax.atlas.floquet import (
    floquet_domain,
    floquet_rounds,
    numbers_per_solve,
    prepare_judging,
    solve_rtol,
    stability_atlas,
)
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel, from_arrays, to_arrays
from drivetrain_jax.atlas.quantity import Quantity
from drivetrain_jax.atlas.stability import StabilityAtlas

__all__ = [
    "Atlas",
    "Domain",
    "Gap",
    "Panel",
    "Quantity",
    "Rounds",
    "StabilityAtlas",
    "construct",
    "floquet_domain",
    "floquet_rounds",
    "from_arrays",
    "numbers_per_solve",
    "prepare_judging",
    "run",
    "solve_rtol",
    "stability_atlas",
    "to_arrays",
    "values_at",
]
