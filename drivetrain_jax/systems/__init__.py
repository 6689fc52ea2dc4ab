"""The drivetrain systems by name.

Other packages add systems through the entry point group ``drivetrain_jax.systems``; each entry point names a subclass of
:class:`~drivetrain_jax.systems._base.System`.
"""

from __future__ import annotations

from importlib import import_module

from drivetrain_jax._plugins import SYSTEMS, load_plugin, plugin_names
from drivetrain_jax._quantities import Component, Dimension, Parameter, Variable
from drivetrain_jax.resonances import Family, Resonances
from drivetrain_jax.systems._base import Conversion, Model, PhysicalData, System, parameter, serves
from drivetrain_jax.systems._models import (
    Balance,
    Block,
    Coordinate,
    DrivenSprings,
    Enclosure,
    FloquetModel,
    Flow,
    ForcedModel,
    LinearPeriodic,
    PiecewiseLinearOscillator,
    Series,
    Shaft,
    Smoothness,
    SpringSystem,
    UnderdampedOscillator,
    dense,
)

_BUILT_IN = {
    "cardan": "Cardan",
    "tripod": "Tripod",
    "rattle": "Rattle",
    "planetary": "Planetary",
    "bicardan": "Bicardan",
    "driveline": "Driveline",
}

__all__ = [
    "Balance",
    "Block",
    "Component",
    "Conversion",
    "Coordinate",
    "Dimension",
    "DrivenSprings",
    "Enclosure",
    "Family",
    "FloquetModel",
    "Flow",
    "ForcedModel",
    "LinearPeriodic",
    "Model",
    "Parameter",
    "PhysicalData",
    "PiecewiseLinearOscillator",
    "Resonances",
    "Series",
    "Shaft",
    "Smoothness",
    "SpringSystem",
    "System",
    "UnderdampedOscillator",
    "Variable",
    "dense",
    "get_system",
    "parameter",
    "serves",
    "system_names",
]


def system_names() -> tuple[str, ...]:
    """Names of all systems: the built-in ones, then those of installed packages."""
    return (*_BUILT_IN, *(name for name in plugin_names(SYSTEMS) if name not in _BUILT_IN))


def get_system(name: str) -> type[System]:
    """The system ``name``; ``KeyError`` with the known names if there is none, ``ImportError`` if its package fails."""
    if name in _BUILT_IN:
        return getattr(import_module(f"drivetrain_jax.systems.{name}"), _BUILT_IN[name])
    system = load_plugin(SYSTEMS, name, "a system", lambda x: isinstance(x, type) and issubclass(x, System))
    if system is None:
        raise KeyError(
            f"system = {name!r}: allowed is one of {', '.join(system_names())}, or one that a package registers"
        )
    return system
