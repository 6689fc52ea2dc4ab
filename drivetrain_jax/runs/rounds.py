"""Build an atlas from direct solves. Every round is a job of blocks, stored and resumed like any other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivetrain_jax._wording import counted
from drivetrain_jax.analysis import Analysis, Request
from drivetrain_jax.analysis.atlas.analysis import SOLVES
from drivetrain_jax.atlas import (
    Atlas,
    StabilityAtlas,
    floquet_domain,
    floquet_rounds,
    numbers_per_solve,
    solve_rtol,
    stability_atlas,
)
from drivetrain_jax.atlas.construction import MAX_SOLVES
from drivetrain_jax.runs.axes import Axis
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.scene import Problem, Scene
from drivetrain_jax.runs.work import DIRECT, Progress, Work

# Ratio of the tolerance of the panels to that of the results.
_SHARPER = 0.1


def build_atlas(
    scene: Scene,
    ranges: Mapping[str, tuple[float, float]],
    work: Work,
    progress: Progress,
    max_solves: int | None = None,
) -> tuple[StabilityAtlas, int]:
    """The atlas of ``scene`` over ``ranges``, and the first free number of a block.

    ``progress`` counts the solves and notes gaps.
    """
    fixed = fixed_of(scene, ranges)
    rtol = scene.request.options["rtol"]
    tolerance = _tolerance(scene)
    rounds = floquet_rounds(scene.system, ranges, fixed, tolerance, max_solves or MAX_SOLVES)
    options = {"rtol": solve_rtol(tolerance)}
    width = numbers_per_solve(scene.system, ranges, fixed)
    first, values = 0, None
    while True:
        try:
            points = rounds.send(values)  # pyright: ignore[reportArgumentType]
        except StopIteration as end:
            progress.note = _note(end.value)
            return stability_atlas(end.value, scene.system, rtol), first
        job = Job(_solves(scene, fixed, tuple(ranges), points, options), DIRECT, full_size=True)
        answers = _Answers(len(points), width)
        progress.total += len(points)
        work.do(job, answers, progress, first)
        first += job.boxes.count
        values = answers.values


def _note(atlas: Atlas) -> str:
    """The note about the gaps of ``atlas`` for the user."""
    if not atlas.gaps:
        return ""
    have = f"{counted(len(atlas.panels), 'panel', 'panels')} and {counted(len(atlas.gaps), 'gap', 'gaps')}"
    reasons = "; ".join(sorted({gap.reason for gap in atlas.gaps}))
    return f"the atlas has {have} ({reasons}): what lies in a gap is solved directly"


def node_job(scene: Scene, ranges: Mapping[str, tuple[float, float]], count: int) -> Job:
    """The job of ``count`` solves for an atlas of ``scene``, spread over ``ranges`` like the nodes of its panels."""
    fixed = fixed_of(scene, ranges)
    domain = floquet_domain(scene.system, ranges, fixed)
    spread = np.cos(np.pi * np.random.default_rng(0).random((count, len(ranges))))
    points = domain.points(domain.box().place(spread))
    options = {"rtol": solve_rtol(_tolerance(scene))}
    return Job(_solves(scene, fixed, tuple(ranges), points, options), DIRECT, full_size=True)


def _tolerance(scene: Scene) -> float:
    return _SHARPER * scene.request.options["rtol"]


def fixed_of(scene: Scene, ranges: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    """The parameters of the propagator that are not in ``ranges``, and their values."""
    varying = [part for axis in scene.axes for part in axis.together if part.name not in ranges]
    fixed = {**scene.fixed} | {part.name: part.values[0].item() for part in varying}
    return {name: fixed[name] for name in scene.system.models[SOLVES.name].parameters if name in fixed}


def _solves(scene: Scene, fixed: Mapping, names: tuple[str, ...], points: np.ndarray, options: Mapping) -> Nodes:
    """The solves of one round."""
    axes = tuple(
        Axis(name, scene.system.parameter(name), None, column) for name, column in zip(names, points.T, strict=True)
    )
    request = Request(SOLVES.default_outputs, next(iter(SOLVES.methods)), dict(options))
    return Nodes(scene.system, SOLVES, request, axes, True, fixed)


class Nodes(Problem):
    """Points at which the propagator is solved. Its analysis has the name that scenes give to a whole atlas."""

    @staticmethod
    def find_analysis(name: str) -> Analysis:
        """The analysis of the propagator."""
        return SOLVES


class _Answers:
    """The results of the points of a round, ``(N, m)``, NaN for unsolved points."""

    def __init__(self, count: int, width: int) -> None:
        self.values = np.full((count, width), np.nan)

    def fill(self, points: np.ndarray, results: Mapping[str, np.ndarray]) -> None:
        self.values[points] = np.concatenate([results[name] for name in SOLVES.default_outputs], axis=1)
