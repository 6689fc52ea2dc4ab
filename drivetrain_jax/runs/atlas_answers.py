"""Answers of an atlas as text: values at a point, distances to the stability boundary, design values.

Every design answer is checked by direct solves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._units import behind
from drivetrain_jax.analysis import OUTCOME, get_analysis
from drivetrain_jax.analysis.floquet.multipliers import VERDICTS
from drivetrain_jax.atlas import design, proof
from drivetrain_jax.atlas.criteria import has_boundaries
from drivetrain_jax.atlas.panels import Atlas
from drivetrain_jax.atlas.windows import Crossing, Interval, narrow
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.atlas_file import StoredAtlas, as_given, check_same, moved_within
from drivetrain_jax.runs.physical import GivenData, in_parameters
from drivetrain_jax.runs.reply import (
    Reply,
    forced_at,
    forced_over,
    gradient_lines,
    growth_at,
    growth_lines,
    limit_line,
    radius_gradient,
    radius_sensitivities,
    verdict_words,
)

# Distance of a spectral radius from 1 below which the distance itself is printed.
_CLOSE = 1e-3
_OPEN = "found; whether there is one is undecided"
# Text after the end of a stable interval, by kind of end (`_kind`).
BEYOND = {
    "crossing": "",
    "range": " (the end of the range)",
    "atlas": " (the end of the atlas)",
    "undecided": " (undecided beyond)",
}


# The name, the value and the unit in which a value of a parameter is shown.
Shown = tuple[str, float, str]
Show = Callable[[str, float], Shown]
Range = tuple[float, float]

# Relative distance of a predicted resonance from a range that is named after it.
_NEAR = 0.05


def number(value: float, error: float = 0.0, most: int = 6) -> str:
    """A number as text with the digits that its ``error`` allows, ``most`` at the most."""
    known = math.log10(abs(value) / error) if 0 < error < math.inf and value else most
    return f"{value:.{min(max(int(known), 1), most)}g}"


def role_of(atlas: StoredAtlas, role: str) -> str:
    """The parameter with this ``role`` in the system; :class:`InputError` if it has none."""
    system = atlas.scene.system
    if role not in system.roles:
        raise InputError(f"file: {system.name} names no {role}; expected a system that does")
    return system.roles[role]


@dataclass(frozen=True)
class AtlasQuery:
    """The given values as parameters of the atlas (numbers or ranges), with the physical data behind them."""

    atlas: StoredAtlas
    values: Mapping[str, Any]
    shaft: GivenData | None
    # Instead of the physical data of the question, if given.
    show: Show | None = None
    # Flags of the points of direct solves whose verdict is proved.
    checked: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        atlas: StoredAtlas,
        given: Mapping[str, Any],
        ranges: tuple[str, ...],
        free: tuple[str, ...] = (),
        within: tuple[str, ...] = (),
    ) -> AtlasQuery:
        """Check the given values; ``ranges`` names parameters that have a range (default: that of the atlas), ``free`` those
        that are the answer, which a range ``within`` the atlas may restrict."""
        given = {name: _plain(value) for name, value in given.items()}
        shaft, values = in_parameters(atlas.scene.system, given, atlas.scene.data)
        for name, value in given.items():
            meant = shaft.parameter_of(name) if shaft else name
            if meant in free and not (meant in within and isinstance(value, tuple)):
                allowed = "leave it out" + (", or LOW:HIGH" if meant in within else "")
                raise InputError(f"{name} = {as_given(value)}: is the answer; {allowed}")
        for name in (*ranges, *free):
            if name not in atlas.parameters:
                behind = {n: known[0].name for n in (*ranges, *free) if shaft and (known := shaft.back(n))}
                over = ", ".join(behind.get(n, n) for n in (*ranges, *free))
                raise InputError(f"file: the atlas does not vary {behind.get(name, name)}; expected one over {over}")
        for name, value in values.items():
            if name in atlas.fixed and name not in free:
                source = shaft.physical.source(name) if shaft and name not in given else ""
                if shaft and source and isinstance(value, float):
                    known, made = (shaft.quantity(name, x) for x in (value, atlas.fixed[name]))
                    if known and made and made[0] in given:
                        check_same(made[0], known[1], made[1], units=made[2])
                check_same(name, value, atlas.fixed[name], source)
        kept = {name for name in atlas.parameters if name not in free or name in within}
        kept_values = {name: atlas.ranges[name] for name in ranges}
        kept_values |= {name: moved_within(value, atlas.ranges[name]) for name, value in values.items() if name in kept}
        backs = {name: shaft.back(name) for name in atlas.parameters if shaft and name not in given}
        seen = replace(atlas, views={name: back for name, back in backs.items() if back})
        for name in values:
            if name not in atlas.parameters and name not in atlas.fixed:
                physical = atlas.scene.system.physical
                seen.refuse(name, values[name], *atlas.fixed, *(physical.names if physical else ()))
        for name in atlas.parameters:
            if name not in free or name in kept_values:
                _check_range(seen, name, kept_values.get(name), name in (*ranges, *within))
        return cls(atlas, kept_values, shaft)

    def direct(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Spectral radii by direct solves; the points whose verdict is proved are counted."""
        radius = self.atlas.direct(columns)
        # Without damping multipliers of stable points lie on the unit circle, up to rounding.
        flags = [self.atlas.proved(columns, radius > 1 + margin) for margin in (0.0, design.ON_THE_CIRCLE)]
        self.checked.append(np.any(flags, axis=0))
        return radius

    def proofs(self) -> tuple[list[str], dict[str, int]]:
        """The number of checked points whose verdict is proved, as a line (none without checks) and as data."""
        flags = np.concatenate([np.empty(0, bool), *self.checked])
        said = proof.summary(flags, "points checked")
        line = f"  {said}; between them they hold by estimate" if "proved" in said else f"  {said}"
        return [line] * bool(flags.size), {"proved": int(flags.sum()), "points": flags.size}

    def numbers(self) -> dict[str, float]:
        """The values that are numbers."""
        return {name: value for name, value in self.values.items() if not isinstance(value, tuple)}

    def heading(self) -> str:
        """The conditions of the answer as text."""
        everything = {**self.values, **self.atlas.fixed}
        return ", ".join(
            self.span(name, value) if isinstance(value, tuple) else self.named(name, value)
            for name, value in everything.items()
        )

    def shown(self, name: str, value: float) -> Shown:
        """A value of a parameter as it is shown: as the physical quantity behind it, if that is known."""
        physical = self.shaft.quantity(name, value) if self.shaft and not self.show else None
        return self.show(name, value) if self.show else physical or (name, value, "1")

    def named(self, name: str, value: float, error: float | None = None) -> str:
        """A value as text, with the bound of its ``error`` if given: ``angle = 17.76 deg (beta = 0.31)``."""
        label, quantity, units = self.shown(name, value)
        known = error if error is not None and math.isfinite(error) else 0.0
        aside = [f"{name} = {number(value, known)}"] if label != name and not self.show else []
        aside += [f"error at most {known:.1e}"] if known else []
        bound = known * abs(quantity / value) if value else 0.0
        text = f"{label} = {number(quantity, bound)}{behind(units)}"
        return f"{text} ({', '.join(aside)})" if aside else text

    def span(self, name: str, ends: Range) -> str:
        """A range as text: ``speed = 1422 to 1429 rpm``."""
        label, _, units = self.shown(name, ends[0])
        low, high = (self.shown(name, end)[1] for end in ends)
        # A narrow range needs more digits than a number.
        width, largest = abs(high - low), max(abs(low), abs(high))
        digits = max(6, math.ceil(math.log10(largest / width)) + 1) if width else 6
        return f"{label} = {number(low, most=digits)} to {number(high, most=digits)}{behind(units)}"

    def physical(self, values: Mapping[str, float | Range]) -> dict[str, Any]:
        """``values`` in the physical units of the input; empty without physical input."""
        physical = {}
        for name, value in values.items():
            if self.shaft and (back := self.shaft.back(name)):
                quantity, convert = back
                numbers = np.asarray(convert(np.asarray(value))).tolist()
                physical[quantity.name] = {"value": numbers, "units": quantity.units}
        return physical


def _plain(value: Any) -> Any:
    return tuple(map(_plain, value)) if isinstance(value, tuple) else toml.plain(value)


def _check_range(atlas: StoredAtlas, name: str, value: Any, wanted: bool) -> None:
    """Raise :class:`InputError` unless ``value`` is a number, or a rising range if ``wanted``, within the atlas."""
    low, high = atlas.ranges[name]
    label: str = atlas.viewed_as(name)[0].name
    ends = value if isinstance(value, tuple) else (value,)
    allowed = f"expected {f'{label}=LOW:HIGH within ' if wanted else ''}{atlas.allowed(name)}"
    if value is None:
        raise InputError(f"{label}: missing; {allowed}")
    numbers = [atlas.viewed_as(name, end)[-1] if isinstance(end, float) else end for end in ends]
    shown = as_given(tuple(numbers))
    if isinstance(value, tuple) != wanted:
        needed = "a range is needed" if wanted else "is a range"
        raise InputError(f"{label} = {shown}: {needed}; {allowed}")
    for end, number in zip(ends, numbers, strict=True):
        if isinstance(end, bool) or not isinstance(end, (int, float)) or not low <= end <= high:
            raise InputError(f"{label} = {as_given(number)}: {allowed}")
    if wanted and not value[0] < value[1]:
        raise InputError(f"{label} = {shown}: expected a rising range")


def query(atlas: StoredAtlas, given: Mapping[str, float], amplitude: Any = None) -> Reply:
    """Results at one point, the gradient of the spectral radius, and the nearest change of stability along every parameter.

    The gradient comes from direct solves, with respect to every parameter of the system. Raises :class:`InputError` for
    names and values outside the atlas, :class:`ChunkError` if a direct solve fails.
    """
    asked = AtlasQuery.of(atlas, given, ranges=())
    point = asked.values
    columns = {name: np.array([value]) for name, value in point.items()}
    results = {name: values[0] for name, values in atlas.arrays(columns, zipped=True).items()}
    variables = {v.name: v for v in (*atlas.scene.analysis.variables, OUTCOME)}
    proved = "verdict" in results and bool(atlas.proved(point, results["verdict"]))
    rows = [
        f"  {name:<24} {', '.join(map(variables[name].written, np.atleast_1d(value)))}"
        for name, value in results.items()
    ]
    verdict = VERDICTS[int(results["verdict"])] if "verdict" in results else ""
    if verdict == "undecided":
        rows.append(f"  {'':<24} {get_analysis('floquet').advice(atlas.request)}")
    elif verdict:
        rows.append(f"  {'proof':<24} the verdict {'is proved' if proved else 'holds by estimate, not by proof'}")
    slopes = radius_gradient(atlas.scene.system, {**atlas.fixed, **point})
    effects = radius_sensitivities(asked, slopes)
    panels, system = atlas.stability.atlas, atlas.scene.system
    nearest = design.nearest_boundaries(panels, system, point) if has_boundaries(panels, system) else ()
    grows = growth_at(asked, results)
    lines = [f"{system.name} atlas, {asked.heading()}", *rows, *growth_lines(grows, sign=""), *gradient_lines(effects)]
    lines += ["nearest change of stability"] if nearest or not panels.panels else []
    lines += [] if panels.panels else [f"  unknown: the atlas has no panel ({panels.gaps[0].reason})"]
    lines += [line for change in nearest for line in _nearest_lines(asked, change)]
    compared, forced = forced_at(atlas, amplitude, point, results.get("verdict"))
    lines += compared
    data = {
        "system": atlas.scene.system.name,
        **forced,
        "parameters": {**atlas.fixed, **point},
        "physical": asked.physical(point),
        "values": results,
        "meanings": {n: variables[n].flags[int(v)] for n, v in results.items() if variables[n].flags},
        "proved": proved,
        **({"growth": grows} if grows else {}),
        "gradient": slopes,
        "sensitivities": [change._asdict() for change in effects or ()],
        "nearest": {
            change.parameter: {
                "below": _crossing(asked, change.parameter, change.below),
                "above": _crossing(asked, change.parameter, change.above),
                "undecided": [list(r) for r in change.undecided],
            }
            for change in nearest
        },
    }
    return Reply(lines, data, _point_sentence(asked, data["meanings"].get("verdict"), grows, nearest))


def _point_sentence(
    asked: AtlasQuery, verdict: str | None, grows: Mapping[str, float], nearest: Sequence[design.Nearest]
) -> str:
    """Verdict, growth and the nearest change of stability along the speed (or the first parameter), in one sentence."""
    if verdict is None:
        return ""
    words = verdict_words(verdict, grows)
    speed = asked.atlas.scene.system.roles.get("speed")
    changes = [(change, c) for change in nearest for c in (change.below, change.above) if c]
    along = [(change, c) for change, c in changes if change.parameter == speed] or [
        x for x in changes if x[0] is changes[0][0]
    ]
    if along:
        change, crossing = min(along, key=lambda x: abs(x[1].value - x[0].value))
        words.append(f"the nearest change of stability lies {_side(asked, change.parameter, change.value, crossing)}")
    return f"{'; '.join(words)}."


def least_damping(
    atlas: StoredAtlas,
    given: Mapping[str, float | Range],
    amplitude: Any = None,
    show: Show | None = None,
    vary: str = "",
) -> Reply:
    """The least damping, or the least value of another parameter to ``vary``, above which a range of speeds is stable.

    Without a range it is that of the atlas. If the largest damping of the atlas is unstable, the answer lists the stable
    ranges of damping. For a cardan shaft in physical units the answer is ``c1``; of given dampings only the ratio
    ``c2/c1`` is used. Raises as :func:`query`.
    """
    asked, answer = _limit("damping", design.least_damping, atlas, given, show, vary)
    return _answered(f"least {vary or 'damping'}", "from {} on", "largest", asked, answer, amplitude)


def widest_angle(
    atlas: StoredAtlas,
    given: Mapping[str, float | Range],
    amplitude: Any = None,
    show: Show | None = None,
    vary: str = "",
) -> Reply:
    """The widest joint angle, or the largest value of a parameter to ``vary``, below which a range of speeds is stable.

    Without a range it is that of the atlas. If the smallest angle of the atlas is unstable, the answer lists the stable
    ranges of angle. Raises as :func:`query`.
    """
    asked, answer = _limit("angle", design.widest_angle, atlas, given, show, vary)
    return _answered(f"largest {vary}" if vary else "widest angle", "up to {}", "smallest", asked, answer, amplitude)


def _limit(
    role: str,
    question: Callable[..., design.Answer],
    atlas: StoredAtlas,
    given: Mapping[str, float | Range],
    show: Show | None,
    vary: str,
) -> tuple[AtlasQuery, design.Answer]:
    """The limit of the parameter with this ``role``, or of ``vary``, within which a range of speeds is stable."""
    speed = role_of(atlas, "speed")
    shown = {quantity.name: name for name, (quantity, _) in atlas.viewed(given, (vary,)).views.items()}
    limited = shown.get(vary, vary) or role_of(atlas, role)
    if limited == speed:
        raise InputError(f"vary = {vary!r}: is the speed; expected another parameter of the atlas")
    asked = replace(AtlasQuery.of(atlas, given, ranges=(speed,), free=(limited,)), show=show)
    panels, system = atlas.stability.atlas, atlas.scene.system
    return asked, question(panels, system, asked.values[speed], asked.numbers(), vary=limited, direct=asked.direct)


def speed_windows(
    atlas: StoredAtlas, given: Mapping[str, float], margin: float = 0.0, amplitude: Any = None, show: Show | None = None
) -> Reply:
    """The stable ranges of speed, shortened by ``margin`` times the speed at either end, within a range of speeds if one is
    given. Raises as :func:`query`."""
    if not 0 <= margin < 1:
        meant = f"; did you mean {margin:g} %?" if 1 <= margin < 100 else ""
        raise InputError(f"margin = {margin!r}: expected 0 <= margin < 1{meant}")
    speed = role_of(atlas, "speed")
    asked = replace(AtlasQuery.of(atlas, given, ranges=(), free=(speed,), within=(speed,)), show=show)
    panels = atlas.stability.atlas
    part = narrow(panels, {speed: asked.values[speed]}) if speed in asked.values else panels
    answer = design.speed_windows(
        panels, atlas.scene.system, asked.numbers(), margin=margin, within=asked.values.get(speed), direct=asked.direct
    )
    names = [_resonance(asked, speed, interval) for interval in answer.unstable]
    compared, forced = forced_over(atlas, amplitude, [w.safe for w in answer.windows], asked.numbers(), asked.named)
    lines, sensitivities = [f"safe speeds, {asked.heading()}, margin {margin:g}"], []
    for k, w in enumerate(answer.windows):
        ends = " to ".join(
            asked.named(speed, value) + BEYOND[_kind(asked, speed, *end)]
            for value, end in zip(w.safe, w.interval.ends, strict=True)
        )
        lines.append(
            f"  stable from {ends}; largest spectral radius {_from_one(w.largest)} at {asked.named(speed, w.where)}"
        )
        lines += [f"    {_checked(w.check)}"] if w.check else []
        places = zip(("lower", "upper"), (w.interval.lower_end, w.interval.upper_end), strict=True)
        effects = [limit_line(asked, speed, limit, f"    at the {end} end: ") for end, limit in places]
        lines += [text for text, _ in effects if text]
        sensitivities.append([effect for _, effect in effects])
        lines += [f"    {text}" for text in compared[k : k + 1]]
    proofs, proved = asked.proofs()
    data = {
        "question": "speed_windows",
        "parameters": {**atlas.fixed, **asked.values},
        "margin": margin,
        "windows": [
            {
                "safe": list(w.safe),
                "physical": asked.physical({speed: w.safe}),
                "ends": _ends(asked, speed, w.interval),
                "sensitivities": effects,
                "largest": w.largest,
                "where": w.where,
                "check": _check(w.check),
            }
            for w, effects in zip(answer.windows, sensitivities, strict=True)
        ],
        "unstable": [
            {"range": [i.lower, i.upper], "physical": asked.physical({speed: (i.lower, i.upper)}), "resonance": word}
            for i, word in zip(answer.unstable, names, strict=True)
        ],
        "undecided": [list(r) for r in answer.undecided],
        "proofs": proved,
        **forced,
    }
    whole = "in this range" if speed in asked.values else "within the atlas"
    where = _OPEN if answer.undecided else "with this margin" if margin else whole
    lines += [] if answer.windows else [f"  none {where}"]
    lines += [*_undecided(asked, speed, answer.undecided), *proofs]
    return Reply(lines, data, _where_unstable(asked, part, speed, answer, names))


def _where_unstable(
    asked: AtlasQuery, part: Atlas, speed: str, answer: design.Windows, names: Sequence[str | None]
) -> str:
    """The unstable ranges with the ``names`` of their resonances, and the damping that removes them, in one sentence."""
    k = part.parameters.index(speed)
    ends = float(part.lower[k]), float(part.upper[k])
    if not answer.unstable:
        # Without a stable range nothing is decided.
        word = "Stable" if answer.windows or not answer.undecided else "Undecided"
        return f"{word} at {asked.span(speed, ends)}{_but_undecided(answer.undecided if answer.windows else ())}."
    label = asked.shown(speed, ends[0])[0]
    ranges = [
        asked.span(speed, (i.lower, i.upper)).removeprefix(f"{label} = ") + (f" ({word})" if word else "")
        for i, word in zip(answer.unstable, names, strict=True)
    ]
    return (
        f"Unstable at {label} = {_and(ranges)}{_removed(asked, part, speed, ends)}{_but_undecided(answer.undecided)}."
    )


def _removed(asked: AtlasQuery, part: Atlas, speed: str, speeds: Range) -> str:
    """The least damping that makes all ``speeds`` stable, as the end of a sentence; empty if the atlas does not tell."""
    system = asked.atlas.scene.system
    damping = system.roles.get("damping")
    if damping not in part.parameters:
        return ""
    others = {name: value for name, value in asked.numbers().items() if name not in (speed, damping)}
    answer = design.least_damping(part, system, speeds, others)
    if answer.value is None or not answer.certain:
        return ""
    return f"; {asked.named(damping, _rounded(answer, 1.0))} or more{_end_of_atlas(asked, answer)} removes this"


def _end_of_atlas(asked: AtlasQuery, answer: design.Answer) -> str:
    """The end behind "or more" or "or less", beyond which the atlas does not tell; empty at 0."""
    end = abs(answer.safe_end)
    label, shown, _ = asked.shown(answer.parameter, end)
    return "" if end in (0.0, answer.value) else f" (the atlas ends at {label} = {number(shown)})"


def _rounded(answer: design.Answer, side: float) -> float:
    """The value of an answer, moved to the safe ``side`` so far that six digits of it are safe."""
    value = answer.value or 0.0
    return value + side * (5e-6 * abs(value) + answer.error) if answer.limit else value


def _resonance(asked: AtlasQuery, speed: str, interval: Interval) -> str | None:
    """The predicted resonance nearest to an unstable ``interval``, whose multipliers leave the unit circle as it says."""
    predicted, point = asked.atlas.scene.system.resonances, {**asked.atlas.fixed, **asked.numbers()}
    if predicted is None or predicted.axis != speed or not point.keys() >= set(predicted.parameters):
        return None
    ways, values = {crossing.multiplier for crossing in interval.crossings}, predicted.values(point)
    apart = np.maximum(np.maximum(interval.lower - values, values - interval.upper), 0) / values
    fitting = [
        (distance, f"{family.name.partition(' $')[0]} {label}")
        for distance, label, way in zip(apart, predicted.labels, predicted.multipliers, strict=True)
        if distance <= _NEAR and way in ways and (family := predicted.family(label)) and family.drawn
    ]
    return min(fitting)[1] if fitting else None


def _and(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _but_undecided(ranges: Sequence[Range]) -> str:
    return f"; {len(ranges)} range{'s are' if len(ranges) > 1 else ' is'} undecided" if ranges else ""


def _undecided(asked: AtlasQuery, name: str, ranges: Iterable[Range]) -> list[str]:
    lines = [f"  undecided: {asked.span(name, ends)}" for ends in ranges]
    remedy = (
        "  undecided ranges: `drivetrain point` solves a value there directly; a smaller rtol of the atlas narrows them"
    )
    return [*lines, remedy] if lines else []


def _kind(asked: AtlasQuery, name: str, end: float, crossing: Crossing | None) -> str:
    """The kind of the end of a stable interval: ``crossing``, ``range`` (the end of the given range), ``atlas`` (the end of
    the atlas) or ``undecided``."""
    if crossing:
        return "crossing"
    low, high = asked.atlas.ranges[name]
    if end in np.atleast_1d(asked.values.get(name, ())) and end not in (low, high):
        return "range"
    # Angles are without signs here.
    return "atlas" if abs(end) in {abs(low), abs(high), *([0.0] if low < 0 < high else [])} else "undecided"


def _ends(asked: AtlasQuery, name: str, interval: Interval) -> list[dict[str, Any]]:
    """Both ends of a stable interval as data; a crossing has ``error`` and ``multiplier``."""
    return [
        {
            "value": value,
            "kind": _kind(asked, name, value, crossing),
            "error": crossing.error if crossing else None,
            "multiplier": crossing.multiplier if crossing else None,
        }
        for value, crossing in interval.ends
    ]


def _bounded(asked: AtlasQuery, name: str, value: float, crossing: Crossing | None) -> str:
    """One end of a stable interval as text, with its error."""
    if crossing is None:
        return asked.named(name, value) + BEYOND[_kind(asked, name, value, crossing)]
    return asked.named(name, value, crossing.error)


def _answered(title: str, phrase: str, safe: str, asked: AtlasQuery, answer: design.Answer, amplitude: Any) -> Reply:
    """The answer as text; ``phrase`` names the value, ``safe`` the stable end of the atlas."""
    name = answer.parameter
    lines = [f"{title}, {asked.heading()}"]
    if answer.value is not None:
        lines.append(f"  stable {phrase.format(_bounded(asked, name, answer.value, answer.limit))}")
    elif answer.stable:
        lines += _elsewhere(safe, asked, answer)
    else:
        lines.append(f"  no {name} {'of the atlas is sufficient' if answer.certain else _OPEN}")
    if answer.limit:
        where = ", ".join(asked.named(n, v) for n, v in answer.limit.point.items())
        lines.append(f"  limit: multiplier {answer.limit.multiplier} at {where}")
    effect, sensitivities = limit_line(asked, name, answer.limit, "  ")
    lines += [effect] if effect else []
    if answer.check:
        lines += [] if answer.certain else ["  not certain: undecided ranges are wider than the errors"]
        lines.append(f"  {_checked(answer.check)}")
    proofs, proved = asked.proofs()
    lines += [*_undecided(asked, name, answer.undecided), *proofs]
    speeds = [] if answer.value is None else [asked.values[asked.atlas.scene.system.roles["speed"]]]
    compared, forced = forced_over(
        asked.atlas, amplitude, speeds, {**asked.numbers(), name: answer.value or 0.0}, asked.named
    )
    lines += [f"  {text}" for text in compared]
    data = {
        "question": title.replace(" ", "_"),
        "parameters": {**asked.atlas.fixed, **asked.values},
        "parameter": name,
        "value": answer.value,
        "physical": {} if answer.value is None else asked.physical({name: answer.value}),
        "error": answer.error,
        "certain": answer.certain,
        "limit": _crossing(asked, name, answer.limit),
        "sensitivities": sensitivities,
        "intervals": [
            {"physical": asked.physical({name: (i.lower, i.upper)}), "ends": _ends(asked, name, i)}
            for i in answer.stable
        ],
        "undecided": [list(r) for r in answer.undecided],
        "check": _check(answer.check),
        "proofs": proved,
        **forced,
    }
    return Reply(lines, data, _extreme_sentence(safe, asked, answer))


def _extreme_sentence(safe: str, asked: AtlasQuery, answer: design.Answer) -> str:
    """The answer in one sentence; ``safe`` is the stable end of the atlas, ``largest`` or ``smallest``."""
    name, side, way = answer.parameter, *((1.0, "more") if safe == "largest" else (-1.0, "less"))
    speed = asked.atlas.scene.system.roles["speed"]
    label, speeds = asked.shown(name, answer.safe_end)[0], asked.span(speed, asked.values[speed])
    doubt = "" if answer.certain else " (not certain: some ranges are undecided)"
    if answer.value is not None:
        value = f"{asked.named(name, _rounded(answer, side))} or {way}{_end_of_atlas(asked, answer)}"
        return f"With {value}, {speeds} is stable{doubt}."
    if not answer.stable:
        return f"{'No' if answer.certain else 'Perhaps no'} {label} of the atlas makes {speeds} stable."
    ranges = _and([asked.span(name, (i.lower, i.upper)) for i in answer.stable])
    return f"With {ranges}, {speeds} is stable; with the {safe} {label} of the atlas it is not{doubt}."


def _elsewhere(safe: str, asked: AtlasQuery, answer: design.Answer) -> list[str]:
    """The text if the safe end is unstable: the stable intervals."""
    name, end = answer.parameter, answer.safe_end
    unstable = any(i.lower <= end <= i.upper for i in answer.intervals)
    lines = [f"  {'unstable' if unstable else 'undecided'} at {asked.named(name, end)}, the {safe} of the atlas"]
    for interval in answer.stable:
        lower, upper = (_bounded(asked, name, *bounds) for bounds in interval.ends)
        lines.append(f"  stable from {lower} to {upper}")
    return lines


def _nearest_lines(asked: AtlasQuery, nearest: design.Nearest) -> list[str]:
    sides = [_side(asked, nearest.parameter, nearest.value, c) for c in (nearest.below, nearest.above) if c]
    label = asked.shown(nearest.parameter, nearest.value)[0]
    lines = [f"  {label:<24} {'; '.join(sides) or _reach(asked, nearest)}"]
    return lines + [f"  {'':<24} undecided: {asked.span(nearest.parameter, ends)}" for ends in nearest.undecided]


def _side(asked: AtlasQuery, name: str, value: float, crossing: Crossing) -> str:
    _, here, _ = asked.shown(name, value)
    _, there, units = asked.shown(name, crossing.value)
    where = "below" if crossing.value <= value else "above"
    place = asked.named(name, crossing.value, crossing.error)
    return f"{number(abs(there - here))}{behind(units)} {where}: {place}"


def _reach(asked: AtlasQuery, nearest: design.Nearest) -> str:
    # Stability may change inside an undecided range.
    elsewhere = ", except undecided ranges:" if nearest.undecided else ""
    return f"none within {asked.span(nearest.parameter, asked.atlas.ranges[nearest.parameter])}{elsewhere}"


def _crossing(asked: AtlasQuery, name: str, crossing: Crossing | None) -> dict[str, Any] | None:
    if crossing is None:
        return None
    return {
        "value": crossing.value,
        "physical": asked.physical({name: crossing.value}),
        "error": crossing.error,
        "multiplier": crossing.multiplier,
        "point": dict(crossing.point),
        "physical_point": asked.physical(crossing.point),
    }


def _check(check: design.Check | None) -> dict[str, Any] | None:
    names = ("inside", "beyond", "solves", "agrees")
    return {name: getattr(check, name) for name in names} if check else None


def _checked(check: design.Check) -> str:
    inside = f"spectral radius at most {_from_one(check.inside)} inside"
    beyond = "" if math.isnan(check.beyond) else f", {_from_one(check.beyond)} beyond it"
    verdict = "agree" if check.agrees else "DISAGREE"
    return f"direct solves {verdict}: {inside}{beyond} ({check.solves} solves)"


def _from_one(radius: float) -> str:
    """A spectral radius near 1 as its distance from 1, to keep its digits."""
    apart = radius - 1
    return f"{radius:.6g}" if not 0 < abs(apart) < _CLOSE else f"1 {'+' if apart > 0 else '-'} {abs(apart):.1e}"
