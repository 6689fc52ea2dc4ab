"""Attack atlases of the cardan shaft where they are weakest, to find true errors larger than their bounds.

    python -m benchmarks.atlas_attack                     # every case; writes results/atlas_attack.csv after each
    python -m benchmarks.atlas_attack --only base wide    # only these cases; the rows of the others stay
    python -m benchmarks.atlas_attack --quick             # few cells, to a temporary folder; --cells N: of each kind

Each case measures the relative error of Z at random points of its ranges. It measures the error of rho against direct solves
with rtol = 1e-14 at three kinds of cells: random cells of a grid, the cells nearest to rho = 1, and those with the widest
bound. Of each kind, the cells with the largest ratio of error to bound are compared again with values to 30 digits, which
share no code with the package (tests.oracles.cardan_precise_reference). Against direct solves an error may exceed its bound
by 2e-14 of the value, because both sides are rounded; against 30 digits it may not exceed its bound. With more than two
parameters random points replace the grid.

Without damping the package sets rho = 1 in stable cells. Direct solves there have an error of the root of rounding, and must
only be near 1.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.measure import load, parser, pool, results_folder, write_csv
from tests.oracles import cardan_precise_reference as precise
from tests.oracles.cardan_reference import BASE_CASE

if TYPE_CHECKING:
    from drivetrain_jax.atlas import StabilityAtlas

NAME = "atlas_attack"
STABLE, UNSTABLE, UNDECIDED = 0, 1, 2
# Relative error allowed to the direct solves themselves, including the eigenvalues of their Z.
ROUNDING = 2e-14
# Largest distance from 1 of direct solves whose multipliers are on the unit circle.
_NEAR = 1e-6
# With more than two parameters: number of grid cells that one random point replaces.
_PART = 30
KINDS = ("random", "nearest", "widest")
# Parameters other than beta and Omega that a case changes or has as an axis.
_OTHERS = ("zeta", "alpha", "mu")

Results = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """An atlas: ranges of its parameters, its tolerance, and its changes of the base case."""

    name: str
    ranges: Mapping[str, tuple[float, float]]
    tolerance: float
    change: Mapping[str, float] = field(default_factory=dict)
    rtol: float = 1e-10

    @property
    def fixed(self) -> dict[str, float]:
        """The parameters that are not axes."""
        return {name: value for name, value in {**BASE_CASE, **self.change}.items() if name not in self.ranges}

    def build(self) -> StabilityAtlas:
        """The atlas, by direct solves."""
        from tests.oracles.atlas_direct import cardan_atlas

        return cardan_atlas(self.ranges, self.tolerance, self.fixed, self.rtol)


@dataclass(frozen=True)
class Size:
    """Numbers of a case: cells of each kind, cells of the grid along each axis, and cells compared with 30 digits."""

    cells: int = 10_000
    side: int = 3000
    worst: int = 50


QUICK = Size(500, 200, 2)
_CHART = {"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}
CASES = (
    Case("narrow", {"beta": (0.0, 1.5), "Omega": (0.3, 2.0)}, 1e-11),
    Case("base", _CHART, 1e-11),
    Case("wide", {"beta": (0.0, 1.55), "Omega": (0.02, 5.0)}, 1e-9),
    Case("zeta=0", _CHART, 1e-11, {"zeta": 0.0}),
    Case("zeta=1e-6", _CHART, 1e-11, {"zeta": 1e-6}),
    Case("zeta=0.1", _CHART, 1e-11, {"zeta": 0.1}),
    Case("alpha=20", _CHART, 1e-11, {"alpha": 20.0}),
    Case("mu=20", _CHART, 1e-11, {"mu": 20.0}),
    Case("four", {"beta": (0.0, 1.3), "Omega": (0.2, 2.5), "mu": (0.2, 20.0), "alpha": (0.1, 20.0)}, 2e-9, rtol=1e-8),
)


def violations(found: Results, radius: np.ndarray) -> np.ndarray:
    """Flags of cells whose spectral radius is further from ``radius`` than its bound and rounding allow."""
    return np.abs(found["spectral_radius"] - radius) > found["spectral_radius_error"] + ROUNDING * radius


def wrong(found: Results, radius: np.ndarray) -> np.ndarray:
    """Flags of cells whose verdict contradicts ``radius``."""
    stable, unstable = found["verdict"] == STABLE, found["verdict"] == UNSTABLE
    return (stable & (radius > 1 + ROUNDING)) | (unstable & (radius < 1 - ROUNDING))


def hardest(found: Results, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of the cells nearest to rho = 1, without those set to 1, and of the cells with the widest bound."""
    radius = found["spectral_radius"].reshape(-1)
    distance = np.where(radius == 1, np.inf, np.abs(radius - 1))
    return _smallest(distance, count), _smallest(-found["spectral_radius_error"].reshape(-1), count)


def _smallest(values: np.ndarray, count: int) -> np.ndarray:
    count = min(count, values.size)
    chosen = np.argpartition(values, count - 1)[:count]
    return chosen[np.argsort(values[chosen], kind="stable")]


def relative_error_of_z(atlas: StabilityAtlas, points: np.ndarray) -> np.ndarray:
    """Error of the balanced Z at ``points`` against direct solves, relative to the norm of Z."""
    from drivetrain_jax.atlas.floquet import balanced_entries, floquet_domain
    from drivetrain_jax.atlas.interpolation import evaluate
    from drivetrain_jax.atlas.panels import position
    from tests.oracles.atlas_direct import CARDAN, monodromy, propagators

    columns = {**atlas.atlas.fixed, **dict(zip(atlas.atlas.parameters, points.T, strict=True))}
    ranges = dict(zip(atlas.atlas.parameters, zip(atlas.atlas.lower, atlas.atlas.upper, strict=True), strict=True))
    domain = floquet_domain(CARDAN, ranges, atlas.atlas.fixed)
    exact = monodromy(balanced_entries(CARDAN, domain, points, propagators(columns, 1e-14)))
    x = atlas.atlas.to_coordinates(points)
    number, phi = atlas.atlas.find(x), np.empty((len(points), 16))
    for k, panel in enumerate(atlas.atlas.panels):
        phi[number == k] = evaluate(panel.coefficients, position(panel, x[number == k]))
    return np.linalg.norm(monodromy(phi) - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))


def candidates(atlas: StabilityAtlas, side: int) -> tuple[Callable[[np.ndarray], np.ndarray], Results]:
    """The points of chosen cells, and the results of all as flat arrays.

    There are ``side`` x ``side`` cells over the ranges of the atlas, or fewer random points, each of which takes longer.
    """
    from tests.oracles.atlas_direct import random_points

    if len(atlas.atlas.parameters) > 2:
        points = random_points(atlas, side**2 // _PART, seed=3)
        return points.__getitem__, atlas.at(points)
    axes = [np.linspace(low, high, side) for low, high in zip(atlas.atlas.lower, atlas.atlas.upper, strict=True)]

    def place(chosen: np.ndarray) -> np.ndarray:
        i, j = np.unravel_index(chosen, (side, side))
        return np.stack([axes[0][i], axes[1][j]], axis=1)

    return place, {name: value.reshape(-1) for name, value in atlas.on_grid(axes).items()}


@dataclass(frozen=True)
class Comparison:
    """Errors of some cells, the largest ratio of error to bound, and numbers of violated bounds and wrong verdicts."""

    error: np.ndarray
    ratio: float
    violations: int
    wrong: int


def against_direct(points: np.ndarray, found: Results, radius: np.ndarray) -> Comparison:
    """The comparison of cells with direct solves."""
    decreed = found["spectral_radius"] == 1
    judged = (found["verdict"] != UNDECIDED) & ~decreed
    error = np.abs(found["spectral_radius"] - radius)
    beyond = np.maximum(error - ROUNDING * radius, 0.0)[judged] / found["spectral_radius_error"][judged]
    off = decreed & (np.abs(radius - 1) > _NEAR)
    return Comparison(
        error[judged],
        float(beyond.max(initial=0.0)),
        int((violations(found, radius) & judged).sum()),
        int((wrong(found, radius) & ~decreed | off).sum()),
    )


def worst(found: Results, radius: np.ndarray, count: int) -> np.ndarray:
    """Indices of the cells with the largest ratio of error to bound."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(found["spectral_radius"] - radius) / found["spectral_radius_error"]
    return np.argsort(-np.where(np.isfinite(ratio), ratio, -1))[:count]


def precise_radius(point: Mapping[str, float]) -> float:
    """Spectral radius to 30 digits, by code independent of the package."""
    return float(precise.spectral_radius(point))


def against_precise(
    atlas: StabilityAtlas, points: np.ndarray, found: Results, pool: Executor | None = None
) -> Comparison:
    """The comparison of cells with values to 30 digits; no error may exceed its bound."""
    names, fixed = atlas.atlas.parameters, atlas.atlas.fixed
    given = [{**fixed, **dict(zip(names, point, strict=True))} for point in points.tolist()]
    exact = np.array(list((pool.map if pool else map)(precise_radius, given)))
    error, bound, verdict = np.abs(found["spectral_radius"] - exact), found["spectral_radius_error"], found["verdict"]
    # Without damping the precise value of a stable cell is 1 to all digits.
    contradicted = (verdict == STABLE) & (exact > 1) | (verdict == UNSTABLE) & (exact <= 1)
    ratio = np.divide(error, bound, out=np.where(error > 0, np.inf, 0.0), where=bound > 0)
    return Comparison(error, float(ratio.max(initial=0.0)), int((error > bound).sum()), int(contradicted.sum()))


def attack(case: Case, size: Size, atlas: StabilityAtlas, pool: Executor | None = None) -> dict[str, Any]:
    """The row of the file for one case."""
    from tests.oracles.atlas_direct import direct_radius, random_points

    row = description(case, atlas) | {
        "z_error": float(relative_error_of_z(atlas, random_points(atlas, size.cells)).max())
    }
    place, results = candidates(atlas, size.side)
    undecided, total = int((results["verdict"] == UNDECIDED).sum()), results["verdict"].size
    chosen = (np.random.default_rng(2).integers(0, total, size.cells), *hardest(results, size.cells))
    direct, exact = {}, {}
    for kind, index in zip(KINDS, chosen, strict=True):
        points, found = place(index), {name: value[index] for name, value in results.items()}
        radius, _ = direct_radius(atlas, points)
        direct[kind] = against_direct(points, found, radius)
        few = worst(found, radius, size.worst)
        exact[kind] = against_precise(atlas, points[few], {name: value[few] for name, value in found.items()}, pool)
    row["rho_error"] = float(np.quantile(direct["random"].error, 0.999))
    row |= {"cells": size.cells, "worst": size.worst}
    for name, compared in (("direct", direct), ("precise", exact)):
        row |= {f"{kind}_{name}": compared[kind].ratio for kind in KINDS}
        row |= {f"{what}_{name}": sum(getattr(c, what) for c in compared.values()) for what in ("violations", "wrong")}
    return row | {"undecided": undecided, "of": total}


def description(case: Case, atlas: StabilityAtlas) -> dict[str, Any]:
    """Columns that describe a case and the size of its atlas."""
    from drivetrain_jax.atlas import to_arrays

    ranges = {name: f"{low:g}..{high:g}" for name, (low, high) in case.ranges.items()}
    fixed = {name: f"{value:g}" for name, value in case.fixed.items()}
    return {
        "case": case.name,
        **{name: (ranges | fixed)[name] for name in ("beta", "Omega", *_OTHERS)},
        "tolerance": f"{case.tolerance:g}",
        "panels": " ".join("x".join(map(str, panel.degrees)) for panel in atlas.atlas.panels),
        "gaps": len(atlas.atlas.gaps),
        "solves": atlas.atlas.solves,
        "bytes": sum(np.asarray(array).nbytes for array in to_arrays(atlas.atlas).values()),
    }


def merged(rows: Iterable[Mapping[str, Any]], new: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """``rows`` with ``new`` in place of the row of the same case, in the order of the cases."""
    kept = {row["case"]: row for row in rows} | {new["case"]: new}
    return [kept[case.name] for case in CASES if case.name in kept]


def main(arguments: Sequence[str] | None = None) -> None:
    """Attack the cases, writing the CSV after each."""
    known = parser(__doc__)
    known.add_argument("--only", nargs="+", choices=[case.name for case in CASES], metavar="CASE", default=None)
    known.add_argument("--cells", type=int, help=f"of each kind ({Size.cells:,}; quick: {QUICK.cells:,})")
    options = known.parse_args(arguments)
    folder, size = results_folder(options), QUICK if options.quick else Size()
    size = Size(options.cells or size.cells, size.side, size.worst)
    cases = [case for case in CASES if options.only is None or case.name in options.only]
    for case in cases:
        start = time.perf_counter()
        row = attack(case, size, case.build(), pool())
        seconds = round(time.perf_counter() - start)
        write(folder, row | {"seconds": seconds, "measured": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}"})


def write(folder: Path, row: Mapping[str, Any]) -> None:
    """Put ``row`` into the file."""
    before = load(folder, NAME)
    rows = before.rows.to_dict("records") if before else []
    write_csv(folder / f"{NAME}.csv", merged(rows, row), ["gamma 100"])


if __name__ == "__main__":
    main()
