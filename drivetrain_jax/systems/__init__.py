"""The drivetrain systems, found by name; other packages add theirs through the entry point group
``drivetrain_jax.systems`` (each entry point names a :class:`~drivetrain_jax.systems._base.System`)."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

import jax

# Every module that computes imports this package first, so no array can be made in single precision before this line.
jax.config.update("jax_enable_x64", True)

from drivetrain_jax._quantities import Parameter  # noqa: E402
from drivetrain_jax.systems._base import (  # noqa: E402
    FloquetModel,
    ForcedModel,
    LinearPeriodic,
    Model,
    Resonances,
    System,
    dense,
)
from drivetrain_jax.systems._flow import Flow  # noqa: E402
from drivetrain_jax.systems._modal import FAMILIES, Block, SpringSystem  # noqa: E402
from drivetrain_jax.systems._piecewise import PiecewiseLinearOscillator  # noqa: E402
from drivetrain_jax.systems._shaft import Shaft  # noqa: E402
from drivetrain_jax.systems._smooth import Coordinate, Series, Smoothness  # noqa: E402

ENTRY_POINT_GROUP = "drivetrain_jax.systems"
_BUILT_IN = ("cardan", "tripod", "rattle", "planetary", "bicardan")

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
    "system_names",
]


def system_names() -> tuple[str, ...]:
    """Names of all systems: the built-in ones, then those of installed packages."""
    external = sorted(e.name for e in entry_points(group=ENTRY_POINT_GROUP) if e.name not in _BUILT_IN)
    return (*_BUILT_IN, *external)


def get_system(name: str) -> System:
    """The system ``name``; ``KeyError`` with the known names if there is none, ``ImportError`` if its package fails."""
    if name in _BUILT_IN:
        return import_module(f"drivetrain_jax.systems.{name}").SYSTEM
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return _loaded(entry)
    raise KeyError(f"system = {name!r}: allowed is one of {', '.join(system_names())}")


def _loaded(entry: EntryPoint) -> System:
    try:
        system = entry.load()
    # Whatever another package raises.
    except Exception as error:
        raise ImportError(f"{entry.value} cannot be loaded: {type(error).__name__}: {error}") from error
    if not isinstance(system, System) or system.name != entry.name:
        called = f"the system {system.name}" if isinstance(system, System) else f"a {type(system).__name__}"
        raise ImportError(f"{entry.value} is {called}, not the system {entry.name}")
    return system
