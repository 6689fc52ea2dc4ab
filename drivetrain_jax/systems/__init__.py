"""The drivetrain systems, found by name; other packages add theirs through the entry point group
``drivetrain_jax.systems`` (each entry point names a class, a :class:`~drivetrain_jax.systems._base.System`)."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

import jax

# Double precision is turned on only here: every module that computes imports this package first. The environment variable
# leaves the choice to the caller.
if os.environ.get("DRIVETRAIN_JAX_ENABLE_X64") != "0":
    jax.config.update("jax_enable_x64", True)

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import Model, Resonances, System, parameter, serves
from drivetrain_jax.systems._flow import Flow
from drivetrain_jax.systems._modal import FAMILIES, Block, SpringSystem
from drivetrain_jax.systems._piecewise import PiecewiseLinearOscillator
from drivetrain_jax.systems._rows import dense
from drivetrain_jax.systems._shaft import Shaft
from drivetrain_jax.systems._smooth import Coordinate, Series, Smoothness

if TYPE_CHECKING:
    from drivetrain_jax.systems._periodic import FloquetModel, ForcedModel, LinearPeriodic

ENTRY_POINT_GROUP = "drivetrain_jax.systems"
_BUILT_IN = {
    "cardan": "Cardan",
    "tripod": "Tripod",
    "rattle": "Rattle",
    "planetary": "Planetary",
    "bicardan": "Bicardan",
}

__all__ = [
    "ENTRY_POINT_GROUP",
    "FAMILIES",
    "Block",
    "Coordinate",
    "FloquetModel",
    "Flow",
    "ForcedModel",
    "LinearPeriodic",
    "Model",
    "Parameter",
    "PiecewiseLinearOscillator",
    "Resonances",
    "Series",
    "Shaft",
    "Smoothness",
    "SpringSystem",
    "System",
    "dense",
    "get_system",
    "parameter",
    "serves",
    "system_names",
]


def __getattr__(name: str) -> Any:
    # Imported here: that module imports diffrax, which takes as long as jax and is not needed to read a result.
    if name in ("FloquetModel", "ForcedModel", "LinearPeriodic"):
        return getattr(import_module("drivetrain_jax.systems._periodic"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def system_names() -> tuple[str, ...]:
    """Names of all systems: the built-in ones, then those of installed packages."""
    external = sorted(e.name for e in entry_points(group=ENTRY_POINT_GROUP) if e.name not in _BUILT_IN)
    return (*_BUILT_IN, *external)


def get_system(name: str) -> type[System]:
    """The system ``name``; ``KeyError`` with the known names if there is none, ``ImportError`` if its package fails."""
    if name in _BUILT_IN:
        return getattr(import_module(f"drivetrain_jax.systems.{name}"), _BUILT_IN[name])
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return _loaded(entry)
    raise KeyError(f"system = {name!r}: allowed is one of {', '.join(system_names())}")


def _loaded(entry: EntryPoint) -> type[System]:
    try:
        system = entry.load()
    # Any exception of another package.
    except Exception as error:
        raise ImportError(f"{entry.value} cannot be loaded: {type(error).__name__}: {error}") from error
    if not (isinstance(system, type) and issubclass(system, System)):
        raise ImportError(f"{entry.value} is a {type(system).__name__}, not a system")
    if system.name != entry.name:
        raise ImportError(f"{entry.value} is the system {system.name}, not the system {entry.name}")
    return system
