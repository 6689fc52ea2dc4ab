"""Run studies, each in a process of its own, and write the page of their results.

    python -m benchmarks [--quick] [--out FOLDER] [SYSTEM ...]

A full run rewrites benchmarks/results/, docs/benchmarks.md and the measured part of README.md. With ``--quick`` (few
settings, regions and runs), or another ``--out``, files and page go to that folder. Without heyoka its comparisons are
left out. A study that fails does not stop the others. An interrupt leaves the files of unfinished studies, and the
page, unchanged.
``drivetrain bench`` and ``make bench`` run this module.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from benchmarks.measure import RESULTS, parser, results_folder
from benchmarks.page import PAGE, ROOT, write_page, write_pages
from drivetrain_jax._errors import nearest
from drivetrain_jax.cli import WRONG_INPUT, one_line

INTERRUPTED = 130
# Studies by system: module and name of a table of contenders, or a module with a ``main``.
STUDIES = {
    "cardan": ("cardan:STUDY", "cardan:AGAINST_DAMPING", "cardan:GRADIENTS", "cardan:FORCED", "chart:STUDY", "chart:ATLAS",
               "waiting"),
    "bicardan": ("bicardan:STUDY",),
    "driveline": ("driveline:STUDY",),
    "planetary": ("planetary:STUDY",),
    "rattle": ("rattle:STUDY", "rattle:ATTRACTORS"),
    "tripod": ("tripod:STUDY",),
}  # fmt: skip


def run(name: str, quick: bool, folder: Path) -> None:
    """Run one study in this process."""
    module, _, table = name.partition(":")
    study = import_module(f"benchmarks.{module}")
    if table:
        getattr(study, table).run(quick, folder)
    else:
        study.main(["--out", str(folder), *["--quick"] * quick])


def run_all(names: Sequence[str], quick: bool, folder: Path) -> int:
    """Run studies in processes of their own; returns the number of those that failed."""
    failed, begin = 0, time.perf_counter()
    for number, name in enumerate(names, 1):
        print(f"[{number}/{len(names)}, {time.perf_counter() - begin:.0f} s] {name}", flush=True)
        call = f"run({name!r}, {quick}, Path({str(folder)!r}))"
        code = f"from pathlib import Path; from benchmarks.__main__ import run; {call}"
        if code := subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode:
            failed += 1
            print(f"{name}: FAILED with exit code {code}; its files are unchanged", flush=True)
    print(f"{len(names)} studies in {time.perf_counter() - begin:.0f} s, {failed} failed", flush=True)
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the studies of the given systems, then write the page."""
    known = parser(__doc__)
    known.add_argument("systems", nargs="*", metavar="SYSTEM", help=", ".join(STUDIES))
    options = known.parse_args(arguments)
    if unknown := set(options.systems) - set(STUDIES):
        sys.stderr.write(one_line(f"SYSTEM = {min(unknown)!r}: unknown{nearest(min(unknown), STUDIES)}"))
        return WRONG_INPUT
    folder = results_folder(options)
    names = [name for system, tables in STUDIES.items() if system in (options.systems or STUDIES) for name in tables]
    try:
        failed = run_all(names, options.quick, folder)
    except KeyboardInterrupt:
        sys.stderr.write(
            "interrupted: the files of the studies that ended are new, all others and the page unchanged\n"
        )
        return INTERRUPTED
    if folder == RESULTS:
        write_pages()
    else:
        write_page(folder, folder / "benchmarks.md")
    print(f"page: {PAGE if folder == RESULTS else folder / 'benchmarks.md'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
