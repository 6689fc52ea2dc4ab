"""An answer of a point or an atlas as text, as JSON and as sentences of a report; growth of disturbances in its words."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax.analysis.floquet.multipliers import VERDICTS
from drivetrain_jax.systems import System

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_answers import AtlasQuery


@dataclass(frozen=True, repr=False)
class Reply:
    """An answer in one sentence (empty if there is none), as ``lines`` of text, the first being the heading, and as plain
    numbers, words and lists (``data``)."""

    lines: Sequence[str]
    data: Mapping[str, Any]
    answer: str = ""

    @property
    def text(self) -> str:
        """The answer as ``print`` shows it."""
        return "\n".join([self.answer, *self.lines] if self.answer else self.lines)

    def __str__(self) -> str:
        return self.text

    # A notebook shows what `print` does.
    __repr__ = __str__

    def to_json(self) -> str:
        """``answer`` and ``data`` as one JSON object; numbers that are not finite become null."""
        return json.dumps(plain({"answer": self.answer, **self.data} if self.answer else self.data), allow_nan=False)

    def sentences(self) -> list[str]:
        """The answer, and the lines below the heading as sentences."""
        lines = [f"{line.strip()[:1].upper()}{line.strip()[1:]}." for line in self.lines[1:]]
        return [self.answer, *lines] if self.answer else lines


def plain(value: Any) -> Any:
    """``value`` in the types of JSON; complex numbers as ``real`` and ``imag``, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, (str, bool)):
        return value
    if np.iscomplexobj(value):
        return {"real": plain(np.real(value)), "imag": plain(np.imag(value))}
    if np.ndim(value):
        return [plain(entry) for entry in value]
    return np.asarray(value).item() if np.isfinite(value) else None


class Growth(NamedTuple):
    """``rate`` [1/s], negative for decay; ``per_turn``, the factor of the amplitude per turn of the shaft;
    ``time_to_double`` and ``time_to_halve`` [s] and ``turns_to_double`` and ``turns_to_halve``, infinite for the other case.
    """

    rate: np.ndarray
    per_turn: np.ndarray
    time_to_double: np.ndarray
    time_to_halve: np.ndarray
    turns_to_double: np.ndarray
    turns_to_halve: np.ndarray


def growth(spectral_radius: Any, period: Any, turn: Any) -> Growth:
    """The growth that a ``spectral_radius`` over one ``period`` [s] means; a ``turn`` of the shaft takes so long [s].

    ``rate = ln(spectral_radius)/period`` is the largest real part of the Floquet exponents. The equations of a cardan shaft
    have two periods in a turn.

    >>> found = growth(1.02, period=0.02, turn=0.04)
    >>> print(found.rate.round(4), found.time_to_double.round(4), found.turns_to_double.round(2))
    0.9901 0.7001 17.5
    """
    radius, period, turn = np.broadcast_arrays(*(np.asarray(x, float) for x in (spectral_radius, period, turn)))
    with np.errstate(divide="ignore"):
        rate = np.log(radius) / period
        # Not `way > 0`: NaN stays NaN.
        double, halve = (np.where(way <= 0, np.inf, np.log(2) / np.abs(way)) for way in (rate, -rate))
    return Growth(rate, np.exp(rate * turn), double, halve, double / turn, halve / turn)


def growth_at(asked: AtlasQuery, results: Mapping[str, Any]) -> dict[str, float]:
    """The growth that ``spectral_radius`` means at the point of the question; empty if it is not known."""
    system = asked.atlas.scene.system
    point = {**asked.atlas.fixed, **asked.values}
    known = asked.physical({name: value for name, value in point.items() if name == system.roles.get("speed")})
    turns = next((found["value"] for found in known.values() if found["units"] == "rpm"), None)
    return growth_of(system, point, results, turns)


def growth_of(
    system: type[System], point: Mapping[str, Any], results: Mapping[str, Any], turns: float | None
) -> dict[str, float]:
    """The growth at a ``point`` (parameters); ``turns`` is the speed [rpm], if known, of a shaft whose time has no unit."""
    radius = results.get("spectral_radius")
    frequency = point.get(system.roles.get("speed", "")) if system.time_units == "s" else None
    # An undecided radius is 1 within its error, and so is its growth 0; without damping it is 1.
    undecided = int(results.get("verdict", 0)) == VERDICTS.index("undecided")
    if radius is None or undecided or abs(radius - 1) < 1e-15 or not (frequency or system.periods_per_turn):
        return {}
    # A period takes 1/frequency seconds; otherwise the unit of time is the turn.
    turn = 60 / turns if turns else 1.0
    found = growth(radius, 1 / frequency if frequency else turn / system.periods_per_turn, turn)._asdict()
    names = ("rate", "time") if frequency else ("rate", "per", "time", "turns") if turns else ("per", "turns")
    return {n: float(x) for n, x in found.items() if np.isfinite(x) and n.startswith(names)}


def speed_in_rpm(system: type[System], physical: Mapping[str, tuple[Any, str]]) -> float | None:
    """The speed [rpm] among physical data with their units; None without one."""
    needs = system.physical.source(system.roles.get("speed", "")) if system.physical else ""
    value, units = physical.get(needs.partition(",")[0], (None, ""))
    return None if value is None else value * _units.factor(units, "rpm")


def growth_lines(found: Mapping[str, float], width: int = 24, sign: str = "= ") -> list[str]:
    """The growth as text, after a word of this ``width`` and a ``sign``."""
    if not found:
        return []
    grows = found["rate"] > 0 if "rate" in found else found["per_turn"] > 1
    way = "double" if grows else "halve"
    rate = f"{abs(found['rate']):.4g} 1/s" if "rate" in found else ""
    per_turn = f"by a factor {found['per_turn']:.6g} per turn" if "per_turn" in found else ""
    seconds = f"{found[f'time_to_{way}']:.4g} s" if f"time_to_{way}" in found else ""
    turns = f"{found[f'turns_to_{way}']:.4g} turns" if f"turns_to_{way}" in found else ""
    ends = ", ".join(text for text in (seconds, turns) if text)
    word = "growth" if grows else "decay"
    return [
        f"  {word:<{width}} {sign}{', '.join(filter(None, (rate, per_turn)))}{f'; {way}s in {ends}' if ends else ''}"
    ]
