"""Stability and vibration of drivetrains: batched simulation in JAX, from a scene file to one labelled dataset.

``run`` computes a scene, ``point`` a single parameter set; wrong input raises ``InputError``, a computation that fails
``ChunkError`` or, with a file to resume, ``Incomplete``. Everything heavy is imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivetrain_jax._errors import ChunkError, InputError

if TYPE_CHECKING:
    from drivetrain_jax.sweep.atlas_file import open_atlas
    from drivetrain_jax.sweep.partial import open_result
    from drivetrain_jax.sweep.point import point
    from drivetrain_jax.sweep.run import Incomplete, Interrupted, run

__version__ = "0.1.0"

__all__ = [
    "ChunkError",
    "Incomplete",
    "InputError",
    "Interrupted",
    "__version__",
    "open_atlas",
    "open_result",
    "point",
    "run",
]

_HOME = {
    "Incomplete": "drivetrain_jax.sweep.run",
    "Interrupted": "drivetrain_jax.sweep.run",
    "open_atlas": "drivetrain_jax.sweep.atlas_file",
    "open_result": "drivetrain_jax.sweep.partial",
    "point": "drivetrain_jax.sweep.point",
    "run": "drivetrain_jax.sweep.run",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
