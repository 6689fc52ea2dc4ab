"""The state of a result file compared with its scene."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.runs.output_state import OutputState
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.shard_writer import block_of


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
    output, total = OutputState(Path(out), job), job.route.total(job, 0)
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
        job.route.total(job, done),
        done,
        sum(without.values()),
        output.state,
        without,
        remedy=job.scene.analysis.remedy(job.scene.request),
        inaccurate=codes[Outcome.TOLERANCE_NOT_MET],
    )


def _codes(output: OutputState) -> Counter[int]:
    """Number of finished points by outcome."""
    codes = Counter[int]()
    for outcome in _outcomes(output):
        codes.update(dict(zip(*(part.tolist() for part in np.unique(outcome, return_counts=True)), strict=True)))
    return codes


def _outcomes(output: OutputState) -> Iterator[np.ndarray]:
    """Outcomes of all finished points."""
    if output.state == "complete":
        yield output.outcomes
    elif output.state == "partial":
        seen, written = set[int](), set[int]()
        for shard, _, results in output.sink.shards(output.job):
            written.add(shard)
            yield results[OUTCOME.name]
        for part in output.parts.read():
            if output.job.route.counts(part) and not (written and block_of(part) in written):
                # An interrupt during writing may leave a chunk in two parts.
                yield from (results[OUTCOME.name] for number, results in part if number not in seen)
                seen.update(part.chunks.tolist())
        for _, results in output.reused_before().blocks([OUTCOME.name]):
            yield results[OUTCOME.name]
