"""Input of questions to an atlas: its parameters, or physical data of the system, checked before any computation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drivetrain_jax._errors import InputError
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.atlas_file import StoredAtlas, as_given, check_same
from drivetrain_jax.runs.physical import GivenData, in_parameters

Range = tuple[float, float]
# Relative tolerance within which a value equals an end of a range: values converted from other units, or copied from a
# message, are rounded.
_SAME = 1e-9


def number(value: float) -> str:
    """A number as text, as in answers and messages."""
    return f"{value:.10g}"


def roles_of(atlas: StoredAtlas, *roles: str) -> list[str]:
    """The parameters with these ``roles`` in the system; :class:`InputError` if it has none."""
    system = atlas.scene.system
    for role in roles:
        if role not in system.roles:
            raise InputError(f"file: {system.name} names no {role}; allowed is a system that does")
    return [system.roles[role] for role in roles]


@dataclass(frozen=True)
class AtlasQuery:
    """The given values as parameters of the atlas (numbers or ranges), with the physical data behind them."""

    atlas: StoredAtlas
    values: Mapping[str, Any]
    shaft: GivenData | None

    @classmethod
    def of(
        cls,
        atlas: StoredAtlas,
        given: Mapping[str, Any],
        ranges: tuple[str, ...],
        free: tuple[str, ...] = (),
        within: tuple[str, ...] = (),
    ) -> AtlasQuery:
        """Check the given values; ``ranges`` names parameters that need a range, ``free`` those that are the answer, which a
        range ``within`` the atlas may restrict."""
        given = {name: _plain(value) for name, value in given.items()}
        shaft, values = in_parameters(atlas.scene.system, given, atlas.scene.data)
        for name, value in given.items():
            meant = shaft.parameter_of(name) if shaft else name
            if meant in free and not (meant in within and isinstance(value, tuple)):
                allowed = "allowed is to leave it out" + (", or LOW:HIGH" if meant in within else "")
                raise InputError(f"{name} = {as_given(value)}: is the answer; {allowed}")
        for name in (*ranges, *free):
            if name not in atlas.parameters:
                raise InputError(
                    f"file: the atlas does not vary {name}; allowed is one over {', '.join((*ranges, *free))}"
                )
        for name, value in values.items():
            if name in atlas.fixed and name not in free:
                source = shaft.physical.source(name) if shaft and name not in given else ""
                check_same(name, value, atlas.fixed[name], source)
        kept = {name for name in atlas.parameters if name not in free or name in within}
        own = {name: _within(value, atlas.ranges[name]) for name, value in values.items() if name in kept}
        for name in values:
            if name not in atlas.parameters and name not in atlas.fixed:
                physical = atlas.scene.system.physical
                atlas.refuse(name, values[name], *atlas.fixed, *(physical.names if physical else ()))
        for name in atlas.parameters:
            if name not in free or name in own:
                words = _Words.of(atlas, None if name in given else shaft, name)
                _check_range(words, atlas.ranges[name], own.get(name), name in (*ranges, *within))
        return cls(atlas, own, shaft)

    def numbers(self) -> dict[str, float]:
        """The values that are numbers."""
        return {name: value for name, value in self.values.items() if not isinstance(value, tuple)}

    def heading(self) -> str:
        """The conditions of the answer as text."""
        everything = {**self.values, **self.atlas.fixed}
        return ", ".join(
            f"{name} = {number(v[0])} to {number(v[1])}" if isinstance(v, tuple) else f"{name} = {number(v)}"
            for name, v in everything.items()
        )

    def named(self, name: str, value: float) -> str:
        """A value as text: ``beta = 0.31 (17.76 deg)``."""
        physical = self.shaft.quantity(name, value) if self.shaft else None
        aside = f" ({physical[0]} = {number(physical[1])} {physical[2]})" if physical else ""
        return f"{name} = {number(value)}{aside}"

    def physical(self, values: Mapping[str, float | Range]) -> dict[str, Any]:
        """``values`` in the physical units of the input; empty without physical input."""
        found = {}
        if self.shaft is None:
            return found
        for name, value in values.items():
            ends = [self.shaft.quantity(name, end) for end in (value if isinstance(value, tuple) else (value,))]
            known = [end for end in ends if end is not None]
            if known:
                numbers = [number for _, number, _ in known]
                found[known[0][0]] = {
                    "value": numbers if isinstance(value, tuple) else numbers[0],
                    "units": known[0][2],
                }
        return found


def _plain(value: Any) -> Any:
    return tuple(map(_plain, value)) if isinstance(value, tuple) else toml.plain(value)


def _within(value: Any, ends: Range) -> Any:
    """``value`` (or both ends of a range), moved to an end of the atlas if it is that close."""
    if isinstance(value, tuple):
        return tuple(_within(each, ends) for each in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    return next((end for end in ends if math.isclose(value, end, rel_tol=_SAME)), value)


@dataclass(frozen=True)
class _Words:
    """Texts for a parameter of the atlas, its range and its values, in the units of the input."""

    name: str
    allowed: str
    convert: Callable[[float], float] = lambda value: value

    @classmethod
    def of(cls, atlas: StoredAtlas, shaft: Any, name: str) -> _Words:
        physical: list[Any] = [shaft.quantity(name, end) for end in atlas.ranges[name]] if shaft else [None, None]
        if physical[0] is None:
            return cls(name, atlas.allowed(name))
        (label, low, units), (_, high, _) = physical
        allowed = f"{low:.10g} <= {label} <= {high:.10g}, in {units}"
        return cls(label, allowed, lambda value: shaft.quantity(name, value)[1])

    def given(self, value: Any) -> str:
        """A value or a range in the units of the input."""
        ends = value if isinstance(value, tuple) else (value,)
        shown = tuple(self.convert(end) if isinstance(end, float) else end for end in ends)
        return as_given(shown if isinstance(value, tuple) else shown[0])


def _check_range(words: _Words, ends: Range, value: Any, wanted: bool) -> None:
    allowed = f"allowed is {f'{words.name}=LOW:HIGH within ' if wanted else ''}{words.allowed}"
    if value is None:
        raise InputError(f"{words.name}: missing; {allowed}")
    if isinstance(value, tuple) != wanted:
        needed = "a range is needed" if wanted else "is a range"
        raise InputError(f"{words.name} = {words.given(value)}: {needed}; {allowed}")
    for end in value if wanted else (value,):
        if isinstance(end, bool) or not isinstance(end, (int, float)) or not ends[0] <= end <= ends[1]:
            raise InputError(f"{words.name} = {words.given(end)}: {allowed}")
    if wanted and not value[0] < value[1]:
        raise InputError(f"{words.name} = {words.given(value)}: allowed is a rising range")
