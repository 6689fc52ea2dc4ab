"""Parse values on the command line: ``name=value``, ``name=LOW:HIGH``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError


def assignments(texts: Sequence[str], field: str) -> dict[str, Any]:
    """A mapping from ``name=value`` words; values are TOML or plain text."""
    from drivetrain_jax.runs.toml import parse_value

    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{field} = {text!r}: allowed is name=value")
        if name in pairs:
            raise InputError(f"{field} = {text!r}: {name} is given twice; allowed is once")
        pairs[name] = parse_value(value)
    for name in pairs:
        if table := next((other for other in pairs if name.startswith(f"{other}.")), None):
            raise InputError(f"{field} = {name!r}: it is part of {table!r}, which is given too; allowed is one of them")
    return pairs


def ranges(texts: Sequence[str], field: str) -> dict[str, Any]:
    """A mapping from ``name=value`` words; values are numbers or pairs ``LOW:HIGH``, texts if they have units."""
    return {name: _number_or_range(name, value) for name, value in assignments(texts, field).items()}


def _number_or_range(name: str, value: Any) -> Any:
    if isinstance(value, str):
        ends = [_units.split(end) for end in value.split(":")]
        known = [end for end in ends if end is not None]
        # 1000-2000 is no number, and its second half no unit.
        if len(known) == len(ends) <= 2 and not any(re.match(r"[-.,\d]", unit) for _, unit in known):
            # 0:18deg is a range in degrees.
            numbers = [_written(number, unit or known[-1][1]) for number, unit in known]
            return numbers[0] if len(numbers) == 1 else tuple(numbers)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    raise InputError(f"{name} = {value!r}: allowed is a number or LOW:HIGH, with or without units (200:4000rpm)")


def _written(number: float, unit: str) -> float | str:
    return f"{number!r} {unit}" if unit else number
