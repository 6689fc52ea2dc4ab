"""The regions of docs/benchmarks.md: the fastest methods at an error of 1e-9, and silent failures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.precision import GOAL, Rung, is_silent, read
from benchmarks.results_files import LEVEL, markdown, not_measured, seconds, small, times

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


def is_own(method: str) -> bool:
    """True if the method belongs to the package."""
    return method.split(",")[0] == OWN


def load_precision(folder: Path) -> dict[str, Precision]:
    """All systems that have been measured."""
    paths = {system: folder / f"precision_{system}.csv" for system in TITLES}
    return {system: Precision(system, read(path)) for system, path in paths.items() if path.is_file()}


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


def silent(systems: Iterable[Precision]) -> dict[str, list[str]]:
    """Systems and regions in which a method fails silently, by method."""
    found: dict[str, list[str]] = {}
    for precision in systems:
        for region in precision.regions:
            for method in precision.methods:
                if any(map(is_silent, precision.ladder(region, method))):
                    found.setdefault(method, []).append(f"{precision.system} {region}")
    return found


def silence(found: dict[str, Precision]) -> str:
    """The methods that fail silently, the package's first, with the number of their regions."""
    if not found:
        return not_measured("precision_cardan")
    regions = {method: len(places) for method, places in silent(found.values()).items()}
    own = {method: places for method, places in silent(found.values()).items() if is_own(method)}
    told = [f"{method} ({', '.join(places)})" for method, places in own.items()]
    head = f"**The package fails silently**: {'; '.join(told)}." if told else "No method of the package fails silently."
    rivals = [f"{method} ({number})" for method, number in regions.items() if method not in own]
    return f"{head} Rivals, with the number of their regions: {', '.join(rivals) or 'none'}."


def regions(found: dict[str, Precision], images: str) -> str:
    """The fastest setting of the package and of the rivals in every region, and a link to all settings."""
    rows = []
    for system, precision in found.items():
        for one in compared(precision):
            own, rival = (precision.fastest(one.region, mine) for mine in (True, False))
            ratio = "" if own is None or rival is None else times(one.ratio)
            rows.append([system, one.region, _told(own), _told(rival), ratio])
    missing = [not_measured(f"precision_{system}") for system in TITLES if system not in found]
    links = ", ".join(f"[{TITLES[system]}]({images}precision_{system}.png)" for system in found)
    text = "Time per point of the fastest method, and its error. The error of every setting: "
    table = [f"{text}{links}.", markdown(["system", "region", "package", "fastest rival", "ratio"], rows)]
    return "\n\n".join([*(table if found else []), *missing])


def _told(rung: Rung | None) -> str:
    if rung is None:
        return "does not reach the error"
    return f"{rung.method.removeprefix(f'{OWN}, ')}: {seconds(rung.seconds_per_point)} ({small(rung.error)})"
