"""Stability and vibration of drivetrains: batched simulation in JAX, from a scene file to one labelled dataset.

``run`` computes a scene, ``point`` a single parameter set; wrong input raises ``InputError``. Everything heavy is
imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivetrain_jax._errors import InputError

if TYPE_CHECKING:
    from drivetrain_jax.sweep.point import point
    from drivetrain_jax.sweep.run import run

__version__ = "0.1.0"

__all__ = ["InputError", "__version__", "point", "run"]

_HOME = {"run": "drivetrain_jax.sweep.run", "point": "drivetrain_jax.sweep.point"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
