"""Names with units and ranges: the vocabulary that every layer shares. Free of jax and of files."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivetrain_jax._wording import shown

# Codes of ``outcome`` from here on mean that there is no value.
FIRST_FAILURE = 2


@dataclass(frozen=True)
class Parameter:
    """An input of a system or an option of an analysis.

    ``default=None`` means that it must be given, unless ``derived`` says from what a model computes it when it is not;
    the model then finds no such value, and an analysis an option of ``None``. ``lower``/``upper`` are inclusive unless
    the matching ``open_*`` flag is set; ``infinite`` admits infinity. ``choices`` makes it one of these words, ``text``
    any word, ``listed`` a list of numbers of which each entry obeys the range (default ``()``: none), ``listed`` with
    ``broadcast`` such a list or one number that stands for a list of equal entries. ``symbol`` is how formulas write it.
    """

    name: str
    units: str
    long_name: str
    default: float | int | str | tuple[float, ...] | None = None
    derived: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    open_lower: bool = False
    open_upper: bool = False
    choices: tuple[str, ...] = ()
    listed: bool = False
    broadcast: bool = False
    integer: bool = False
    infinite: bool = False
    text: bool = False
    symbol: str = ""

    @property
    def is_number(self) -> bool:
        """Whether one number is an admissible kind of value, so that it can vary as a whole."""
        return not (self.choices or self.text or (self.listed and not self.broadcast))

    @property
    def allowed(self) -> str:
        """The admissible values as a reader would write them, e.g. ``0 <= zeta < inf``."""
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
        if left or right:
            return f"{kind}{left}{self.name}{listed}{right}{either}"
        return f"{self.name} is a finite {kind or 'number'}".rstrip()

    @property
    def allowed_in_units(self) -> str:
        """The same with the unit: a number that is out of range was often meant in another one."""
        return self.allowed if self.units == "1" else f"{self.allowed}, in {self.units}"

    def check(self, value: object) -> float | int | str | tuple[float, ...]:
        """Return ``value`` in its stored type, or raise ``ValueError`` with one line that names the range."""
        if self.choices:
            # A word that looks like a number may be written without quotes.
            value = str(value) if isinstance(value, int) and str(value) in self.choices else value
            if value not in self.choices:
                raise ValueError(f"{self.name} = {shown(value)}: allowed is {self.allowed}")
            return value
        if self.text:
            if not isinstance(value, str):
                raise ValueError(f"{self.name} = {shown(value)}: allowed is text")
            return value
        if self.listed and not (self.broadcast and not isinstance(value, (list, tuple))):
            if not isinstance(value, (list, tuple)) or not value:
                raise ValueError(f"{self.name} = {shown(value)}: allowed is a list of numbers, {self.allowed}")
            return tuple(self._check_number(entry, f"{self.name}[{i}]") for i, entry in enumerate(value))
        return self._check_number(value, self.name)

    def _check_number(self, value: object, label: str) -> float | int:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{label} = {shown(value)}: allowed is a number, {self.allowed}")
        below = value <= self.lower if self.open_lower else value < self.lower
        above = value >= self.upper if self.open_upper else value > self.upper
        finite = math.isfinite(value) or (self.infinite and value == math.inf)
        if not finite or below or above or (self.integer and value != int(value)):
            raise ValueError(f"{label} = {value!r}: allowed is {self.allowed_in_units}")
        return int(value) if self.integer else float(value)


@dataclass(frozen=True)
class Dimension:
    """An axis that an analysis adds to its results: its coordinate values and their meaning.

    Empty ``values`` stand for 0, 1, ... as many as the results have.
    """

    name: str
    long_name: str
    values: tuple[int | float | str, ...]
    units: str = "1"


@dataclass(frozen=True)
class Variable:
    """A result of an analysis. ``dims`` names the dimensions it has besides those of the sweep.

    ``flags`` gives the meaning of the codes 0, 1, ... of an integer variable.
    """

    name: str
    units: str
    long_name: str
    dims: tuple[str, ...] = ()
    dtype: str = "float64"
    flags: tuple[str, ...] = ()

    def written(self, value: complex) -> str:
        """One value as a reader would write it: the meaning of a code; of a number twelve digits, of an error three."""
        if self.flags:
            return f"{self.flags[int(value)]} ({int(value)})"
        return f"{value:.3g}" if self.name.endswith("_error") else f"{value:.12g}"
