"""``make faults``: all injections, and the table of docs/reliability.md from what they found."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import attacks
from harness import Bench, Record
from kinds import KINDS
from page import PAGE, write

from drivetrain_jax._machine import machine
from drivetrain_jax.store.provenance import now

EACH = (
    "Killed and cut off before {calls} that changes a file or a folder, the others at a quarter of these: half a write, and "
    "errors that stay. Power cut: what was not flushed is lost. Then the same command runs again; a quarter of these are "
    "killed once more first. Wrong: differs in a bit from an undisturbed run. Other problems: tracebacks, hangs over "
    "60 s, exit codes that are not documented, more than two lines, a folder that stays."
)
# The calls that are attacked, for values of ``--every``.
CALLS = {1: "every call", 2: "every second call"}
FILES = (
    "Results with one to eight changed bytes or cut off; results with objects, types, shapes and attributes changed, and "
    "checksums that fit; random scenes. Three commands read each result. Wrong: read without an error, with other values. "
    "Problems: tracebacks, crashes, more than 30 s of computation, more than two lines."
)


def main() -> int:
    """Run the suite; the exit code is 1 if anything was lost or wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=250_000, help="size of the chart")
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(3), "big"), help="default: drawn anew")
    parser.add_argument("--every", type=int, default=1, help="one of so many system calls is attacked")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument(
        "--only", nargs="*", default=[], help="kinds with this in their name; the page stays as it is then"
    )
    options = parser.parse_args()
    # File systems that are mounted come down also when the suite is stopped.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    begin = time.monotonic()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="faults-"))
        bench = stack.enter_context(Bench(Path(folder), options.points, options.seed))
        chosen = [k for k in KINDS if not options.only or any(part in k[0] for part in options.only)]
        # Every kind once, then those again that are to come more often.
        turns = [k for turn in range(max(k[2] for k in chosen)) for k in chosen if turn < k[2]]
        records = [inject(bench, kind, function) for kind, function, _, _ in turns]
        head = heading(bench, records, time.monotonic() - begin)
        lines, attacked = [head, "", *table(records)], list[attacks.Record]()
        for found, text in () if options.only else attack(Path(folder), options.seed, options.every):
            lines += ["", *text]
            attacked += found
            # What is known is kept if the suite is stopped.
            write("faults", "\n".join(lines), options.page)
    bad = [r for r in records if r.lost or r.wrong or r.orphans or r.problem]
    sys.stderr.write(f"{len(records)} injections, {len(bad)} with a problem\n")
    if attacked:
        sys.stderr.write(f"{attacks.numbers(attacked)}\n")
    return int(bool(bad) or bool(attacks.bad(attacked)))


def attack(folder: Path, seed: int, every: int) -> Iterator[tuple[list[attacks.Record], list[str]]]:
    """Yield the records of the attacks in forks, and their lines of the page."""
    begin = time.monotonic()
    crashed = attacks.crashes(folder, seed, every)
    text = EACH.format(calls=CALLS.get(every, f"one of {every} calls"))
    yield crashed, [_heading(crashed, begin, text), *attacks.crash_table(crashed)]
    begin = time.monotonic()
    damaged = attacks.files(folder, seed)
    yield damaged, [_heading(damaged, begin, FILES), *attacks.file_table(damaged)]


def _heading(found: list[attacks.Record], begin: float, text: str) -> str:
    """Numbers, minutes and meaning of the columns; problems are told on standard error."""
    for record in attacks.bad(found):
        sys.stderr.write(f"{json.dumps(record)}\n")
    return f"{attacks.numbers(found)}; {(time.monotonic() - begin) / 60:.0f} minutes, {now()[:10]}. {text}\n"


def inject(bench: Bench, kind: str, function) -> Record:
    """One injection, told on standard error."""
    record = function(bench, kind)
    text = f"{kind}: at {record.moment:.2f} s, exit {record.code}, reused {record.reused}, {record.problem or 'ok'}"
    sys.stderr.write(text + "\n")
    return record


def heading(bench: Bench, records: list[Record], seconds: float) -> str:
    """The machine, the seed and the meaning of the columns."""
    hits = sum(r.hit for r in records)
    total = bench.status(bench.reference).total
    return (
        f"{len(records)} injections, {hits} of them during the computation; chart of {total} points, "
        f"{bench.duration:.1f} s undisturbed; seed {bench.seed}; {seconds / 60:.0f} minutes on {machine()}, {now()[:10]}. "
        "Lost: finished points that were computed again. Wrong: variables that differ from an undisturbed run in a bit, a "
        "label or their encoding. Orphans: processes that still run."
    )


def table(records: list[Record]) -> list[str]:
    """One row for each kind, and the sum."""
    rows = defaultdict(list)
    for record in records:
        rows[record.kind].append(record)
    lines = [
        "| fault | injections | during computation | exit codes | points reused | lost | wrong | orphans | other problems |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    rows = {kind: rows[kind] for kind, *_ in KINDS if kind in rows}
    for kind, group in [*rows.items(), ("**all**", records)]:
        codes = " ".join(str(code) for code in sorted({r.code for r in group})) if kind != "**all**" else ""
        sums = [sum(getattr(r, name) for r in group) for name in ("hit", "reused", "lost", "wrong", "orphans")]
        problems = sum(bool(r.problem) for r in group)
        lines.append(
            f"| {kind} | {len(group)} | {sums[0]} | {codes} | {sums[1]} | {sums[2]} | {sums[3]} | {sums[4]} | {problems} |"
        )
    return lines


if __name__ == "__main__":
    sys.exit(main())
