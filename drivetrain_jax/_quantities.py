"""Parameters, variables and dimensions with units and ranges, shared by all layers. Needs neither jax nor files."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, KeysView
from dataclasses import dataclass
from decimal import Decimal
from numbers import Real
from typing import Any, ClassVar

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, shown

_QUOTIENT = re.compile(r"\s*([+-]?\d{1,9}(?:\.\d{1,9})?)\s*/\s*(?=[\d.]*[1-9])(\d{1,9}(?:\.\d{1,9})?)\s*")
# First code of ``outcome`` without a value.
FIRST_FAILURE = 2


@dataclass(frozen=True)
class Parameter:
    """A parameter of a system, or an option of an analysis. A number may be given as a text with a unit."""

    #: Name in scenes and of the field.
    name: str
    #: Unit of the values; ``1``: none.
    units: str
    #: One line about the parameter.
    long_name: str
    #: Value if none is given. None: required, unless ``derived`` names the parameters it follows from.
    default: float | int | str | tuple[float, ...] | None = None
    #: Names of the parameters from which the model computes a value that is not given.
    derived: str = ""
    #: Smallest value, inclusive unless ``open_lower``.
    lower: float = -math.inf
    #: Largest value, inclusive unless ``open_upper``.
    upper: float = math.inf
    #: ``lower`` itself is not allowed.
    open_lower: bool = False
    #: ``upper`` itself is not allowed.
    open_upper: bool = False
    #: The allowed words, if the value is a word.
    choices: tuple[str, ...] = ()
    #: A list of numbers in the range (default ``()``: none).
    listed: bool = False
    #: For a list, also one number for all entries.
    broadcast: bool = False
    #: An integer.
    integer: bool = False
    #: Infinity is allowed.
    infinite: bool = False
    #: Any word.
    text: bool = False
    #: Form in formulas.
    symbol: str = ""
    #: Values above are warned of, because they were probably meant in mm.
    usual: float = math.inf
    #: 0 is allowed below ``lower``.
    or_zero: bool = False
    #: A quotient is allowed: ``"11/41"``, the teeth of two gears, or ``"1/3.7"``.
    fraction: bool = False

    @property
    def is_number(self) -> bool:
        """True if one number is a valid value, so the parameter can vary as a whole."""
        return not (self.choices or self.text or (self.listed and not self.broadcast))

    @property
    def allowed(self) -> str:
        """The allowed values as text, e.g. ``0 <= zeta < inf``."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        if self.text:
            return "text"
        kind = "integer " if self.integer else ""
        left = f"{self.lower:.10g} {'<' if self.open_lower else '<='} " if self.lower > -math.inf else ""
        right = f" {'<' if self.open_upper else '<='} {self.upper:.10g}" if self.upper < math.inf else ""
        if self.infinite:
            right = " <= inf"
        elif left and not right and not self.integer:
            right = " < inf"
        listed = "[i]" if self.listed else ""
        either = " (or one number for all)" if self.listed and self.broadcast else ""
        either += ", or 0" if self.or_zero else ""
        if not left and not right:
            left, right = "-inf < ", " < inf"
        return f"{kind}{left}{self.name}{listed}{right}{either}"

    @property
    def allowed_in_units(self) -> str:
        """The allowed values with the unit, because a value out of range is often in another unit."""
        return self.allowed if self.units == "1" else f"{self.allowed}, in {self.units}"

    def check(self, value: object) -> float | int | str | tuple[float, ...]:
        """Return ``value`` in its stored type, or raise ``InputError`` with one line that names the range."""
        if self.choices:
            # A word that looks like a number needs no quotes.
            value = str(value) if isinstance(value, int) and str(value) in self.choices else value
            if not isinstance(value, str) or value not in self.choices:
                raise InputError(f"{self.name} = {shown(value)}: expected {self.allowed}")
            return value
        if self.text:
            if not isinstance(value, str):
                raise InputError(f"{self.name} = {shown(value)}: expected text")
            return value
        if self.listed and not (self.broadcast and not isinstance(value, (list, tuple))):
            if not isinstance(value, (list, tuple)) or not value:
                raise InputError(f"{self.name} = {shown(value)}: expected a list of numbers, {self.allowed}")
            return tuple(self._check_number(entry, f"{self.name}[{i}]") for i, entry in enumerate(value))
        return self._check_number(value, self.name)

    def _check_number(self, value: object, label: str) -> float | int:
        written = isinstance(value, str)
        if isinstance(value, str) and self.fraction and (quotient := _QUOTIENT.fullmatch(value)):
            value = float(quotient[1]) / float(quotient[2])
        if isinstance(value, str):
            value = self._in_units(value, label)
        elif isinstance(value, Decimal) or (isinstance(value, Real) and not isinstance(value, (bool, int, float))):
            value = float(value)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{label} = {shown(value)}: expected a number, {self.allowed}")
        if isinstance(value, int) and value.bit_length() > 1024:
            raise InputError(f"{label}: an integer of {value.bit_length()} bits; expected {self.allowed_in_units}")
        if not self._is_within(value) or (self.integer and value != int(value)):
            guess = "" if written else self._meant(value)
            raise InputError(f"{label} = {value!r}: expected {self.allowed_in_units}{guess}")
        if value > self.usual:
            usual = f"more than {self.usual:g} {self.units}"
            warnings.warn(f'{label} = {value:.10g} {self.units}: {usual}; is "{value:.10g} mm" meant?', stacklevel=2)
        return int(value) if self.integer else float(value)

    def _is_within(self, value: float) -> bool:
        below = value <= self.lower if self.open_lower else value < self.lower
        above = value >= self.upper if self.open_upper else value > self.upper
        if self.or_zero and value == 0:
            return True
        return not (below or above) and (math.isfinite(value) or (self.infinite and value == math.inf))

    def _in_units(self, text: str, label: str) -> float:
        """The number that ``text`` writes with a unit, or ``InputError`` with one line."""
        try:
            return _units.number(text, self.units)
        except _units.UnitError as error:
            if _units.split(text) is None:
                raise InputError(f"{label} = {shown(text)}: expected a number, {self.allowed}") from None
            error = f"{error}{_units.misread(text)}"
            unit = "a number without unit" if self.units == "1" else f"a number in {self.units} or in a unit like it"
            raise InputError(f"{label} = {shown(text)}: {error}; expected {unit}, {self.allowed}") from None

    def _meant(self, value: float) -> str:
        """A question, if ``value`` would be in the range as an angle in degrees."""
        if self.units != "rad" or not math.isfinite(value) or not self._is_within(math.radians(value)):
            return ""
        return f'; did you mean "{value:.10g} deg"?'


class NamedResults:
    """Results by attribute or by name. A subclass names its field that holds them."""

    _field: ClassVar[str]

    def __getattr__(self, name: str) -> Any:
        # A copy asks before it has any attribute.
        results = vars(self).get(self._field, {})
        if name not in results:
            raise AttributeError(f"no result {name!r}; there is {', '.join(results)}")
        return results[name]

    def __getitem__(self, name: str) -> Any:
        return getattr(self, self._field)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def keys(self) -> KeysView[str]:
        """Names of the results, so that ``dict(result)`` holds them."""
        return getattr(self, self._field).keys()

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.keys()})


def count(name: str, long_name: str, **rest: Any) -> Parameter:
    """A parameter that is an integer without a unit."""
    return Parameter(name, "1", long_name, integer=True, **rest)


@dataclass(frozen=True)
class Component:
    """A component of the state of a system; ``symbol`` is its form in figures, by default made of the name.

    ``scale`` is its usual size over that of the first component, from which figures tell values from rounding.
    """

    name: str
    units: str
    long_name: str
    symbol: str = ""
    scale: float = 1.0


@dataclass(frozen=True)
class Dimension:
    """A dimension that an analysis adds to its results: coordinate values and meaning.

    Empty ``values`` stand for 1, 2, ... up to the length of the results; with ``components`` for ``theta 1``, ``theta 2``,
    ..., ``theta_rate 1``, ...
    """

    name: str
    long_name: str
    values: tuple[int | float | str, ...]
    units: str = "1"
    components: tuple[str, ...] = ()

    def labels(self, length: int) -> tuple[int | float | str, ...]:
        """The coordinate values of results of this ``length``."""
        if self.values or not self.components:
            return self.values or tuple(range(1, length + 1))
        return self.of_components(range(1, length // len(self.components) + 1))

    def of_components(self, entries: Iterable[int | str]) -> tuple[str, ...]:
        """The labels of the ``entries`` of every component."""
        return tuple(f"{component} {entry}" for component in self.components for entry in entries)


@dataclass(frozen=True)
class Variable:
    """A result of an analysis. ``dims`` names its dimensions besides those of the sweep.

    ``flags`` gives the meanings of the codes 0, 1, ... of an integer variable. ``lower`` is the smallest valid value: files
    store it (``valid_min``), and ``verify`` checks it.
    """

    name: str
    units: str
    long_name: str
    dims: tuple[str, ...] = ()
    dtype: str = "float64"
    flags: tuple[str, ...] = ()
    lower: float | None = None

    @property
    def missing(self) -> float | int:
        """The value that marks a missing result: NaN, the last code of flags (undecided, none), or 0 of other integers."""
        return len(self.flags) - 1 if self.flags else 0 if self.dtype.startswith(("int", "uint")) else math.nan

    def written(self, value: Any) -> str:
        """One value as text: the meaning of a code, twelve digits of a number, three digits of an error."""
        if self.flags:
            return f"{self.flags[int(value)]} ({int(value)})"
        return f"{value:.3g}" if self.name.endswith("_error") else f"{value:.12g}"
