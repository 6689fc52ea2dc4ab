"""Input in physical units, for systems whose parameters are nondimensional."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax.systems import System


def nondimensional(system: System, given: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The physical data of ``system`` among ``given`` (None if there are none), and all values as its parameters.

    A value is a number or a range, a pair of numbers. Raises :class:`InputError` where some of the data are missing or out
    of range.
    """
    physical = system.physical
    if physical is None or not any(name in physical.names for name in given):
        return None, dict(given)
    data = [f.name for f in fields(physical)]
    missing = [name for name in data if name not in given]
    if missing:
        raise InputError(f"{missing[0]}: missing; physical units need all of {', '.join(data)}")
    shaft = physical(**{name: given[name] for name in data})
    values = dict(shaft.parameters)
    for name in given:
        if name in physical.operation:
            ends = given[name] if isinstance(given[name], tuple) else (given[name],)
            converted = [shaft.parameter(name, end) for end in ends]
            numbers = tuple(value for _, value in converted)
            values[converted[0][0]] = numbers if isinstance(given[name], tuple) else numbers[0]
        elif name not in data:
            values[name] = given[name]
    return shaft, values
