"""The section "Aims" of docs/benchmarks.md: what the program is to reach, what was measured, met or missed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from benchmarks.page_precision import Compared, Precision, compared
from benchmarks.results_files import LEVEL, ResultFile, at_equal_error, markdown, times

Files = Mapping[str, ResultFile | None]
# Regions of the cardan shaft in which one core is to be ahead of every rival.
_AHEAD = (
    "easy",
    "typical",
    "near boundary",
    "oscillatory, Omega 0.01",
    "nearly singular, beta 1.55",
    "ill-conditioned, gamma 1e16",
)
# Ratios to the best rival that are wanted: over heyoka on the chart, over NumPy with 3 to 5 planets.
_CHART, _GEARS = 1.8, 3.0


class Aim(NamedTuple):
    """An aim in words, the figure measured, and whether it is met."""

    aim: str
    measured: str
    met: bool


def section(files: Files, precise: Mapping[str, Precision]) -> str:
    """The table of all aims that the files can judge."""
    found = list(_aims(files, precise))
    if not found:
        return "Not measured."
    missed = sum(not one.met for one in found)
    rows = [[one.aim, one.measured, "met" if one.met else "**missed**"] for one in found]
    told = f"Ratios are speed over that of the fastest rival. {len(found) - missed} met, {missed} missed."
    return f"{told}\n\n{markdown(['aim', 'measured', ''], rows)}"


def _aims(files: Files, precise: Mapping[str, Precision]) -> Iterator[Aim]:
    yield from _chart(files["throughput"])
    cardan = {one.region: one for one in compared(precise["cardan"])} if "cardan" in precise else {}
    if known := [cardan[region] for region in _AHEAD if region in cardan]:
        ahead = [one for one in known if one.ratio > LEVEL]
        text = f"{len(ahead)} of {len(known)} ahead, ratios {_span(known)}"
        yield Aim("Cardan shaft, one core: ahead in six regions", text, len(ahead) == len(known))
    yield from _damping(files["damping"])
    tripod = compared(precise["tripod"]) if "tripod" in precise else []
    for words in ("stiff", "chaotic control"):
        yield from (
            _level(f"Double tripod, {words}: level", one.ratio) for one in tripod if one.region.startswith(words)
        )
    yield from _gears(files["planetary_throughput"])
    yield from _waiting(files["waiting"])
    if file := files["random_points"]:
        largest = max(float(row["over_bound"]) for row in file.rows if row["over_bound"] != "nan")
        yield Aim(
            "Random points: no error above its bound", f"largest error {times(largest)} of its bound", largest <= 1
        )


def _level(aim: str, ratio: float) -> Aim:
    return Aim(aim, times(ratio), ratio > 1 / LEVEL)


def _span(known: Iterable[Compared]) -> str:
    ratios = [one.ratio for one in known if math.isfinite(one.ratio)]
    if not ratios:
        return "none, as only one side reaches the error"
    return " to ".join(dict.fromkeys(times(end(ratios)) for end in (min, max)))


def _chart(file: ResultFile | None) -> Iterator[Aim]:
    best = at_equal_error(file) if file else {}
    if file is None or not {"drivetrain_jax direct", "heyoka batch"} <= best.keys():
        return
    own, rival = (float(best[name]["cells_per_s"]) for name in ("drivetrain_jax direct", "heyoka batch"))
    yield Aim(f"Chart: {_CHART:g} times heyoka batch at equal error", times(own / rival), own / rival >= _CHART)
    bare = next((float(row["cells_per_s"]) for row in file.rows if "without eigenvalues" in row["method"]), None)
    if bare is not None:
        yield _level("Chart: level with heyoka without eigenvalues", own / bare)


def _damping(file: ResultFile | None) -> Iterator[Aim]:
    for zeta in dict.fromkeys(row["zeta"] for row in file.rows) if file else ():
        pair = {row["method"].partition(",")[0]: float(row["us_per_point"]) for row in file.rows if row["zeta"] == zeta}
        if float(zeta) >= 10 and {"package", "heyoka batch"} <= pair.keys():
            yield _level(f"Damping, zeta = {float(zeta):g}: level with heyoka", pair["heyoka batch"] / pair["package"])


def _gears(file: ResultFile | None) -> Iterator[Aim]:
    ratios = []
    for planets in ("3", "4", "5"):
        rates = (
            {row["method"]: float(row["gears_per_s"]) for row in file.rows if row["planets"] == planets} if file else {}
        )
        rivals = [rate for method, rate in rates.items() if method.startswith("numpy")]
        if "package" in rates and rivals:
            ratios.append(rates["package"] / max(rivals))
    if ratios:
        text = ", ".join(times(ratio) for ratio in ratios)
        yield Aim(f"Planetary gears, 3 to 5 planets: {_GEARS:g} times NumPy's LAPACK", text, min(ratios) >= _GEARS)


def _waiting(file: ResultFile | None) -> Iterator[Aim]:
    for row in file.rows if file else ():
        for when, aim, spent in (("", "aim_s", "cpu_s"), (", first time", "first_aim_s", "first_cpu_s")):
            if row[aim]:
                wanted, took = float(row[aim]), float(row[spent])
                yield Aim(f"CPU time{when} ({row['command']}): {wanted:g} s", f"{took:.3g} s", took <= wanted)
