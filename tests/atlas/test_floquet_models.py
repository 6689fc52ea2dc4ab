"""Declarations of a system for its atlas: a model of `floquet`, which is required, and coordinates, which are optional."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.analysis.numerics import lanes
from drivetrain_jax.atlas import floquet_atlas, method_of_solves, solve_rtol, stability_atlas
from drivetrain_jax.runs import kernel
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.through_atlas import node_job
from tests.oracles.atlas_direct import BASE, CARDAN, direct_radius, solves


def variant(models):
    """The cardan shaft with other models."""
    return type("Variant", (CARDAN,), {"models": models})


def test_a_system_with_an_atlas_alone_is_refused():
    models = {"atlas": CARDAN.models["atlas"]}
    with pytest.raises(ValueError, match=r"^models of cardan: atlas needs floquet as well$"):
        variant(models)
    assert set(variant(models | {"floquet": CARDAN.models["floquet"]}).models) == {"atlas", "floquet"}


def test_atlas_without_own_coordinates_uses_the_parameters():
    model = replace(CARDAN.models["atlas"], smooth=None)
    plain = variant(CARDAN.models | {"atlas": model})
    ranges, tolerance = {"beta": (0.3, 0.4), "Omega": (1.0, 1.2)}, 1e-8
    fixed = {name: value for name, value in BASE.items() if name not in ranges}

    def solve(points):
        return solves({**fixed, **dict(zip(ranges, points.T, strict=True))}, solve_rtol(tolerance))

    atlas = stability_atlas(floquet_atlas(plain, ranges, fixed, tolerance, solve), plain, 1e-6)
    assert [c.name for c in atlas.atlas.coordinates] == ["beta", "Omega"]
    points = np.array([[0.31, 1.01], [0.35, 1.1], [0.39, 1.19]])
    found, (radius, _) = atlas.at(points), direct_radius(atlas, points)
    assert found["spectral_radius"] == pytest.approx(radius, abs=1e-7)
    assert (np.abs(found["spectral_radius"] - radius) <= found["spectral_radius_error"]).all()


@pytest.mark.parametrize(
    ("slowest", "change", "tolerance", "expected"),
    [
        (0.1, {}, 1e-11, "small"),
        (0.01, {}, 1e-11, "few"),
        (0.1, {"zeta": 300.0}, 1e-11, "direct"),
        (0.1, {}, 1e-13, "direct"),
        (None, {"Omega": 1.0}, 1e-11, "direct"),
    ],
)
def test_solves_are_optimised_only_where_they_are_nodes(slowest, change, tolerance, expected):
    """Power series give the nodes along the speed, without strong damping and above rounding."""
    ranges = {"beta": (0.0, 1.5)} | ({"Omega": (slowest, 2.0)} if slowest else {"mu": (0.5, 2.0)})
    fixed = {name: value for name, value in {**BASE, **change}.items() if name not in ranges}
    assert method_of_solves(CARDAN, ranges, fixed, tolerance) == expected


@pytest.mark.full
def test_a_march_is_traced_once_for_the_solves_of_an_atlas():
    ranges = {"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}
    axes = {name: {"start": low, "stop": high} for name, (low, high) in ranges.items()}
    fixed = {name: value for name, value in BASE.items() if name not in ranges}
    job = node_job(load_scene({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": fixed}), ranges, 8)
    lanes._trace.cache_clear()
    (shapes,) = [kernel.result_shapes(job.problem, job.grid, solver) for solver in job.solvers]
    assert shapes["propagator"] == (16,) and lanes._trace.cache_info().misses == 1
