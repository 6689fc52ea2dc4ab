"""Convert physical data to the parameters of nondimensional systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax.runs import toml
from drivetrain_jax.systems import System


def nondimensional(system: type[System], given: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The physical data of ``system`` in ``given`` (None without any), and all values as its parameters.

    A value is a number (of Python or NumPy) or a range, a pair of numbers. Raises :class:`InputError` if data are missing
    or out of range, or repeat a given parameter.
    """
    given = {name: _plain(value) for name, value in given.items()}
    physical = system.physical
    if physical is None or not any(name in physical.names for name in given):
        return None, given
    data = [f.name for f in fields(physical)]
    missing = [name for name in data if name not in given]
    if missing:
        raise InputError(f"{missing[0]}: missing; physical units need all of {', '.join(data)}")
    shaft = physical(**{name: given[name] for name in data})
    converted = dict(shaft.parameters)
    for name in physical.operation:
        if name in given:
            ends = given[name] if isinstance(given[name], tuple) else (given[name],)
            pairs = [shaft.parameter(name, end) for end in ends]
            numbers = tuple(value for _, value in pairs)
            converted[pairs[0][0]] = numbers if isinstance(given[name], tuple) else numbers[0]
    others = {name: value for name, value in given.items() if name not in physical.names}
    for name in others:
        if name in converted:
            raise InputError(f"{name} = {others[name]!r}: is given in physical units, too; allowed is one of the two")
    return shaft, {**converted, **others}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    return toml.plain(value)
