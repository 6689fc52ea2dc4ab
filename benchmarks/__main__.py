"""Run every study of the benchmarks in a process of its own, one after the other, and write the page of their results.

    python -m benchmarks [--quick] [--out FOLDER] [--peers PYTHON] [SYSTEM ...]

A full run rewrites benchmarks/results/, docs/benchmarks.md and the measured part of README.md. With ``--quick``, or
another ``--out``, files and page go to that folder. A study whose peer is not installed is skipped with a message. A study
that fails does not stop the others. An interrupt leaves the files of unfinished studies, and the page, unchanged.
``drivetrain bench`` and ``make bench`` run this module.

``--quick`` runs the chart at equal error and the work-precision of every system, with fewer settings, regions and points.
It skips studies of rates alone and of sizes, unless a SYSTEM is given.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from benchmarks.page_text import write_page
from benchmarks.readme import write_readme
from benchmarks.timing import RESULTS, parser, results_folder
from drivetrain_jax._wording import nearest
from drivetrain_jax.cli.replies import WRONG_INPUT, one_line

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
# Exit code in a shell of a process that an interrupt ends.
INTERRUPTED = 130
SYSTEMS = ("cardan", "bicardan", "planetary", "rattle", "tripod")


@dataclass(frozen=True)
class Study:
    """A ``module`` of benchmarks/ about a ``system``.

    ``needs`` is a package that it requires, ``peer_option`` its option for an interpreter with the peers. ``full`` are its
    arguments in a full run, chosen so that all studies together take less than half an hour. ``quick`` is true if a quick
    run of all systems includes it.
    """

    module: str
    system: str
    needs: str = ""
    peer_option: str = ""
    full: tuple[str, ...] = ()
    quick: bool = True


STUDIES = (
    Study("throughput", "cardan", "heyoka", full=("--repeats", "3")),
    Study("precision_cardan", "cardan"),
    Study("precision_forced", "cardan", quick=False),
    Study("precision_gradients", "cardan", quick=False),
    Study("random_points", "cardan", quick=False),
    Study("work_precision", "cardan", quick=False),
    Study("atlas", "cardan", "heyoka", full=("--repeats", "1"), quick=False),
    Study("peers", "cardan", "heyoka", quick=False),
    Study("batches", "cardan", quick=False),
    Study("waiting", "cardan", quick=False),
    Study("precision_bicardan", "bicardan"),
    Study("critical_speeds", "bicardan", peer_option="--ross", quick=False),
    Study("precision_planetary", "planetary"),
    Study("planetary_throughput", "planetary", full=("--gears", "6000", "--repeats", "3"), quick=False),
    Study("precision_rattle", "rattle"),
    Study("precision_attractors", "rattle", quick=False),
    Study("rattle_throughput", "rattle", quick=False),
    Study("precision_tripod", "tripod"),
    Study("chaos", "tripod", "heyoka", peer_option="--pynamicalsys", quick=False),
)


def command(study: Study, quick: bool, folder: Path, peers: str | None) -> list[str]:
    """The command of one study."""
    words = [sys.executable, "-m", f"benchmarks.{study.module}", "--out", str(folder)]
    words += ["--quick"] if quick else study.full
    return words + ([study.peer_option, peers] if peers and study.peer_option else [])


def run(studies: Sequence[Study], quick: bool, folder: Path, peers: str | None) -> int:
    """Run ``studies``; returns the number of those that failed."""
    failed = 0
    begin = time.perf_counter()
    for number, study in enumerate(studies, 1):
        clock = f"[{number}/{len(studies)}, {time.perf_counter() - begin:.0f} s]"
        if study.needs and find_spec(study.needs) is None:
            print(f"{clock} {study.module}: left out, {study.needs} is not installed", flush=True)
            continue
        if study.peer_option and not peers:
            print(f"{clock} {study.module}: without the peer that --peers PYTHON would give", flush=True)
        print(f"{clock} {study.module}", flush=True)
        code = subprocess.run(command(study, quick, folder, peers), cwd=ROOT, check=False).returncode
        if code:
            failed += 1
            print(f"{clock} {study.module}: FAILED with exit code {code}; its files are as they were", flush=True)
    print(f"{len(studies)} studies in {time.perf_counter() - begin:.0f} s, {failed} failed", flush=True)
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studies of the given systems, then write the page."""
    known = parser(__doc__)
    known.add_argument("systems", nargs="*", metavar="SYSTEM", help=", ".join(SYSTEMS))
    known.add_argument("--peers", metavar="PYTHON", help="interpreter of an environment with ROSS and pynamicalsys")
    options = known.parse_args(arguments)
    if unknown := set(options.systems) - set(SYSTEMS):
        sys.stderr.write(one_line(f"SYSTEM = {min(unknown)!r}: unknown{nearest(min(unknown), SYSTEMS)}"))
        return WRONG_INPUT
    folder = results_folder(options)
    chosen = [study for study in STUDIES if not options.systems or study.system in options.systems]
    if options.quick and not options.systems:
        print(f"--quick leaves out {', '.join(study.module for study in chosen if not study.quick)}", flush=True)
        chosen = [study for study in chosen if study.quick]
    try:
        failed = run(chosen, options.quick, folder, options.peers)
    except KeyboardInterrupt:
        sys.stderr.write(
            "interrupted: the files of the studies that ended are new, all others and the page as they were\n"
        )
        return INTERRUPTED
    page = PAGE if folder == RESULTS else folder / "benchmarks.md"
    write_page(folder, page)
    if folder == RESULTS:
        write_readme()
    print(f"page: {page}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
