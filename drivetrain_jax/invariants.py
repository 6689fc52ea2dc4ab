"""Rules that every result must obey, and the verification of results: from the file alone, without solving equations or
importing jax.

Other packages add rules of their analyses through the entry point group ``drivetrain_jax.rules``; each entry point names a
:class:`Declared`. An analysis without rules has only the general ones.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from drivetrain_jax._plugins import RULES, call_plugin, load_plugin
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax._rules import BUILT_IN, Declared, Rule, in_order, multiple, ordered, sums_to_one, within
from drivetrain_jax.store import checksums, zarr_store
from drivetrain_jax.store.consolidate import attributes, open_result
from drivetrain_jax.store.parts import PartsFolder

__all__ = [
    "Declared",
    "Finding",
    "Report",
    "Rule",
    "check",
    "declared",
    "in_order",
    "multiple",
    "ordered",
    "sums_to_one",
    "verify",
    "verify_dataset",
    "within",
]


@dataclass(frozen=True)
class Finding:
    """Result of a rule: number of checked points, number of points that break the rule, and the first of these."""

    rule: str
    points: int
    broken: int = 0
    first: str = ""

    def __str__(self) -> str:
        if not self.broken:
            return f"{self.rule}: holds at {self.points} points"
        return f"{self.rule}: broken at {self.broken} of {self.points} points, first at {self.first}"


def check(dataset: xr.Dataset) -> list[Finding]:
    """Apply all rules that the variables of ``dataset`` allow: general ones, then those of its analysis."""
    known = declared(str(dataset.attrs.get("analysis")))
    rules = [*_codes(dataset), *_ranges(dataset), *_errors(dataset), *known.rules]
    if known.has_points:
        if "outcome" not in dataset:
            return [Finding("outcome is stored", 1, 1, "the file")]
        # A swept function may return the results of any analysis, so its gaps are not known.
        if dataset.attrs.get("system") != "function" or dataset.attrs.get("analysis") in BUILT_IN:
            rules += _values(dataset, known)
    there = {name for name, variable in dataset.variables.items() if variable.size}
    return [_apply(rule, dataset) for rule in rules if there.issuperset(rule.variables)]


def _apply(rule: Rule, dataset: xr.Dataset) -> Finding:
    broken = rule.broken(dataset)
    if "outcome" in dataset:
        broken = _somewhere(broken, dataset)
    count = int(broken.sum())
    return Finding(rule.text, int(broken.size), count, _place(broken) if count else "")


def _place(broken: xr.DataArray) -> str:
    """Coordinates of the first point that breaks a rule."""
    if not broken.dims:
        return "its only point"
    index = np.unravel_index(int(np.argmax(broken.values)), broken.shape)
    place = dict(zip(broken.dims, index, strict=True))
    return ", ".join(f"{dim} = {_text(broken, dim, int(i))}" for dim, i in place.items())


def _text(values: xr.DataArray, dim: Hashable, i: int) -> str:
    """The coordinate of position ``i`` along ``dim``; the position itself without a coordinate."""
    value = values[dim].values[i] if dim in values.coords else i
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _codes(dataset: xr.Dataset) -> Iterator[Rule]:
    """Rules: every code is one of the flags."""
    for name, variable in dataset.data_vars.items():
        if "flag_values" in variable.attrs:
            allowed = np.atleast_1d(variable.attrs["flag_values"])
            text = f"{name} is one of its {allowed.size} codes"
            yield Rule(text, (str(name),), lambda ds, name=name, allowed=allowed: ~ds[name].isin(allowed))


def _ranges(dataset: xr.Dataset) -> Iterator[Rule]:
    """Rules: no value is below the smallest valid one (CF attribute ``valid_min``)."""
    for name, variable in dataset.data_vars.items():
        if "valid_min" in variable.attrs:
            yield within(str(name), float(variable.attrs["valid_min"]))


def _values(dataset: xr.Dataset, known: Declared) -> Iterator[Rule]:
    """Rules: all values exist after a success, and some value is missing after a failure."""
    whole = [str(n) for n, v in dataset.data_vars.items() if v.dtype.kind in "fc" and n not in known.gaps]
    for name in whole:
        text = f"{name} has a value where outcome says so"
        yield Rule(text, (name,), lambda ds, name=name: ds[name].isnull() & (ds["outcome"] < FIRST_FAILURE))
    lost = [name for name in whole if name not in known.kept]
    if not lost:
        return

    def unfounded(ds: xr.Dataset) -> xr.DataArray:
        missing = sum(_somewhere(ds[name].isnull(), ds) for name in lost) > 0
        return (ds["outcome"] >= FIRST_FAILURE) & ~missing

    yield Rule("a value is missing where outcome says so", tuple(lost), unfounded)


def _somewhere(condition: xr.DataArray, ds: xr.Dataset) -> xr.DataArray:
    return condition.any([dim for dim in condition.dims if dim not in ds["outcome"].dims])


def _errors(dataset: xr.Dataset) -> Iterator[Rule]:
    """Rules: bounds and error estimates are not negative."""
    for name in map(str, dataset.data_vars):
        if name.endswith("_error"):
            yield Rule(f"{name} >= 0", (name,), lambda ds, name=name: ds[name] < 0)


def declared(analysis: str) -> Declared:
    """The declaration of the analysis with this name."""
    if analysis in BUILT_IN:
        return BUILT_IN[analysis]
    rules = load_plugin(RULES, analysis, "the rules of an analysis", lambda x: isinstance(x, Declared))
    if rules is None:
        return Declared()
    broken = {"kind": xr.DataArray, "allowed": "a DataArray of booleans"}

    def named(rule: Rule) -> Rule:
        """``rule`` with errors that name the entry point."""
        called = partial(call_plugin, RULES, analysis, f"rule {rule.text!r} of", rule.broken, **broken)
        return replace(rule, broken=called)

    return replace(rules, rules=tuple(map(named, rules.rules)))


@dataclass(frozen=True, repr=False)
class Report:
    """The ``lines`` of a report; ``problem`` is the first problem, empty without one."""

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
        # Damaged blocks are no error, because a resumed run computes them again.
        store, read = parts.path / zarr_store.UNFINISHED, parts.read
        present = parts.numbers()
        if store.is_dir():
            present = np.flatnonzero(zarr_store.done(store)).tolist()
            read = partial(zarr_store.read, store, zarr_store.shards_of(store))
        intact = sum(read(number) is not None for number in present)
        lines = [f"unfinished: {intact} of {len(present)} finished blocks are intact"]
        lines += ["the run that resumes computes the others again"] if intact < len(present) else []
        return Report(tuple(lines), complete=False)
    if zarr_store.is_store(path):
        if not zarr_store.is_sealed(path):
            what = "attributes of the store"
            return Report((f"checksums: {what} differ",), f"{what}: damaged; restore them or compute the store again")
        intact = list(zarr_store.intact(path))
        wrong, count = intact.count(False), len(intact)
        problem = f"{wrong} of {count} shards are damaged; compute them again" if wrong else ""
        rules = "rules: applied to the file that `drivetrain export` makes of the store"
        return Report((f"checksums: {wrong or 'none'} of {count} shards differ", rules), problem)
    damaged = checksums.damaged(path)
    if damaged is None and "digest" in attributes(path):
        return Report(("checksums: gone",), "its checksums are gone; restore the file or compute it again")
    agreed = "none in this file" if damaged is None else "all agree"
    return _report(damaged, [] if damaged else check(open_result(path)), agreed)


def verify_dataset(dataset: xr.Dataset, file: Path | None) -> Report:
    """The report on the numbers of ``dataset`` and on the checksums of ``file``, from which it was opened."""
    damaged = checksums.damaged(file) if file else None
    agreed = "not of a file" if damaged is None else f"all agree in {file}"
    return _report(damaged, check(dataset), agreed, f"file = {str(file)!r}: ")


def _report(damaged: list[str] | None, findings: list[Finding], agreed: str, before: str = "") -> Report:
    line, problem = f"checksums: {agreed}", next((f"{f}; expected none" for f in findings if f.broken), "")
    if damaged:
        names = checksums.named(damaged)
        line = f"checksums: {len(damaged)} differ: {names}"
        problem = f"{before}{names}: damaged, or written by another program; restore the file or compute it again"
    return Report((line, *map(str, findings)), problem)
