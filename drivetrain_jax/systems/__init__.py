"""The drivetrain systems by name.

Other packages add systems through the entry point group ``drivetrain_jax.systems``; each entry point names a subclass of
:class:`~drivetrain_jax.systems._base.System`.
"""

from __future__ import annotations

from importlib import import_module

from drivetrain_jax._errors import InputError, nearest, shown
from drivetrain_jax._plugins import SYSTEMS, load_plugin, plugin_names
from drivetrain_jax._quantities import Component, Dimension, Parameter, Variable
from drivetrain_jax.resonances import Family, Resonances
from drivetrain_jax.systems._base import Conversion, Model, PhysicalData, System, parameter, serves
from drivetrain_jax.systems._models import (
    Block,
    DrivenSprings,
    FloquetModel,
    Flow,
    ForcedModel,
    LinearPeriodic,
    PiecewiseLinearOscillator,
    Shaft,
    SpringSystem,
    UnderdampedOscillator,
    dense,
)
from drivetrain_jax.systems._smoothness import Coordinate, Enclosure, Smoothness

_BUILT_IN = {
    "cardan": "Cardan",
    "tripod": "Tripod",
    "rattle": "Rattle",
    "planetary": "Planetary",
    "bicardan": "Bicardan",
    "driveline": "Driveline",
}
# Classes by name that this process has registered.
_REGISTERED: dict[str, type[System]] = {}

__all__ = [
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
    "Shaft",
    "Smoothness",
    "SpringSystem",
    "System",
    "UnderdampedOscillator",
    "Variable",
    "dense",
    "get_system",
    "parameter",
    "register",
    "serves",
    "system_names",
]


def system_names() -> tuple[str, ...]:
    """Names of all systems: the built-in ones, then those of installed packages, then registered ones."""
    return tuple(dict.fromkeys((*_BUILT_IN, *plugin_names(SYSTEMS), *_REGISTERED)))


def register(system: type[System]) -> type[System]:
    """Make a class known to scenes and atlases of this process by its name; returns the class, so that it is a decorator.

    Args:
        system: a subclass of :class:`~drivetrain_jax.systems.System`. It replaces a registered class of the same name, so
            that a cell of a notebook may be run again.

    Raises: InputError for another object, and for the name of a built-in or installed system.

    >>> import drivetrain_jax as dt
    >>> from drivetrain_jax.systems import Flow, System, parameter, serves
    >>> @dt.register
    ... class Decay(System):
    ...     name = "decay"
    ...     title = "x' = -rate x"
    ...     rate: float = parameter("1/s", "rate of decay")
    ...
    ...     @serves("lyapunov")
    ...     def flow(self):
    ...         return Flow(lambda angles, y: (-self.rate * y[0],), (1.0,), period=1.0)
    >>> dt.run({"system": "decay", "analysis": "lyapunov", "axes": {"rate": [2.0]}}).lyapunov_spectrum.round(6).item()
    -2.0
    """
    if not (isinstance(system, type) and issubclass(system, System) and getattr(system, "name", "")):
        raise InputError(f"system = {shown(system)}: expected a subclass of drivetrain_jax.systems.System with a name")
    if system.name not in _REGISTERED and system.name in system_names():
        if get_system(system.name) is not system:
            raise InputError(f"system = {system.name!r}: names an installed system; expected another name")
        return system
    _REGISTERED[system.name] = system
    return system


def get_system(name: str) -> type[System]:
    """The system ``name``; :class:`InputError` with the known names if there is none, or if its package fails."""
    if name in _REGISTERED:
        return _REGISTERED[name]
    if name in _BUILT_IN:
        return getattr(import_module(f"drivetrain_jax.systems.{name}"), _BUILT_IN[name])
    system = load_plugin(SYSTEMS, name, "a system", lambda x: isinstance(x, type) and issubclass(x, System))
    if system is None:
        known = nearest(str(name), system_names())
        how = "; register a class of your own: dt.register(CLASS) in Python, an entry point for commands"
        raise InputError(f"system = {shown(name)}: unknown{known}{'' if 'did you mean' in known else how}")
    return system
