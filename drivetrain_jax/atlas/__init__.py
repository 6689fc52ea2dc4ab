"""Functions of parameters instead of pixels: smooth results as Chebyshev panels, evaluated anywhere with a bound.

The layer knows nothing of files or scenes: it asks for solves, is given values, and hands over arrays.

- :func:`construct`: any :class:`Quantity` over a :class:`Domain`, as a coroutine of rounds of solves; :func:`run` drives it.
- :func:`values_at`: the functions anywhere, with bounds, and by direct solves where the atlas has gaps.
- :func:`floquet_rounds`: the same for the propagator of a periodic system; :func:`stability_atlas` evaluates the result.
- :func:`to_arrays`, :func:`from_arrays`: what a file keeps.
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
from drivetrain_jax.atlas.panels import Atlas, Gap, Panel
from drivetrain_jax.atlas.quantity import Quantity
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.atlas.storage import from_arrays, to_arrays

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
