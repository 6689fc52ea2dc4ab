"""Verify a result or unfinished work: checksums, then rules."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.invariants import Finding, check
from drivetrain_jax.store import checksums, zarr_store
from drivetrain_jax.store.consolidate import open_result, read_attribute
from drivetrain_jax.store.parts import PartsFolder

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, repr=False)
class Report:
    """The ``lines`` of a report; ``problem`` is the first problem, empty without one.

    ``complete`` is false for unfinished work.
    """

    lines: tuple[str, ...]
    problem: str = ""
    complete: bool = True

    def __str__(self) -> str:
        return "\n".join(self.lines)

    # A notebook shows what `print` does.
    __repr__ = __str__

    def to_json(self) -> str:
        """The report and the state as one JSON object."""
        state = "damaged" if self.problem else "complete" if self.complete else "partial"
        return json.dumps({"state": state, "problem": self.problem, "checks": self.lines})


def verify(path: Path) -> Report:
    """The report on the result at ``path``, or on the blocks of an unfinished one.

    Raises :class:`InputError` if there is neither, or if the file cannot be read.
    """
    parts = PartsFolder(path)
    if not path.exists() and parts.holds_work():
        return _verify_parts(parts)
    if zarr_store.is_store(path):
        return _verify_store(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "not a regular file" if path.exists() else "does not exist"
        raise InputError(f"file = {str(path)!r}: {what}; give a result written by `drivetrain run`")
    return _verify_file(path)


def _verify_file(path: Path) -> Report:
    damaged = checksums.damaged(path)
    if damaged:
        names = checksums.named(damaged)
        problem = f"{names}: damaged; allowed is to restore the file or to compute it again"
        return Report((f"checksums: {len(damaged)} differ: {names}",), problem)
    if damaged is None and read_attribute(path, "digest") is not None:
        problem = "its checksums are gone; allowed is to restore the file or to compute it again"
        return Report(("checksums: gone",), problem)
    sealed = "none in this file" if damaged is None else "all agree"
    findings = check(open_result(path))
    lines = (f"checksums: {sealed}", *map(str, findings))
    return Report(lines, _first_broken(findings))


def verify_dataset(dataset: xr.Dataset, file: Path | None) -> Report:
    """The report on the numbers of ``dataset`` and on the checksums of ``file``, from which it was opened."""
    findings = check(dataset)
    changed = checksums.damaged(file) if file else None
    if changed:
        remedy = "allowed is to restore the file or to compute it again"
        problem = f"file = {str(file)!r}: {checksums.named(changed)}: damaged; {remedy}"
        return Report((f"checksums: {len(changed)} differ: {checksums.named(changed)}", *map(str, findings)), problem)
    sealed = "not of a file" if changed is None else f"all agree in {file}"
    return Report((f"checksums: {sealed}", *map(str, findings)), _first_broken(findings))


def _first_broken(findings: list[Finding]) -> str:
    return next((f"{finding}; allowed is none" for finding in findings if finding.broken), "")


def _verify_store(path: Path) -> Report:
    if not zarr_store.is_sealed(path):
        what = "attributes of the store"
        problem = f"{what}: damaged; allowed is to restore them or to compute the store again"
        return Report((f"checksums: {what} differ",), problem)
    intact = list(zarr_store.intact(path))
    wrong, count = intact.count(False), len(intact)
    problem = f"{wrong} of {count} shards are damaged; allowed is to compute them again" if wrong else ""
    rules = "rules: applied to the file that `drivetrain export` makes of the store"
    return Report((f"checksums: {wrong or 'none'} of {count} shards differ", rules), problem)


def _verify_parts(parts: PartsFolder) -> Report:
    """The report on stored blocks; damaged ones are no error, because a resumed run computes them again."""
    store = parts.path / zarr_store.UNFINISHED
    if store.is_dir():
        present, shards = np.flatnonzero(zarr_store.done(store)).tolist(), zarr_store.shards_of(store)
        intact = sum(zarr_store.read(store, shards, number) is not None for number in present)
    else:
        present = parts.blocks.numbers()
        intact = sum(parts.blocks.read(number) is not None for number in present)
    lines = [f"unfinished: {intact} of {len(present)} blocks are intact"]
    if intact < len(present):
        lines.append("the run that resumes computes the others again")
    return Report(tuple(lines), complete=False)
