"""Numbers written with a unit: ``"18 deg"`` as radians, ``"1500 rpm"`` as rad/s.

An angle is a dimension of its own here: rpm, Hz and rad/s measure one thing (1 Hz is one turn a second, 60 rpm), and 1/s
another. Only the radian of a stiffness or damping may be left out (N m for N m/rad).
"""

from __future__ import annotations

import math
import re
from contextlib import suppress
from functools import cache, lru_cache
from typing import Any

_NUMBER = re.compile(r"\s*([+-]?(?:\d+(?:_\d+)*\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?inf)\s*(.*?)\s*", re.DOTALL)
_PRODUCT = re.compile(r"[\w\s*/^.·°%()²³⁴⁻¹-]+")
# The units of engineers, in the language of pint; a plural s and prefixes are understood.
_UNITS = (
    *("giga- = 1e9 = G-", "mega- = 1e6 = M-", "kilo- = 1e3 = k-", "centi- = 1e-2 = c-", "deci- = 1e-1 = d-"),
    *("milli- = 1e-3 = m-", "micro- = 1e-6 = µ- = μ- = u-", "nano- = 1e-9 = n-"),
    *("meter = [length] = m = metre", "second = [time] = s = sec", "gram = [mass] = g", "radian = [angle] = rad"),
    *("inch = 0.0254 meter = in = inches", "foot = 0.3048 meter = ft = feet", "thou = 0.001 inch"),
    *("minute = 60 second = min", "hour = 3600 second = h", "day = 86400 second"),
    *("tonne = 1e6 gram = t", "pound = 453.59237 gram = lb", "ounce = 28.349523125 gram = oz"),
    *(
        f"degree = {math.pi / 180!r} radian = deg = °",
        "arcminute = degree / 60 = arcmin",
        "arcsecond = degree / 3600 = arcsec",
    ),
    *(f"gon = {math.pi / 200!r} radian", f"turn = {2 * math.pi!r} radian = _ = rev = revolution = cycle"),
    *("rpm = turn / minute", "rps = turn / second", "cpm = turn / minute", "hertz = turn / second = Hz"),
    *("newton = kilogram * meter / second ** 2 = N", "kilogram_force = 9.80665 newton = kgf = kp"),
    *("pound_force = 4.4482216152605 newton = lbf", "joule = newton * meter = J", "watt = joule / second = W"),
    *("pascal = newton / meter ** 2 = Pa", "bar = 1e5 pascal", "psi = pound_force / inch ** 2"),
    "slug = pound_force * second ** 2 / foot = slugs",
    "percent = 0.01",
)
# Spellings that would be read as other units, or not at all.
_SPELLINGS = (
    (re.compile(r"(?<![A-Za-z])(?:[Uu]|r|tr)/min\b"), "rpm"),
    (re.compile(r"%"), "percent"),
    # A degree to some and 1/400 of a turn to others; a giga-radian to pint.
    (re.compile(r"\b[Gg]rad\b"), "?"),
    (re.compile(r"\bRPM\b"), "rpm"),
    # An inertia in inches: the pound is one of force.
    (re.compile(r"\blb(?=[ *·.-]*(?:in|ft)[ *·.-]*s(?:2|\^2|\*\*2|²))"), "lbf"),
    # kNm, Nmm, Ns, Nms and kgm2 are products; a prefix stays with its own unit.
    (re.compile(r"\b([kM]?N)(m?m)(s?)\b"), lambda found: "*".join(filter(None, found.groups()))),
    (re.compile(r"\b([kM]?N)s\b"), r"\1*s"),
    (re.compile(r"\bkg(m?m)(?=2|\^2|\*\*2|²)"), r"kg*\1"),
    (re.compile(r"(?<=[A-Za-z²³])[·.](?=[A-Za-z])"), "*"),
    # m2, s-2 and m/s2 as powers.
    (re.compile(r"(?<=[A-Za-z])(-?\d+)"), r"^\1"),
)


class UnitError(ValueError):
    """Raised for a text that is no number with a unit of the kind wanted; the message is the reason."""


def split(text: str) -> tuple[float, str] | None:
    """The number and the unit (which may be empty) at which ``text`` begins and ends; None without a number."""
    match = _NUMBER.fullmatch(text)
    return (float(match.group(1)), match.group(2)) if match else None


def misread(text: str) -> str:
    """A remark on what a text that is no number with a unit was meant to be; empty without a guess."""
    plain = text.replace(" ", "")
    if comma := re.match(r"[+-]?\d+,\d+(?![\d,.])", plain):
        thousands = comma[0].replace(",", "") + " or " if re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", comma[0]) else ""
        return f" (did you mean {thousands}{comma[0].replace(',', '.')}?)"
    if re.match(r"[+-]?[1-9]\d{0,2}(,\d{3}){2,}(?![\d,])", plain):
        return " (write digits without commas)"
    if quotient := re.fullmatch(r"([\d.]+)/([\d.]+)", plain):
        with suppress(ValueError, ZeroDivisionError):
            return f" (a quotient is written as a number: {float(quotient[1]) / float(quotient[2]):.10g})"
    return " (a range, where one number is needed)" if re.fullmatch(r"[^:]+:[^:]+", plain) else ""


def number(text: str, units: str) -> float:
    """The number in ``units`` that ``text`` writes in a unit of its own."""
    parts = split(text)
    if parts is None:
        raise UnitError("not a number with a unit")
    value, unit = parts
    if not unit:
        raise UnitError("a number in quotes")
    return value * factor(unit, units)


def behind(units: str) -> str:
    """`` units`` as they follow a number in a text; nothing for a pure number."""
    return "" if units in ("1", "") else f" {units}"


def with_unit(value: Any) -> Any:
    """``value`` as texts such as ``"18 deg"`` if it brings a unit, as a coordinate or a quantity of pint does."""
    unit = getattr(value, "attrs", {}).get("units") if hasattr(value, "attrs") else getattr(value, "units", None)
    unit = "" if unit is None else str(unit)
    if unit in ("", "1", "dimensionless"):
        return getattr(value, "magnitude", value)
    # Local import: the command line starts without NumPy.
    import numpy as np

    numbers = np.asarray(getattr(value, "magnitude", value))
    return _texts(numbers.tolist(), unit) if numbers.dtype.kind in "iuf" else value


def _texts(numbers: Any, unit: str) -> Any:
    return [_texts(number, unit) for number in numbers] if isinstance(numbers, list) else f"{numbers!r} {unit}"


@lru_cache(maxsize=256)
def factor(unit: str, units: str) -> float:
    """The number of ``units`` that one ``unit`` is. Raises :class:`UnitError` as :func:`number` does."""
    written, wanted = _parsed(unit), _parsed("" if units == "1" else units)
    if written.dimensionality != wanted.dimensionality and "/rad" in units:
        written = written / _parsed("rad")
    if written.dimensionality != wanted.dimensionality:
        raise UnitError(f"{unit} is a unit of another quantity")
    exact = float((written / wanted).to_base_units().magnitude)
    # A power of ten is written exactly, whatever way led to it.
    short = float(f"{exact:.12g}")
    return short if math.isclose(short, exact, rel_tol=1e-15) else exact


@cache
def _words() -> tuple[frozenset[str], str]:
    """The names of all units, and a pattern of their prefixes."""
    names = [re.split(r"\s*=\s*", line) for line in _UNITS]
    names = [[name, *others] for name, _, *others in names]
    prefixes = [name[:-1] for line in names for name in line if name.endswith("-")]
    return frozenset(name for line in names for name in line if not name.endswith("-")), "|".join(prefixes)


@lru_cache(maxsize=256)
def is_unit(units: str) -> bool:
    """True if every word of ``units`` names a unit; pint is not needed."""
    names, prefixes = _words()
    words = re.findall(r"[^\W\d_]+|[°%]", units)
    return all(word in names or re.sub(f"^({prefixes})", "", word) in names or word == "%" for word in words)


def _parsed(unit: str) -> Any:
    spelt = unit
    for pattern, plain in _SPELLINGS:
        spelt = pattern.sub(plain, spelt)
    registry = _registry()
    try:
        if unit and not _PRODUCT.fullmatch(unit):
            raise ValueError(unit)
        # Anything but a product of units, a number among them, is no unit.
        return 1 * registry.parse_units(spelt)
    except Exception as error:
        raise UnitError(f"{unit!r} is not a unit") from error


@cache
def _registry() -> Any:
    # Local import: pint takes half a second, and most input has no units.
    import pint

    empty: Any = None
    registry = pint.UnitRegistry(empty)
    registry.load_definitions(_UNITS)
    return registry
