"""Common parts of the benchmarks: cells of the chart, spawned workers, interleaved timing, files with provenance."""

from __future__ import annotations

import argparse
import csv
import datetime
import io
import os
import platform
import resource
import statistics
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache, wraps
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from tests.oracles.cardan_reference import BASE_CASE

RESULTS = Path(__file__).resolve().parent / "results"
PROCESSES = 2
_PACKAGES = ("numpy", "scipy", "jax", "diffrax", "heyoka", "drivetrain_jax")


def parser(doc: str) -> argparse.ArgumentParser:
    """The parser with the options of every study, ``--quick`` and ``--out FOLDER``."""
    options = argparse.ArgumentParser(description=doc.splitlines()[0])
    options.add_argument(
        "--quick", action="store_true", help="a small form; its files go to --out or a temporary folder"
    )
    options.add_argument(
        "--out", type=Path, metavar="FOLDER", help="where the files go (benchmarks/results, if not --quick)"
    )
    return options


def results_folder(options: argparse.Namespace) -> Path:
    """The folder for the files of a study; a quick run replaces those of a full run only with ``--out``."""
    if options.out is None and not options.quick:
        return RESULTS
    folder = (options.out or Path(tempfile.mkdtemp(prefix="benchmarks-"))).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"results in {folder}")
    return folder


# Range of the chart that all methods compute.
CHART_RANGE = {"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}


def chart(cells: int) -> dict[str, np.ndarray]:
    """Columns of about ``cells`` cells of the chart over ``CHART_RANGE``, base case, of shape 3:4."""
    rows = max(2, round((cells * 3 / 4) ** 0.5))
    sizes = (rows, max(2, round(cells / rows)))
    beta, omega = (np.linspace(*ends, size) for ends, size in zip(CHART_RANGE.values(), sizes, strict=True))
    grid = np.meshgrid(beta, omega, indexing="ij")
    fixed = {name: np.full(grid[0].size, value) for name, value in BASE_CASE.items()}
    return {"beta": grid[0].ravel(), "Omega": grid[1].ravel(), **fixed}


def take(columns: Mapping[str, np.ndarray], index: Any) -> dict[str, np.ndarray]:
    """The same columns at ``index``."""
    return {name: column[index] for name, column in columns.items()}


def spawned_workers(
    initializer: Callable[..., None] | None = None, arguments: Sequence[Any] = ()
) -> ProcessPoolExecutor:
    """``PROCESSES`` spawned processes, each prepared once (a fork after jax has started its threads can hang)."""
    return ProcessPoolExecutor(
        PROCESSES, mp_context=get_context("spawn"), initializer=initializer, initargs=tuple(arguments)
    )


def at_once(makers: Sequence[Callable[[], Any]]) -> list[Any]:
    """The results of ``makers``, of which ``PROCESSES`` run at a time in threads.

    They mostly compile, which releases the interpreter lock.
    """
    with ThreadPoolExecutor(PROCESSES) as pool:
        return list(pool.map(lambda make: make(), makers))


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """``functools.cache`` for several threads: the second of two equal calls waits instead of computing again."""
    kept, locks = cache(function), defaultdict[Any, Lock](Lock)

    @wraps(function)
    def asked(*arguments: Any) -> Any:
        with locks[arguments]:
            return kept(*arguments)

    return asked


def interleaved(jobs: Mapping[str, Callable[[], Any]], repeats: int | Mapping[str, int]) -> dict[str, list[float]]:
    """Seconds of ``repeats`` runs of every job, taken in turns, so that the load of the machine affects all alike.

    ``repeats`` may be a mapping by name.
    """
    counts = dict.fromkeys(jobs, repeats) if isinstance(repeats, int) else repeats
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(max(counts.values(), default=0)):
        for name in (name for name in jobs if turn < counts[name]):
            start = time.perf_counter()
            jobs[name]()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def median(values: Sequence[float]) -> float:
    """The median, which one disturbed repeat does not change much."""
    return statistics.median(values)


def significant(value: Any, digits: int = 3) -> Any:
    """A float as text with ``digits`` significant digits; anything else unchanged."""
    return f"{value:.{digits}g}" if isinstance(value, float) else value


def provenance() -> dict[str, str]:
    """Date, commit, processor, load by other programs and versions, for the head of every result file."""
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": _commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores",
        "load": _other_load(),
        "accelerator": "none" if not list(Path("/dev").glob("nvidia[0-9]*")) else "NVIDIA GPU",
        "versions": ", ".join([f"python {platform.python_version()}", *(f"{p} {_version(p)}" for p in _PACKAGES)]),
    }


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], notes: Sequence[str] = ()) -> None:
    """Write ``rows`` as CSV under commented lines of provenance and ``notes`` (pandas: ``read_csv(comment="#")``)."""
    text = io.StringIO()
    for key, value in provenance().items():
        text.write(f"# {key}: {value}\n")
    for note in notes:
        text.write(f"# {note}\n")
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: significant(value) for key, value in row.items()} for row in rows)
    path.parent.mkdir(exist_ok=True)
    # Renamed at the end: an interrupted study leaves the old file unchanged.
    written = path.with_suffix(".csv.part")
    written.write_text(text.getvalue())
    os.replace(written, path)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """``rows`` as aligned text."""
    cells = [list(rows[0]), *([str(significant(value)) for value in row.values()] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in cells
    )


def _commit() -> str:
    """The commit of the code that runs, with a remark if its files differ from it."""
    here = Path(__file__).parent
    try:
        commit, changes = (
            subprocess.run(["git", *words], cwd=here, check=True, capture_output=True, text=True).stdout.strip()
            for words in (
                ["rev-parse", "--short", "HEAD"],
                ["status", "--porcelain", "--", "../drivetrain_jax", "*.py"],
            )
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit} with changes" if changes else commit


def _busy_seconds() -> float:
    """CPU seconds of all programs of the machine that are not of this process and its ended children."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    user, nice, system, _, _, irq, softirq, steal = (int(field) for field in fields[:8])
    own = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK") - sum(
        usage.ru_utime + usage.ru_stime for usage in own
    )


def _other_load() -> str:
    """Mean number of cores that other programs used since the start of the study."""
    try:
        spent = _busy_seconds() - _BUSY_AT_START
    except OSError:
        return "unknown"
    return f"{max(spent, 0.0) / (time.monotonic() - _START):.2f} cores by other programs"


try:
    _START, _BUSY_AT_START = time.monotonic(), _busy_seconds()
except OSError:
    _START, _BUSY_AT_START = time.monotonic(), 0.0


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(source tree)"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    flags = {key.strip(): value for key, value in fields.items()}
    simd = (
        "AVX-512" if "avx512f" in flags.get("flags", "") else "AVX2" if "avx2" in flags.get("flags", "") else "no AVX2"
    )
    return f"{flags.get('model name', platform.machine()).strip()} ({simd})"
