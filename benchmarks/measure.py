"""Measure contenders: compile and compare each one, then time all in turns; files of results with their provenance."""

from __future__ import annotations

import argparse
import csv
import datetime
import io
import math
import os
import platform
import re
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from drivetrain_jax._machine import instruction_set, machine

RESULTS = Path(__file__).resolve().parent / "results"
CORES = 2
# Runs of a contender, and seconds after which no further run starts.
REPEATS, SPENT = 9, 0.3
# Largest error in tolerances that is no failure: the global error is commonly ten to some hundred tolerances of a step.
PATIENCE = 1e3
# Largest error that needs no notice, whatever the tolerance.
USELESS = 0.1
# Error at which methods are compared.
GOAL = 1e-9
_PACKAGES = ("numpy", "scipy", "jax", "diffrax", "heyoka", "drivetrain_jax")
Columns = Mapping[str, np.ndarray]
Job = Callable[[], Any]
# A line of a Markdown table: its cells, or its text with `` | `` between them.
Line = str | Sequence[str]


class Judged(NamedTuple):
    """Largest relative error of the points with a result, number of failed points, and the notice to the user."""

    error: float
    failed: int = 0
    noticed: str = ""


def judged(error: float, notice: str = "") -> Judged:
    """The verdict on one point; an error that is not finite counts as a failure."""
    return Judged(float(error), 0, notice) if math.isfinite(error) else Judged(math.nan, 1, notice or "nan")


class Rung(NamedTuple):
    """One method at one setting in one region: a line of the CSV.

    ``error`` is the largest relative error of the points with a result. ``noticed`` is the way in which a user learns of a
    failure: the name of an outcome, a warning, an exception. ``timed`` is the number of runs of the median.
    """

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


class Contender(NamedTuple):
    """A method at a setting: ``prepare`` compiles and returns the job, ``error_of`` compares its result."""

    system: str
    region: str
    method: str
    setting: str
    points: int
    prepare: Callable[[], Job]
    error_of: Callable[[Any], Judged]


@dataclass(frozen=True)
class Method:
    """A line of a table of contenders.

    ``prepare(region, setting)`` returns a job, ``error(region, setting, result)`` judges its result. ``label`` formats a
    setting, ``settings`` are those of a full run, ``quick`` those of a quick one. ``points`` is the number of points of a
    job, or a function of the region; ``regions`` are those of the method (default: all).
    """

    name: str
    prepare: Callable[[str, Any], Job]
    points: int | Callable[[str], int]
    settings: Sequence[Any] = ("",)
    quick: Sequence[Any] = ()
    label: str = "rtol={:g}"
    error: Callable[[str, Any, Any], Judged] | None = None
    regions: Sequence[str] = ()


@dataclass(frozen=True)
class Study:
    """All methods of a system in all of its regions; ``error(region, setting, result)`` judges those without a judge."""

    system: str
    regions: Sequence[str]
    quick: Sequence[str]
    methods: Sequence[Method]
    error: Callable[[str, Any, Any], Judged]
    notes: Callable[[Sequence[str]], Sequence[str]] = lambda regions: ()

    def contenders(self, quick: bool) -> list[Contender]:
        """All contenders, region by region."""
        return [
            Contender(
                self.system, region, method.name, method.label.format(setting),
                method.points if isinstance(method.points, int) else method.points(region),
                partial(method.prepare, region, setting), partial(method.error or self.error, region, setting),
            )
            for region in (self.quick if quick else self.regions)
            for method in self.methods
            if region in (method.regions or self.regions)
            for setting in (method.quick if quick else method.settings)
        ]  # fmt: skip

    def run(self, quick: bool, folder: Path) -> None:
        """Measure and write ``precision_<system>.csv``, unless there is nothing to measure."""
        if not (contenders := self.contenders(quick)):
            print(f"{self.system}: left out, it is not in a quick run or needs heyoka")
            return
        repeats, spent = (3, SPENT / 4) if quick else (REPEATS, SPENT)
        about = f"medians of up to {repeats} runs in turns, as many as {spent:g} s allow ('timed'), without compilation"
        notes = [about, *self.notes(self.quick if quick else self.regions)]
        write_csv(
            folder / f"precision_{self.system}.csv",
            [rung._asdict() for rung in measure(contenders, repeats, spent)],
            notes,
        )


def measure(contenders: Sequence[Contender], repeats: int = REPEATS, spent: float = SPENT) -> list[Rung]:
    """One rung per contender: all are compiled and compared first, then timed in turns; times are medians."""
    prepared = list(map(_prepared, contenders))
    jobs, rungs = {}, []
    for number, (c, (job, compile_s)) in enumerate(zip(contenders, prepared, strict=True)):
        verdict, seconds, ran = _first(c, job)
        if ran and seconds <= spent:
            jobs[number] = job
        failed, noticed = int(verdict.failed), verdict.noticed
        rungs.append(Rung(*c[:4], verdict.error, seconds / c.points, compile_s, c.points, failed, noticed))
        what = f"{c.region}: {c.method}, {c.setting}"
        sys.stderr.write(f"{number + 1}/{len(contenders)} {what}: {verdict.error:.1e}, {seconds:.2g} s\n")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one_run = {number: rungs[number].seconds_per_point * rungs[number].points for number in jobs}
        times = interleaved(jobs, {number: min(repeats, int(spent / one_run[number])) for number in jobs})
    for number, runs in times.items():
        rungs[number] = rungs[number]._replace(seconds_per_point=median(runs) / rungs[number].points, timed=len(runs))
    return rungs


def _prepared(contender: Contender) -> tuple[Job | Exception, float]:
    start = time.perf_counter()
    try:
        return contender.prepare(), time.perf_counter() - start
    except Exception as error:
        return error, 0.0


def _first(contender: Contender, job: Job | Exception) -> tuple[Judged, float, bool]:
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
        return Judged(math.nan, contender.points, type(error).__name__), time.perf_counter() - start, False
    verdict = contender.error_of(result)
    warned = sorted({w.category.__name__ for w in caught if not issubclass(w.category, DeprecationWarning)})
    return verdict._replace(noticed=verdict.noticed or ", ".join(warned)), seconds, True


def is_silent(setting: str, error: float, failed: int, noticed: str) -> bool:
    """True if a rung lacks points or is wrong by more than it may be, and the user gets no notice.

    One rule for all methods: the error may be ``USELESS``, and ``PATIENCE`` times the tolerance if one is asked for.
    """
    asked = re.search(r"tol(?:erance)?=([0-9.e+-]+)", setting)
    allowed = min(PATIENCE * float(asked[1]), USELESS) if asked else USELESS
    return not noticed and (failed > 0 or not error <= allowed)


def interleaved(jobs: Mapping[Any, Job], runs: Mapping[Any, int]) -> dict[Any, list[float]]:
    """Seconds of every run of every job, taken in turns, so that the load of the machine affects all alike."""
    seconds: dict[Any, list[float]] = {name: [] for name in jobs}
    for turn in range(max(runs.values(), default=0)):
        for name in (name for name in jobs if turn < runs[name]):
            start = time.perf_counter()
            jobs[name]()
            seconds[name].append(time.perf_counter() - start)
    return seconds


@cache
def pool() -> ProcessPoolExecutor:
    """One spawned process per core (a fork after jax has started its threads can hang)."""
    return ProcessPoolExecutor(CORES, mp_context=get_context("spawn"))


def shared_out(function: Callable[[Columns], np.ndarray], columns: Columns, tasks: int = 4 * CORES) -> Job:
    """A job that distributes points over the processes of ``pool`` in turn; results in order."""
    size = len(next(iter(columns.values())))
    deals = [np.arange(start, size, tasks) for start in range(min(tasks, size))]
    hands = [take(columns, deal) for deal in deals]

    def job() -> np.ndarray:
        parts = list(pool().map(function, hands))
        out = np.empty((size, *parts[0].shape[1:]))
        for deal, part in zip(deals, parts, strict=True):
            out[deal] = part
        return out

    job()  # starts the processes, which compile
    return job


def take(columns: Columns, index: Any) -> dict[str, np.ndarray]:
    """The same columns at ``index``."""
    return {name: column[index] for name, column in columns.items()}


def near(
    values: Mapping[str, float], names: Sequence[str], count: int, width: float, seed: int = 0
) -> dict[str, np.ndarray]:
    """Columns of ``count`` points: ``values`` first, then points whose ``names`` differ by up to the part ``width``.

    Fewer points are the first ones of more.
    """
    columns = {name: np.full(count, value) for name, value in values.items()}
    for number, name in enumerate(names):
        rng = np.random.default_rng((seed, number))
        columns[name] = columns[name] * np.r_[1.0, rng.uniform(1 - width, 1 + width, count - 1)]
    return columns


def columns_scene(system: str, analysis: str, outputs: Sequence[str], columns: Columns, **rest: Any) -> dict[str, Any]:
    """A scene of listed points; ``rest``: ``fixed``, ``options``."""
    points = {name: np.asarray(column).tolist() for name, column in columns.items()}
    return {"system": system, "analysis": analysis, "outputs": list(outputs), "points": points, **rest}


def engine_job(scene: Mapping[str, Any], threads: int = 1) -> Job:
    """A function that computes every point of ``scene`` as ``dt.run`` does, with ``threads``; results by name, points first.

    This call compiles the kernels, unless another scene of the process shares them.
    """
    from drivetrain_jax.runs.kernel import kernel_of
    from drivetrain_jax.runs.resolve import resolve
    from drivetrain_jax.runs.scene import load_scene
    from drivetrain_jax.runs.work import run_threads

    engine = resolve(load_scene(dict(scene)))
    grid = engine.grid
    chunks = [chunk for block in engine.blocks() for chunk in engine.plan(block)]
    kinds = {(chunk.solver, chunk.size) for chunk in chunks}
    kernels = {(index, size): kernel_of(engine.scene, grid, engine.solvers[index], size) for index, size in kinds}

    def work(chunk: Any) -> Mapping[str, np.ndarray]:
        return kernels[chunk.solver, chunk.size](grid.columns(chunk.points), grid.numbers, chunk.effort)

    def job() -> dict[str, np.ndarray]:
        results: dict[str, np.ndarray] = {}
        for chunk, values in run_threads(chunks, work, threads):
            for name, array in values.items():
                if name not in results:
                    blank = np.nan if array.dtype.kind in "fc" else 0
                    results[name] = np.full((grid.size, *array.shape[1:]), blank, array.dtype)
                results[name][chunk.points] = array
        return results

    return job


def points_job(
    system: str, analysis: str, outputs: Sequence[str], columns: Columns, threads: int = 1, **rest: Any
) -> Job:
    """:func:`engine_job` of listed points."""
    return engine_job(columns_scene(system, analysis, outputs, columns, **rest), threads)


def outcomes(outcome: np.ndarray) -> str:
    """The names of the outcomes other than success, by which the package reports failures."""
    from drivetrain_jax.analysis import Outcome

    return ", ".join(Outcome(code).name.lower() for code in np.unique(outcome) if code)


def parser(doc: str) -> argparse.ArgumentParser:
    """The parser with the options of every study, ``--quick`` and ``--out FOLDER``."""
    options = argparse.ArgumentParser(description=doc.splitlines()[0])
    options.add_argument("--quick", action="store_true", help="a small form, into --out or a temporary folder")
    options.add_argument("--out", type=Path, metavar="FOLDER", help="of the files (benchmarks/results, if not --quick)")
    return options


def results_folder(options: argparse.Namespace) -> Path:
    """The folder for the files of a study; a quick run replaces those of a full run only with ``--out``."""
    if options.out is None and not options.quick:
        return RESULTS
    folder = (options.out or Path(tempfile.mkdtemp(prefix="benchmarks-"))).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"results in {folder}")
    return folder


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], notes: Sequence[str] = ()) -> None:
    """Write and print ``rows`` as CSV under commented lines of provenance and ``notes``; floats with three digits."""
    text = io.StringIO()
    for line in [*(f"{key}: {value}" for key, value in provenance().items()), *notes]:
        text.write(f"# {line}\n")
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    print(text.getvalue())
    path.parent.mkdir(exist_ok=True)
    # Renamed at the end: an interrupted study leaves the old file unchanged.
    written = path.with_suffix(".csv.part")
    written.write_text(text.getvalue())
    os.replace(written, path)


def markdown(head: Line, rows: Sequence[Line]) -> str:
    """A Markdown table."""
    lines = [line if isinstance(line, str) else " | ".join(line) for line in (head, *rows)]
    lines.insert(1, " | ".join(["---"] * len(lines[0].split(" | "))))
    return "\n".join(f"| {line} |" for line in lines)


class Results(NamedTuple):
    """A result file: its rows as a DataFrame, the provenance and the notes of its head."""

    rows: Any
    facts: Mapping[str, str]
    notes: Sequence[str]


def load(folder: Path, name: str) -> Results | None:
    """``<folder>/<name>.csv``, or None if it has not been measured."""
    import pandas as pd

    path = folder / f"{name}.csv"
    if not path.is_file():
        return None
    head = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    known = ("date", "commit", "machine", "load", "versions", "accelerator")
    pairs = [line.partition(": ") for line in head]
    facts = {key: value for key, _, value in pairs if key in known}
    notes = [line for line, (key, _, _) in zip(head, pairs, strict=True) if key not in known]
    return Results(pd.read_csv(path, comment="#", keep_default_na=False, na_values={"error": "nan"}), facts, notes)


def provenance() -> dict[str, str]:
    """Date, commit, processor, load by other programs and versions, for the head of every result file."""
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": _commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores",
        "load": f"{max(_busy() - _BUSY, 0.0) / (time.monotonic() - _START):.2f} cores by other programs",
        "accelerator": "none" if not list(Path("/dev").glob("nvidia[0-9]*")) else "NVIDIA GPU",
        "versions": ", ".join([f"python {platform.python_version()}", *(f"{p} {_version(p)}" for p in _PACKAGES)]),
    }


def _commit() -> str:
    """The commit of the code that runs, with a remark if its files differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=RESULTS.parent, check=True, capture_output=True, text=True
        ).stdout.strip()

    try:
        changed = " with changes" * bool(git("status", "--porcelain", "--", "../drivetrain_jax", "*.py"))
        return git("rev-parse", "--short", "HEAD") + changed
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _busy() -> float:
    """CPU seconds of all programs of the machine that are not of this process and its ended children (Linux; else 0)."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]
    except OSError:
        return 0.0
    user, nice, system, _, _, irq, softirq, steal = map(int, fields)
    ours = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    spent = sum(usage.ru_utime + usage.ru_stime for usage in ours)
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK") - spent


_START, _BUSY = time.monotonic(), _busy()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(source tree)"


def _processor() -> str:
    flags = instruction_set()
    simd = "AVX-512" if "avx512f" in flags else "AVX2" if "avx2" in flags else "no AVX2"
    return f"{machine().partition(',')[0]} ({simd})"
