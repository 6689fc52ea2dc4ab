"""The state of a result compared with its scene, and unfinished work as a labelled result."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.assemble import PENDING, ResultBuffer, labelled, with_pending
from drivetrain_jax.runs.output import Output
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene, restore_scene
from drivetrain_jax.store import checksums, consolidate
from drivetrain_jax.store.netcdf import opened
from drivetrain_jax.store.parts import PartsFolder

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Status:
    """Counts of the points at ``out``, and the state: absent, partial, complete or stale (another scene).

    ``failed_by_outcome`` counts the points without a value by outcome; ``remedy`` says what may help those that have not
    converged. ``inaccurate`` points have a value whose error exceeds the target. ``reason`` is the error message that a run
    would give, empty without one.
    """

    total: int
    done: int
    failed: int
    state: str
    failed_by_outcome: Mapping[str, int] = field(default_factory=dict)
    reason: str = ""
    remedy: str = ""
    inaccurate: int = 0

    def __str__(self) -> str:
        lines = [f"{self.state}: {self.done} of {self.total} points done, {self.failed} without a value"]
        hints = {"not_converged": f" ({self.remedy})" if self.remedy else ""}
        lines += [f"  {name}: {count}{hints.get(name, '')}" for name, count in self.failed_by_outcome.items()]
        lines += [f"  tolerance_not_met: {self.inaccurate}, with a value"] if self.inaccurate else []
        return "\n".join([*lines, *([f"  a run would stop: {self.reason}"] if self.reason else [])])

    def to_json(self) -> str:
        """The counts, the state and the reason as one JSON object."""
        content = {name: getattr(self, name) for name in ("total", "done", "failed", "state")}
        more = {"failed_by_outcome": dict(self.failed_by_outcome), "inaccurate": self.inaccurate, "reason": self.reason}
        return json.dumps(content | {name: value for name, value in more.items() if value})


def status(
    scene: str | Path | Mapping[str, Any], out: str | Path, overrides: Mapping[str, Any] | None = None
) -> Status:
    """The :class:`Status` of ``scene`` at ``out``. Changes nothing and compiles nothing."""
    job = resolve(load_scene(scene, overrides))
    output, total = Output(Path(out), job), 0 if job.scene.analysis.continuous else job.total
    if output.state == "stale":
        reason = f"it holds {output.obstacle}; {output.remedy}"
        return Status(total, 0, 0, output.state, reason=reason)
    try:
        codes = _codes(output)
    except InputError as error:
        return Status(total, 0, 0, "stale", reason=str(error))
    done = output.points(codes.total()) if output.state == "complete" else codes.total()
    without = {o.name.lower(): codes[o] for o in Outcome if not o.has_value and codes[o]}
    return Status(
        total or done,
        done,
        sum(without.values()),
        output.state,
        without,
        remedy=job.scene.analysis.remedy(job.scene.request),
        inaccurate=codes[Outcome.TOLERANCE_NOT_MET],
    )


def _codes(output: Output) -> Counter[int]:
    """Number of finished points by outcome; of an atlas, number of finished solves."""
    job, codes = output.job, Counter[int]()
    if output.state == "complete":
        found = [output.outcomes]
    elif output.state != "partial":
        found = []
    elif job.scene.analysis.continuous:
        stored = (output.blocks.read(number) for number in output.blocks.numbers())
        found = (results[OUTCOME.name] for results in stored if results is not None)
    elif job.route.is_pointwise:
        found = (results[OUTCOME.name] for _, results in output.finished())
    else:
        # A run through an atlas has no points before its end.
        found = []
    for outcome in found:
        codes.update(dict(zip(*(part.tolist() for part in np.unique(outcome, return_counts=True)), strict=True)))
    return codes


def open_result(path: str | Path) -> xr.Dataset:
    """The result at ``path``, loaded into memory.

    If only unfinished work in ``FILE.nc.parts/`` exists, missing points have the outcome ``pending`` and no value; the
    attribute ``points_done`` counts the others. A running computation is not disturbed.

    Raises :class:`InputError` if there is neither, if the result is damaged, or if the work belongs to other code.

    >>> import drivetrain_jax as dt
    >>> dt.open_result("missing.nc")
    Traceback (most recent call last):
    drivetrain_jax._errors.InputError: file = 'missing.nc': does not exist; give a result written by `drivetrain run`
    """
    path = Path(path).expanduser()
    if path.exists() or not PartsFolder(path).holds_work():
        checksums.refuse_damaged(path)
        return consolidate.open_result(path)
    job = resolve(restore_scene(str(PartsFolder(path).plan().get("scene", ""))))
    output = Output(path, job)
    if output.state != "partial":
        raise InputError(f"file = {str(path)!r}: holds {output.obstacle}; allowed is to run its scene again")
    if not job.route.is_pointwise:
        raise InputError(
            f"file = {str(path)!r}: an atlas that is not finished; allowed is to wait for it or to resume it"
        )
    buffer, count = ResultBuffer(job.scene, job.grid, blank=PENDING), 0
    for points, results in output.finished():
        buffer.fill(points, results)
        count += results[OUTCOME.name].size
    found = labelled(job.scene, buffer.lay_out(), {"digest": job.digest, "points_done": count})
    title = f"{job.scene.title} (unfinished: {count} of {job.total} points)"
    return with_pending(found).with_attrs(title=title).to_dataset()


_BOUND, _VERDICT, _UNDECIDED = "spectral_radius_error", "verdict", 2


def missed(out: Path, count: int, total: int) -> str:
    """The remark about ``count`` of ``total`` values of the result at ``out``; a Zarr store gives only these numbers."""
    text = f"{count:,} of {total:,} values {'misses' if count == 1 else 'miss'} the tolerance"
    mark = f"{OUTCOME.name} = {int(Outcome.TOLERANCE_NOT_MET)} marks {'it' if count == 1 else 'them'}"
    if out.is_dir():
        return f"{text}; {mark}"
    with cast(Any, opened(out)) as file:
        rtol = json.loads(file.attrs.get("options", "{}")).get("rtol")
        text += f" {rtol:g}" if rtol else ""
        outcome = file[OUTCOME.name]
        places = np.flatnonzero(outcome[()] == Outcome.TOLERANCE_NOT_MET)
        if _BOUND in file:
            bounds = file[_BOUND][()].reshape(-1)[places]
            place = np.unravel_index(places[np.argmax(bounds)], outcome.shape)
            axes = {dim[0].name.strip("/"): dim[0][i] for dim, i in zip(outcome.dims, place, strict=True)}
            at = ", ".join(f"{name} = {value:.6g}" for name, value in axes.items())
            text += f" (largest error bound {bounds.max():.1e}, at {at})"
        if _VERDICT in file:
            undecided = int((file[_VERDICT][()].reshape(-1)[places] == _UNDECIDED).sum())
            text += f"; {undecided:,} of them undecided" if undecided else "; the verdicts are decided"
    return f"{text}; {mark}"
