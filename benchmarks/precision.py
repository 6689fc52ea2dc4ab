"""Error against run time of every method of a system, region by region, and its behaviour at the extremes.

A study (``benchmarks/precision_<system>.py``) lists contenders: one method at one setting on the points of one region.
``measure`` first prepares all of them (two compile at a time; compile time is separate) and compares their first results
with the study's reference. It then times them in turns, up to ``REPEATS`` times and as often as ``SPENT`` seconds allow, so
that a slow contender runs only once. The column ``timed`` of the CSV is the number of runs of each median.

    python -m benchmarks.precision_cardan [--quick] [--out FOLDER]     # writes precision_cardan.csv and .png

``error`` is the largest relative error of the points with a result, NaN without any; ``failed`` counts points without a
usable result; ``noticed`` is the way in which a user learns of the failure: the name of an outcome, a warning, an
exception. A setting is silent if it is wrong without any notice by more than ``USELESS``, or by more than ``PATIENCE`` times
its tolerance.
"""

from __future__ import annotations

import csv
import math
import re
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.timing import RESULTS, at_once, interleaved, median, write_csv

REPEATS, SPENT = 9, 0.3
# Largest error in tolerances that is no failure: the global error is commonly ten to some hundred tolerances of a step.
PATIENCE = 1e3
# Largest error that needs no notice, whatever was asked for.
USELESS = 0.1
GOAL = 1e-9


@dataclass(frozen=True)
class Rung:
    """One method at one setting in one region: a line of the CSV."""

    system: str
    region: str
    method: str
    setting: str
    error: float
    seconds_per_point: float
    compile_s: float
    points: int
    failed: int
    noticed: str
    timed: int = 1


class Judged(NamedTuple):
    """Largest relative error of the points with a result, number of failed points, and the notice to the user."""

    error: float
    failed: int = 0
    noticed: str = ""


@dataclass(frozen=True)
class Contender:
    """A method at a setting: ``prepare`` compiles and returns the job, ``error_of`` compares its result."""

    system: str
    region: str
    method: str
    setting: str
    points: int
    prepare: Callable[[], Callable[[], Any]]
    error_of: Callable[[Any], Judged]


@dataclass(frozen=True)
class _Trial:
    contender: Contender
    job: Callable[[], Any] | None
    compile_s: float
    seconds: float
    judged: Judged


def measure(contenders: Sequence[Contender], repeats: int = REPEATS, spent: float = SPENT) -> list[Rung]:
    """One rung per contender: all are compiled and compared first, then timed in turns; times are medians."""
    prepared = at_once([partial(_prepare, contender) for contender in contenders])
    trials = []
    for number, (contender, ready) in enumerate(zip(contenders, prepared, strict=True), 1):
        trial = _try(contender, *ready)
        trials.append(trial)
        what = f"{contender.region}: {contender.method}, {contender.setting}"
        sys.stderr.write(f"{number}/{len(contenders)} {what}: {trial.judged.error:.1e}, {trial.seconds:.2g} s\n")
    jobs = {str(i): t.job for i, t in enumerate(trials) if t.job is not None and t.seconds <= spent}
    counts = {name: min(repeats, int(spent / trials[int(name)].seconds)) for name in jobs}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seconds = interleaved(jobs, counts)
    return [_rung(trial, seconds.get(str(i), [trial.seconds])) for i, trial in enumerate(trials)]


def _prepare(contender: Contender) -> tuple[Callable[[], Any] | Exception, float]:
    start = time.perf_counter()
    try:
        return contender.prepare(), time.perf_counter() - start
    except Exception as error:
        return error, time.perf_counter() - start


def _try(contender: Contender, job: Callable[[], Any] | Exception, compile_s: float) -> _Trial:
    # Exceptions and warnings are data, because they notify the user of the method.
    start = time.perf_counter()
    try:
        if isinstance(job, Exception):
            raise job
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            start = time.perf_counter()
            result = job()
            seconds = time.perf_counter() - start
    except Exception as error:
        told = Judged(math.nan, contender.points, type(error).__name__)
        return _Trial(contender, None, 0.0, time.perf_counter() - start, told)
    judged = contender.error_of(result)
    warned = sorted({w.category.__name__ for w in caught if not issubclass(w.category, DeprecationWarning)})
    if warned and not judged.noticed:
        judged = judged._replace(noticed=", ".join(warned))
    return _Trial(contender, job, compile_s, seconds, judged)


def _rung(trial: _Trial, seconds: Sequence[float]) -> Rung:
    c, judged = trial.contender, trial.judged
    per_point = median(seconds) / c.points
    error, failed, noticed = float(judged.error), int(judged.failed), judged.noticed
    return Rung(
        c.system,
        c.region,
        c.method,
        c.setting,
        error,
        per_point,
        trial.compile_s,
        c.points,
        failed,
        noticed,
        len(seconds),
    )


def tolerance(setting: str) -> float | None:
    """The tolerance of a setting such as ``rtol=1e-9``; None for a number of steps."""
    found = re.search(r"tol(?:erance)?=([0-9.e+-]+)", setting)
    return float(found[1]) if found else None


def is_silent(rung: Rung) -> bool:
    """True if ``rung`` lacks points or is wrong by more than it may be, and the user gets no notice.

    One rule for all methods: the error may be ``USELESS``, and ``PATIENCE`` times the tolerance if one is asked for.
    """
    asked = tolerance(rung.setting)
    allowed = USELESS if asked is None else min(PATIENCE * asked, USELESS)
    return not rung.noticed and (rung.failed > 0 or not rung.error <= allowed)


def write(name: str, rungs: Sequence[Rung], notes: Sequence[str] = (), folder: Path = RESULTS) -> None:
    """Write ``<folder>/<name>.csv`` with machine, versions, load and date in its head."""
    write_csv(folder / f"{name}.csv", [asdict(rung) for rung in rungs], notes)


def read(path: Path) -> list[Rung]:
    """The rungs of a CSV written by :func:`write`."""
    with path.open(newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        kinds = {field.name: {"float": float, "int": int}.get(str(field.type), str) for field in fields(Rung)}
        return [Rung(**{name: kinds[name](text) for name, text in row.items()}) for row in rows]
