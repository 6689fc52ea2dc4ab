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
    """A sentence that lists the regions where a rival is faster; empty without any."""
    behind = {system: _compared(precision).lost for system, precision in found.items()}
    told = " ".join(f"`{system}`: {'; '.join(regions)}." for system, regions in behind.items() if regions)
    return f"Regions where a rival is faster (error {GOAL:g}, one core). {told}" if told else ""


class _Compared(NamedTuple):
    """Regions grouped by the fastest method, each with its fastest rival."""

    won: list[str]
    level: list[str]
    lost: list[str]
    alone: list[str]
    nobody: list[str]


def _compared(precision: Precision) -> _Compared:
    won, level, lost, alone, nobody = found = _Compared([], [], [], [], [])
    for region in precision.regions:
        own, rival = precision.fastest(region, True), precision.fastest(region, False)
        if own is None and rival is None:
            nobody.append(region)
        elif rival is None:
            alone.append(region)
        elif own is None:
            lost.append(f"{region} ({rival.method} alone reaches it)")
        else:
            ratio = rival.seconds_per_point / own.seconds_per_point
            if is_level(ratio):
                level.append(f"{region} ({rival.method})")
            elif ratio > 1:
                won.append(f"{region} ({times(ratio)} times as fast as {rival.method})")
            else:
                lost.append(f"{region} ({rival.method} is {times(1 / ratio)} times as fast)")
    return found


def _winners(precision: Precision) -> str:
    won, level, lost, alone, nobody = _compared(precision)
    parts = [
        ("The package is fastest in", won),
        ("Only the package reaches this error in", alone),
        (f"The package equals a rival within {LEVEL - 1:.0%} in", level),
        ("The package is **slower** in", lost),
        ("No method reaches this error in", nobody),
    ]
    told = " ".join(f"{words}: {'; '.join(regions)}." for words, regions in parts if regions)
    return f"Regions of `{precision.system}` (error {GOAL:g}, one core). {told}"


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
    return [first, f"Rivals that fail silently (regions): {'; '.join(rivals)}."] if rivals else [first]


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
