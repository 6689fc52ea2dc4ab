"""On every path of evaluation the bounds include the errors of the atlas and the truncation errors of the evaluation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.results import VARIABLES
from drivetrain_jax.atlas import StabilityAtlas, points
from drivetrain_jax.atlas.criteria import invariants, monodromy
from tests.oracles.atlas_direct import direct_radius, random_points

ERROR = 1e-7
EVERYTHING = tuple(v.name for v in VARIABLES if v.name != "floquet_exponent")
# Columns dense enough for interpolation between nodes, and too few for it.
DENSE, SPARSE = np.linspace(1.0, 1.3, 512), np.linspace(0.3, 2.0, 16)


def with_error(atlas, error=ERROR):
    """The same atlas with panels whose bounds are ``error``."""
    panels = tuple(replace(p, value_error=error) for p in atlas.atlas.panels)
    return StabilityAtlas(replace(atlas.atlas, panels=panels), atlas.build, atlas.rtol)


@pytest.fixture(scope="module")
def coarse(chart):
    return with_error(chart)


WAYS = {
    "dense columns": lambda atlas: atlas.on_grid([np.linspace(0.1, 0.3, 8), DENSE]),
    "sparse columns": lambda atlas: atlas.on_grid([np.linspace(0.1, 0.3, 8), SPARSE]),
    "points": lambda atlas: atlas.at(random_points(atlas, 200)),
    "eigenvalues": lambda atlas: atlas.at(random_points(atlas, 200), EVERYTHING),
}


@pytest.mark.parametrize("way", WAYS)
def test_bounds_include_the_error_of_a_panel(chart, coarse, way):
    sharp, wide = WAYS[way](chart), WAYS[way](coarse)
    bound = wide["spectral_radius_error"]
    assert wide["spectral_radius"] == pytest.approx(sharp["spectral_radius"], rel=1e-9)
    assert (bound >= sharp["spectral_radius_error"]).all() and (bound > ERROR / 10).mean() > 0.99


def test_bounds_include_the_truncation_error_of_an_expansion(chart, monkeypatch):
    """Each box has fewer polynomials than needed."""
    monkeypatch.setattr(points, "_PART", 1e4)
    poor = StabilityAtlas(chart.atlas, chart.build, chart.rtol)
    drawn = random_points(chart, 300, seed=3)
    found, (radius, _) = poor.at(drawn), direct_radius(chart, drawn)
    assert (np.abs(found["spectral_radius"] - radius) <= found["spectral_radius_error"] + 1e-13).all()
    assert np.median(found["spectral_radius_error"]) > 1e-8


def test_a_coarse_atlas_is_undecided_on_a_boundary(chart, coarse):
    """The boundary is the left edge of S21, by bisection down to rounding."""
    below, above = 1.3, 1.416
    for _ in range(45):
        middle = (below + above) / 2
        unstable = chart.at(np.array([[0.5, middle]]))["spectral_radius"][0] > 1
        below, above = (below, middle) if unstable else (middle, above)
    near = np.array([[0.5, below], [0.5, below - 1e-10], [0.5, above + 1e-10]])
    assert 1.3 < below < 1.416 and (coarse.at(near)["verdict"] == 2).all()
    assert chart.at(np.array([[0.5, below - 1e-3], [0.5, above + 1e-3]]))["verdict"].tolist() == [0, 1]


def test_undamped_tongue_narrower_than_the_error_is_undecided(undamped):
    """At beta = 0.001 an accurate atlas finds S21; an atlas with an error of 1e-5 does not decide."""
    point = np.array([[1e-3, 1.4159846397197]])
    assert undamped.at(point)["verdict"].tolist() == [1]
    assert with_error(undamped, 1e-5).at(point)["verdict"].tolist() == [2]


def test_rounding_of_the_coefficients_is_bounded():
    """Sums in double precision are compared with sums in extended precision."""
    phi = np.random.default_rng(6).normal(size=(16, 2000))
    found, bounds, _ = quartic.invariants(quartic.blocks(phi))
    exact = invariants(monodromy(phi.astype(np.longdouble)))
    for e, bound, true in zip(found, bounds, exact, strict=True):
        error = np.abs(np.asarray(e) - true)
        assert (error <= np.asarray(bound)).all() and error.max() > 0
