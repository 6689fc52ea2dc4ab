"""Declarations of a system for its atlas: a model of `floquet`, which is required, and coordinates, which are optional."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.atlas import floquet_atlas, solve_rtol, stability_atlas
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
