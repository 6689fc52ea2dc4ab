"""Physical data of a system, and the parameters that follow from them: in NumPy, unless data are traced by JAX."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax.core
import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter

# rad/s.
RPM = 2 * np.pi / 60
POSITIVE: dict[str, Any] = {"lower": 0.0, "open_lower": True}


@dataclass(frozen=True)
class Conversion:
    """The computation of ``parameter`` from physical data and other parameters: ``value(*needs)``.

    It takes place if the first of ``needs``, a quantity, is given; the others must then be known. ``formula`` is its text.
    ``back(parameter, *needs[1:])`` returns that quantity. Lists among ``needs`` are taken entry by entry, except ``whole``
    ones; one number is repeated for each entry of the parameter ``per``. A ``replaceable`` conversion gives way to a given
    parameter, an ``optional`` one also to data that are not given.
    """

    parameter: str
    needs: tuple[str, ...]
    value: Callable[..., Any]
    formula: str
    back: Callable[..., Any] | None = None
    optional: bool = False
    replaceable: bool = False
    per: str = ""
    whole: tuple[str, ...] = ()


@dataclass(frozen=True)
class Along:
    """Values along the axis ``axis`` of a scene (or along its points)."""

    axis: str
    values: np.ndarray


@dataclass(frozen=True)
class PhysicalData:
    """The ``quantities`` that a scene may give, and the ``conversions``, in the order in which they are computed.

    A conversion may use the results of earlier ones, and compute a quantity that others need.
    """

    quantities: tuple[Parameter, ...]
    conversions: tuple[Conversion, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return tuple(quantity.name for quantity in self.quantities)

    def quantity(self, name: str) -> Parameter:
        """The quantity called ``name``; ``KeyError`` if there is none."""
        return {quantity.name: quantity for quantity in self.quantities}[name]

    def converted(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters and quantities that follow from ``given``, which holds quantities and parameters.

        Values are numbers, arrays, words, tuples of them (lists), or :class:`Along`. Raises :class:`InputError` if data are
        missing, or if a parameter is given too.
        """
        defaults = {q.name: q.default for q in self.quantities if q.default is not None and q.name not in given}
        found: dict[str, Any] = {}
        for each in self.conversions:
            known = {**defaults, **given, **found}
            if each.needs[0] not in known or each.needs[0] in defaults:
                continue
            missing = [name for name in each.needs if name not in known]
            if each.parameter in given and (each.optional or each.replaceable):
                continue
            if each.parameter in given:
                given_text = _shown(given[each.parameter])
                raise InputError(
                    f"{each.parameter} = {given_text}: given besides {', '.join(each.needs)}; allowed is one of the two"
                )
            if missing and not each.optional:
                raise InputError(
                    f"{missing[0]}: missing; {each.parameter} = {each.formula} needs {' and '.join(missing)}"
                )
            if not missing:
                value, entries = _evaluated(each, [known[name] for name in each.needs]), known.get(each.per)
                if isinstance(entries, tuple) and not isinstance(value, tuple):
                    value = (value,) * len(entries)
                found[each.parameter] = value
        return found

    def all_converted(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As :meth:`converted`; raises :class:`InputError` for a quantity from which nothing follows."""
        found = self.converted(given)
        used = {name for each in self.conversions if each.parameter in found for name in each.needs}
        for name in self.names:
            if name in given and name not in used:
                uses = [
                    f"{each.parameter} needs {', '.join(each.needs)}" for each in self.conversions if name in each.needs
                ]
                raise InputError(f"{name}: nothing follows from it ({'; '.join(uses)}); allowed is to leave it out")
        return found

    def back(self, parameter: str, known: Mapping[str, Any]) -> tuple[Parameter, Callable[[Any], Any]] | None:
        """The quantity behind ``parameter``, and its value as a function of the parameter; None if there is none, or if data
        are missing."""
        known = {q.name: q.default for q in self.quantities if q.default is not None} | dict(known)
        for each in self.conversions:
            if each.parameter == parameter and each.back and all(name in known for name in each.needs[1:]):
                return self.quantity(each.needs[0]), partial(_back, each.back, [known[name] for name in each.needs[1:]])
        return None

    def source(self, parameter: str) -> str:
        """The data that ``parameter`` follows from as text, empty without any."""
        return next((", ".join(each.needs) for each in self.conversions if each.parameter == parameter), "")


def _back(back: Callable[..., Any], others: list[Any], value: Any) -> Any:
    return back(value, *others)


def _shown(value: Any) -> str:
    if isinstance(value, Along):
        return f"{value.values[0]:.10g}" if len(value.values) == 1 else f"axis {value.axis}"
    return repr(list(value) if isinstance(value, tuple) else value)


def _evaluated(conversion: Conversion, needs: list[Any]) -> Any:
    """The value of a conversion: a number or word, a tuple of them, :class:`Along`, or a tuple with some of these."""
    listed = [
        isinstance(value, tuple) and name not in conversion.whole
        for name, value in zip(conversion.needs, needs, strict=True)
    ]
    lengths = {name: len(v) for name, v, each in zip(conversion.needs, needs, listed, strict=True) if each}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {count}" for name, count in lengths.items())
        raise InputError(f"{conversion.needs[0]}: {counts} entries; allowed are lists of one length")
    if lengths:
        count = next(iter(lengths.values()))
        entries = [[v[i] if each else v for v, each in zip(needs, listed, strict=True)] for i in range(count)]
        return tuple(_evaluated(conversion, entry) for entry in entries)
    axes = list(dict.fromkeys(value.axis for value in needs if isinstance(value, Along)))
    if len(axes) > 1:
        raise InputError(
            f"axes.{axes[1]}: changes {conversion.parameter} together with {axes[0]}; allowed is one of them as an axis, "
            "or both in [points]"
        )
    value = conversion.value(*(each.values if isinstance(each, Along) else each for each in needs))
    if axes:
        return Along(axes[0], np.asarray(value, float))
    return value if isinstance(value, (str, jax.core.Tracer)) or np.ndim(value) else float(value)
