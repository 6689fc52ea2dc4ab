"""The attacks that run in forks, in one process for each core: crashes at system calls, and damaged files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
# Results with changed bytes, results that were tampered with and sealed again, and scenes.
FILES = {"bytes": 5000, "sealed": 2000, "scene": 3000}
TITLES = {"bytes": "changed bytes", "sealed": "tampered with and sealed", "scene": "scenes"}
# Most memory of a process, in GB.
MEMORY = 2.0
# Compilation without optimisation: nearly all time goes into starting.
QUICK = {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
Record = dict[str, Any]


def library(folder: Path) -> Path:
    """The library of ``calls.c``."""
    made = folder / "calls.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", made, HERE / "calls.c", "-ldl"], check=True)
    return made


def records(words: Sequence[object], **environment: str) -> list[Record]:
    """The records that a program of this folder prints."""
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=os.environ | QUICK | environment)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    if done.returncode:
        found.append({"kind": "", "problem": f"{words[0]} ended with {done.returncode}", "lost": 0, "wrong": 0})
    return found


def crashes(folder: Path, seed: int, every: int = 1, shares: int = 2, kinds: Sequence[str] = ()) -> list[Record]:
    """Records of crashes at one of ``every`` system calls."""
    preload = str(library(folder))

    def share(k: int) -> list[Record]:
        return records([HERE / "crashes.py", folder / f"c{k}", seed, k, shares, every, *kinds], LD_PRELOAD=preload)

    with ThreadPoolExecutor(shares) as pool:
        return [record for found in pool.map(share, range(shares)) for record in found]


def files(folder: Path, seed: int, counts: dict[str, int] = FILES, shares: int = 2) -> list[Record]:
    """Records of damaged files and of scenes."""
    each = [-(-counts[kind] // shares) for kind in FILES]

    def share(k: int) -> list[Record]:
        return records([HERE / "mutations.py", folder / f"m{k}" / "work", seed + k, *each])

    with ThreadPoolExecutor(shares) as pool:
        return [record for found in pool.map(share, range(shares)) for record in found]


def bad(found: Sequence[Record]) -> list[Record]:
    """Records with a problem."""
    return [r for r in found if r.get("problem") or r.get("wrong") or r.get("lost") or r.get("memory", 0) > MEMORY]


def crash_table(found: Sequence[Record]) -> list[str]:
    """One row for each command."""
    faults = list(dict.fromkeys(record["fault"] for record in found if record["kind"]))
    lines = [
        f"| command | system calls | {' | '.join(faults)} | killed twice | exit codes | lost | wrong | other problems |",
        "| --- " * (7 + len(faults)) + "|",
    ]
    for kind in [*dict.fromkeys(record["kind"] for record in found if record["kind"]), "**all**"]:
        group = [record for record in found if kind in (record["kind"], "**all**")]
        seen = Counter(record.get("fault") for record in group)
        calls = "" if kind == "**all**" else max(record["calls"] for record in group)
        codes = " ".join(str(code) for code in sorted({record["code"] for record in group if "code" in record}))
        sums = [sum(r.get(name, 0) for r in group) for name in ("twice", "lost", "wrong")]
        cells = [kind, calls, *(seen[name] for name in faults), sums[0], codes, *sums[1:]]
        lines.append(f"| {' | '.join(map(str, [*cells, sum(bool(r['problem']) for r in group)]))} |")
    return [*lines, "", most_memory(found)]


def file_table(found: Sequence[Record]) -> list[str]:
    """One row for each kind of file."""
    lines = ["| files | number | commands and their exit codes | wrong | other problems |", "| --- " * 5 + "|"]
    for kind, title in TITLES.items():
        group = [record for record in found if record["kind"] == kind]
        codes = Counter(code for record in group for code in record["codes"])
        text = ", ".join(f"{count} times {code}" for code, count in sorted(codes.items()))
        wrong, problems = sum(r["wrong"] for r in group), sum(bool(r["problem"]) for r in group)
        lines.append(f"| {title} | {len(group)} | {text} | {wrong} | {problems} |")
    return [*lines, "", most_memory(found)]


def most_memory(found: Sequence[Record]) -> str:
    """The largest resident memory of the processes."""
    return f"Most memory of a process: {max((record.get('memory', 0.0) for record in found), default=0.0):.2f} GB."


def numbers(found: Sequence[Record]) -> str:
    """Numbers of injections by kind, and of those with a problem."""
    counts = Counter("crashes at system calls" if "fault" in r else TITLES.get(r["kind"], "") for r in found)
    named = ", ".join(f"{count} {name}" for name, count in counts.items() if name)
    return f"{named}; {len(bad(found))} with a problem"
