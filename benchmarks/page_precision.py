"""The work-precision part of docs/benchmarks.md: the fastest method at an error of 1e-9, and failures at the extremes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.precision import GOAL, Judgement, Rung, judge, read
from benchmarks.results_files import LEVEL, is_level, markdown, not_measured, seconds, small, times

# Methods that a user of the package can choose; all others are rivals.
OWN = "package"
TITLES = {
    "cardan": "Cardan shaft: spectral radius",
    "bicardan": "Stepped shaft: critical speeds",
    "planetary": "Planetary gear: natural frequencies",
    "rattle": "Gear rattle: motion with backlash",
    "tripod": "Double tripod: motion over 1,000 strobes",
    "forced": "Cardan shaft: forced motion",
    "gradients": "Cardan shaft: gradient of the spectral radius",
    "attractors": "Gear rattle: attractors, basins, responses",
}


class Precision:
    """The rungs (settings of methods) of one system, by region and method."""

    def __init__(self, system: str, rungs: Sequence[Rung]) -> None:
        self.system = system
        self.regions = list(dict.fromkeys(rung.region for rung in rungs))
        self.methods = list(dict.fromkeys(rung.method for rung in rungs))
        self._rungs = rungs

    def ladder(self, region: str, method: str) -> list[Rung]:
        """All settings of a method in a region."""
        return [rung for rung in self._rungs if (rung.region, rung.method) == (region, method)]

    def reaching(self, region: str, method: str) -> Rung | None:
        """The fastest setting of a method whose error is at most 1e-9 at every point."""
        good = [r for r in self.ladder(region, method) if r.error <= GOAL and not r.failed]
        return min(good, key=lambda rung: rung.seconds_per_point, default=None)

    def fastest(self, region: str, own: bool) -> Rung | None:
        """The fastest setting that reaches 1e-9, of the package's methods (``own``) or of the rivals."""
        names = [method for method in self.methods if is_own(method) == own]
        good = [rung for rung in (self.reaching(region, name) for name in names) if rung]
        return min(good, key=lambda rung: rung.seconds_per_point, default=None)

    def judgement(self, region: str, method: str) -> Judgement | None:
        """The judgement of a method in a region; None if the method was not tried there."""
        rungs = self.ladder(region, method)
        return judge(rungs) if rungs else None


def is_own(method: str) -> bool:
    """True if the method belongs to the package."""
    return method.split(",")[0] == OWN


def load_precision(folder: Path) -> dict[str, Precision]:
    """All systems that have been measured."""
    paths = {system: folder / f"precision_{system}.csv" for system in TITLES}
    return {system: Precision(system, read(path)) for system, path in paths.items() if path.is_file()}


def conclusions(found: dict[str, Precision]) -> list[str]:
    """Regions won and lost by each system, then silent failures."""
    return [*(_winners(precision) for precision in found.values()), *(_silence(list(found.values())) if found else [])]


def losses(found: dict[str, Precision]) -> str:
    """A sentence that counts the regions where a rival is faster."""
    regions = [one for precision in found.values() for one in compared(precision)]
    behind = [one for one in regions if one.ratio <= 1 / LEVEL]
    most = max((1 / one.ratio for one in behind if one.ratio > 0), default=1.0)
    if not regions:
        return ""
    where = f"{len(behind)} of {len(regions)} regions (error {GOAL:g}, one core)"
    return (
        f"A rival is faster in {where}, up to {times(most)} times."
        if behind
        else f"No rival is faster in any of {where}."
    )


class Compared(NamedTuple):
    """A region, its fastest rival, and the time of the rival over that of the package.

    The ratio is infinite if no rival reaches the error, 0 if the package does not, NaN if no method does.
    """

    region: str
    rival: str
    ratio: float


def compared(precision: Precision) -> list[Compared]:
    """The package and its fastest rival in every region."""
    found = []
    for region in precision.regions:
        own, rival = precision.fastest(region, True), precision.fastest(region, False)
        ours, theirs = (rung.seconds_per_point if rung else math.inf for rung in (own, rival))
        ratio = math.nan if own is rival is None else theirs / ours
        found.append(Compared(region, rival.method if rival else "", ratio))
    return found


def _winners(precision: Precision) -> str:
    regions = compared(precision)
    won = [one for one in regions if one.ratio >= LEVEL]
    finite = [one.ratio for one in won if math.isfinite(one.ratio)]
    ends = list(dict.fromkeys(times(end(finite)) for end in (min, max))) if finite else []
    span = f", {' to '.join(ends)} times the fastest rival" if ends else ""
    alone = [one.region for one in won if math.isinf(one.ratio)]
    parts = [f"faster in {len(won)} of {len(regions)} regions{span}"] if won else []
    for words, names in (
        ("alone in reaching the error in", alone),
        ("level in", [f"{one.region} ({one.rival})" for one in regions if is_level(one.ratio)]),
        ("**slower** in", [f"{one.region} ({times(1 / one.ratio)} times, {one.rival})"
                           for one in regions if 0 < one.ratio <= 1 / LEVEL]),
        ("behind, without reaching the error, in", [f"{one.region} ({one.rival})" for one in regions if one.ratio == 0]),
        ("like all rivals above the error in", [one.region for one in regions if math.isnan(one.ratio)]),
    ):  # fmt: skip
        parts += [f"{words} {'; '.join(names)}"] if names else []
    return f"`{precision.system}`: {', '.join(parts)}."


def silent(systems: Iterable[Precision]) -> dict[str, list[str]]:
    """Systems and regions in which a method fails silently, by method."""
    found: dict[str, list[str]] = {}
    for precision in systems:
        for region in precision.regions:
            for method in precision.methods:
                judged = precision.judgement(region, method)
                if judged and judged.word == "SILENT":
                    found.setdefault(method, []).append(f"{precision.system} {region}")
    return found


def _silence(systems: Sequence[Precision]) -> list[str]:
    own, rivals = [], []
    for method, regions in silent(systems).items():
        (own if is_own(method) else rivals).append(f"{method} ({', '.join(regions)})")
    names = ", ".join(f"`{precision.system}`" for precision in systems)
    first = (
        f"**The package fails silently** in: {'; '.join(own)}."
        if own
        else f"No method of the package fails silently in any region measured ({names})."
    )
    return [first, f"Rivals that fail silently: {'; '.join(rivals)}."] if rivals else [first]


def section(folder: Path, images: str, system: str, found: dict[str, Precision]) -> str:
    """Figure, table of times at 1e-9 and table of extremes of one system."""
    name = f"precision_{system}"
    title = f"### {TITLES[system]}"
    if system not in found:
        return f"{title}\n\n{not_measured(name)}"
    precision = found[system]
    return "\n\n".join(
        [
            title,
            f"![Error against time per point, one panel for each region]({images}{name}.png)",
            f"Time per point (error) at the fastest setting with an error of at most {GOAL:g} at every point. "
            f"`only`: the smallest error, if no setting reaches {GOAL:g}. Bold: the fastest method of each region, and all "
            f"methods within {LEVEL - 1:.0%} of it.",
            _times_table(precision),
            "At the extremes:",
            _extremes_table(precision),
        ]
    )


def _times_table(precision: Precision) -> str:
    best = {}
    for region in precision.regions:
        both = [rung for rung in (precision.fastest(region, own) for own in (True, False)) if rung]
        best[region] = min(both, key=lambda rung: rung.seconds_per_point, default=None)
    rows = []
    for method in precision.methods:
        cells = [_time_cell(precision, region, method, best[region]) for region in precision.regions]
        rows.append([method, *cells])
    return markdown(["method", *precision.regions], rows)


def _time_cell(precision: Precision, region: str, method: str, best: Rung | None) -> str:
    rung = precision.reaching(region, method)
    if rung is not None:
        text = f"{seconds(rung.seconds_per_point)} ({small(rung.error)})"
        return f"**{text}**" if best and is_level(rung.seconds_per_point / best.seconds_per_point) else text
    errors = [rung.error for rung in precision.ladder(region, method) if not math.isnan(rung.error)]
    return f"only {small(min(errors))}" if errors else "-"


def _extremes_table(precision: Precision) -> str:
    rows = []
    for method in precision.methods:
        judged = [precision.judgement(region, method) for region in precision.regions]
        rows.append([method, *(_extreme_cell(one) for one in judged)])
    return markdown(["method", *precision.regions], rows)


def _extreme_cell(judged: Judgement | None) -> str:
    if judged is None:
        return "-"
    if judged.word == "holds":
        return f"holds{_notice(judged.how)}"
    word = f"**{judged.word}**" if judged.word == "SILENT" else judged.word
    return f"{word}: {judged.how}"


def _notice(how: str) -> str:
    _, _, notice = how.partition("; ")
    return f" ({notice})" if notice else ""
