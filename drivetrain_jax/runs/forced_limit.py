"""Amplitude of the forced motion against a limit: at a point, and along the speeds of a design answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._wording import shown
from drivetrain_jax.analysis.request import checked
from drivetrain_jax.systems import System

# Samples of a range of speeds: evenly spaced, and halving distances from both ends, where a resonance may lie.
_EVEN, _HALVINGS = 91, range(8, 22)
# Points and rounds by which peaks and crossings of the limit are refined.
_PARTS, _PEAK_ROUNDS, _LIMIT_ROUNDS = 9, 2, 3


@dataclass(frozen=True)
class Limit:
    """A largest allowed amplitude in the unit of the displacements, and the unit of its answers."""

    value: float
    units: str
    names: tuple[str, ...]
    own: str

    @classmethod
    def of(cls, system: type[System], given: Any) -> Limit:
        """The checked limit; :class:`InputError` for a system without a forced response."""
        if "forced" not in system.models or system.displacements is None:
            raise InputError(
                f"amplitude = {shown(given)}: {system.name} has no forced response; allowed for a system that has one"
            )
        own = system.state[0].units
        largest = math.pi / 2 if own == "rad" else math.inf
        parameter = Parameter("amplitude", own, "limit", lower=0.0, open_lower=True, upper=largest)
        parts = _units.split(given) if isinstance(given, str) else None
        if parts and not parts[1]:
            given = parts[0]
        value = float(checked(parameter, given, ""))
        names = tuple(map(str, system.displacements.values))
        return cls(value, parts[1] if parts and parts[1] else own, names, own)

    def written(self, amplitude: float) -> str:
        """An amplitude as text, in the unit of the limit."""
        return f"{amplitude * _units.factor(self.own, self.units):.6g} {self.units}"

    def at_point(self, amplitudes: np.ndarray, verdict: int) -> tuple[str, dict[str, Any]]:
        """The amplitudes at one point with this verdict, and whether they are within the limit: text and data.

        ``within`` is None if that is undecided.
        """
        known, unstable, undecided = bool(np.all(np.isfinite(amplitudes))), verdict == 1, verdict == 2
        above = known and bool(np.max(amplitudes) > self.value)
        within = None if not known or (undecided and not above) else not (above or unstable)
        names = self.names or tuple(map(str, range(1, len(amplitudes) + 1)))
        each = ", ".join(f"{name} {self.written(a)}" for name, a in zip(names, amplitudes, strict=True))
        compared = "unstable: the motion grows beyond" if unstable else "above" if above else "within"
        doubt = " if the motion is stable, which is undecided" if within is None else ""
        values = [float(a) if np.isfinite(a) else None for a in amplitudes]
        text = f"{each}; {compared} the limit of {self.written(self.value)}{doubt}" if known else "no value"
        return text, {
            "amplitude": dict(zip(names, values, strict=True)),
            "limit": self.value,
            "units": self.own,
            "within": within,
        }

    def along(
        self, amplitude: Callable[[np.ndarray], np.ndarray], low: float, high: float, likely: np.ndarray
    ) -> Along:
        """The amplitudes along the speeds from ``low`` to ``high``; ``amplitude`` returns those of all displacements.

        ``likely`` are speeds near peaks, which may be narrower than the distance of the samples.
        """
        steps = (high - low) * 0.5 ** np.array(_HALVINGS)
        likely = likely[(likely > low) & (likely < high)]
        x = np.unique(np.concatenate([np.linspace(low, high, _EVEN), low + steps, high - steps, likely]))
        y = amplitude(x)
        for _ in range(_PEAK_ROUNDS):
            size = np.max(y, axis=1)
            peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
            x, y = _refined(amplitude, x, y, [(x[k - 1], x[k + 1]) for k in peaks])
        for _ in range(_LIMIT_ROUNDS):
            inside = np.max(y, axis=1) <= self.value
            x, y = _refined(amplitude, x, y, [(x[k], x[k + 1]) for k in np.flatnonzero(inside[1:] != inside[:-1])])
        size = np.max(y, axis=1)
        k = int(np.argmax(size))
        edges = np.flatnonzero(np.diff(np.concatenate(([0], (size <= self.value).astype(np.int8), [0]))))
        ranges = tuple((float(x[a]), float(x[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))
        return Along(self, float(size[k]), float(x[k]), self.names[int(np.argmax(y[k]))], ranges)


def _refined(
    amplitude: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray, between: list[tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Samples with more of them ``between`` these pairs of speeds."""
    if not between:
        return x, y
    new = np.setdiff1d(np.concatenate([np.linspace(a, b, _PARTS) for a, b in between]), x)
    if not new.size:
        return x, y
    x, y = np.concatenate([x, new]), np.concatenate([y, amplitude(new)])
    order = np.argsort(x)
    return x[order], y[order]


@dataclass(frozen=True)
class Along:
    """The ``largest`` amplitude of a range of speeds, that of the displacement ``name`` at ``where``, and the ranges of
    speed ``within`` the limit."""

    limit: Limit
    largest: float
    where: float
    name: str
    within: tuple[tuple[float, float], ...]

    def text(self, named: Callable[[float], str]) -> str:
        """The amplitudes as text; ``named`` writes a speed."""
        most = f"at most {self.limit.written(self.largest)} ({self.name} at {named(self.where)})"
        if self.largest <= self.limit.value:
            return f"forced amplitude {most}: within the limit of {self.limit.written(self.limit.value)}"
        ranges = ", ".join(f"{named(a)} to {named(b)}" for a, b in self.within)
        kept = f"within the limit from {ranges}" if ranges else "above it at all of these speeds"
        return f"forced amplitude {most}: above the limit of {self.limit.written(self.limit.value)}; {kept}"

    @property
    def data(self) -> dict[str, Any]:
        """The amplitudes as plain numbers."""
        return {
            "limit": self.limit.value,
            "units": self.limit.own,
            "largest": self.largest,
            "where": self.where,
            "displacement": self.name,
            "within": [list(each) for each in self.within],
        }


def forced_along(atlas: Any, limit: Limit, ends: tuple[float, float], at: Mapping[str, float]) -> Along:
    """The amplitudes of a stored atlas along its speed, with the other parameters ``at``; no value counts as infinite."""
    system = atlas.scene.system
    speed, predicted = system.roles["speed"], system.resonances

    def amplitude(speeds: np.ndarray) -> np.ndarray:
        columns = {name: np.full(speeds.size, at[name]) for name in atlas.parameters if name != speed}
        return np.nan_to_num(atlas.amplitude({**columns, speed: speeds}), nan=np.inf)

    likely = np.empty(0)
    if predicted and predicted.axis == speed:
        forced = tuple(family.prefix for family in predicted.families if family.forced)
        excited = [bool(forced) and label.startswith(forced) for label in predicted.labels]
        likely = np.asarray(predicted.values({**atlas.fixed, **at}), float)[np.array(excited)]
    return limit.along(amplitude, *ends, likely)


def forced_at(atlas: Any, amplitude: Any, point: Mapping[str, float], verdict: Any) -> tuple[list[str], dict[str, Any]]:
    """The comparison of a stored atlas with a limit at one ``point``, as lines and as data; empty without a limit."""
    if amplitude is None:
        return [], {}
    limit = Limit.of(atlas.scene.system, amplitude)
    columns = {name: np.array([value]) for name, value in point.items()}
    verdict = atlas.direct(columns, "verdict")[0] if verdict is None else verdict
    text, data = limit.at_point(atlas.amplitude(columns)[0], int(verdict))
    return [f"forced amplitude: {text}"], {"forced": data}


def forced_over(
    atlas: Any, amplitude: Any, ranges: list[Any], at: Mapping[str, float], named: Callable[[str, float], str]
) -> tuple[list[list[str]], dict[str, Any]]:
    """The comparison with a limit in ``ranges`` of speed: lines for each, and data; no lines without a limit."""
    if amplitude is None:
        return [[] for _ in ranges], {}
    limit, speed = Limit.of(atlas.scene.system, amplitude), atlas.scene.system.roles["speed"]
    found = [forced_along(atlas, limit, ends, at) for ends in ranges]
    return [[each.text(lambda x: named(speed, x))] for each in found], {"forced": [each.data for each in found]}
