"""The page's evaluation, run by Node, against Python: values within the bounds, no other verdict."""

from __future__ import annotations

import numpy as np
import pytest

from tests.explore.conftest import columns, node
from tests.sizes import full_after

UNDECIDED = 2
LARGE_GRIDS = (("three", (0, 1)), ("three", (2, 0)), ("four", (3, 2)))


@pytest.fixture(scope="session")
def pages(atlases, tmp_path_factory):
    """A function of a name: the file of its page."""
    folder, found = tmp_path_factory.mktemp("pages"), {}

    def page(name):
        if name not in found:
            found[name] = folder / f"{name}.html"
            found[name].write_text(atlases(name).explore().text)
        return found[name]

    return page


def chosen(atlas, count: int, few: int) -> np.ndarray:
    """Points ``(N, d)``: ``count`` random ones, and of eight times as many the ``few`` nearest to a boundary and the
    ``few`` with the widest bound."""
    inside = atlas.stability.atlas
    points = np.random.default_rng(7).uniform(inside.lower, inside.upper, (8 * count, len(inside.parameters)))
    found = columns(atlas, points)
    with np.errstate(invalid="ignore"):
        nearest = np.argsort(np.abs(found["spectral_radius"] - 1))[:few]
        widest = np.argsort(-found["spectral_radius_error"] / found["spectral_radius"])[:few]
    return np.concatenate([points[:count], points[nearest], points[widest]])


def by_node(page, points, folder):
    points.astype("<f8").tofile(folder / "points")
    assert node(page, "points", folder / "points", folder / "found") == len(points)
    return np.fromfile(folder / "found", "<f8").reshape(-1, 3).T


def agree(ours, theirs):
    """Python's results and those of the page: how many of Python's decided verdicts the page leaves open."""
    rho, error, verdict = (ours[name] for name in ("spectral_radius", "spectral_radius_error", "verdict"))
    both = (verdict != UNDECIDED) & (theirs[2] != UNDECIDED)
    assert (verdict[both] == theirs[2][both]).all()
    known = np.isfinite(rho)
    assert (known == np.isfinite(theirs[0])).all() and known.any()
    difference = np.abs(rho - theirs[0])[known]
    assert (difference <= error[known]).all() and (difference <= theirs[1][known]).all()
    # Bounds of the same size: nothing is decided by chance, and nothing is given away.
    assert 0.5 < np.median(theirs[1][known] / error[known]) < 4
    return int(((verdict != UNDECIDED) & (theirs[2] == UNDECIDED)).sum())


@pytest.mark.parametrize("name", full_after(1, ["two", "one", "mathieu", "undamped", "three", "four"]))
def test_points_have_the_values_and_verdicts_of_python(atlases, pages, tmp_path, name):
    points = chosen(atlases(name), 500, 100)
    lost = agree(columns(atlases(name), points), by_node(pages(name), points, tmp_path))
    assert lost <= 1


@pytest.mark.full
@pytest.mark.parametrize("name", ["two", "three", "four"])
def test_many_points_have_the_values_and_verdicts_of_python(atlases, pages, tmp_path, name):
    points = chosen(atlases(name), 10_000, 2_000)
    lost = agree(columns(atlases(name), points), by_node(pages(name), points, tmp_path))
    assert lost <= len(points) / 1000


@pytest.mark.parametrize(
    ("name", "axes"),
    [("two", (0, 1)), ("two", (1, 0)), *(pytest.param(*case, marks=pytest.mark.full) for case in LARGE_GRIDS)],
)
def test_grids_have_the_values_and_verdicts_of_python(atlases, pages, tmp_path, name, axes):
    """A grid goes through nodes and interpolation; the undamped one, at zeta = 0 of `three`, through every cell."""
    atlas, n = atlases(name), 97
    inside = atlas.stability.atlas
    points = np.tile((inside.lower + inside.upper) / 2, (n * n, 1))
    rows, across = (np.linspace(inside.lower[k], inside.upper[k], n) for k in axes)
    points[:, axes[0]], points[:, axes[1]] = np.repeat(rows, n), np.tile(across, n)
    assert node(pages(name), "grid", *axes, n, tmp_path / "found") == n * n
    theirs = np.fromfile(tmp_path / "found", "<f8").reshape(3, -1)
    assert agree(columns(atlas, points), theirs) <= 1


@pytest.mark.full
def test_without_damping_verdicts_are_exact(atlases, pages, tmp_path):
    """At zeta = 0, in an atlas over the damping: rho = 1 exactly wherever the motion is bounded."""
    points = chosen(atlases("three"), 300, 10)
    points[:, atlases("three").parameters.index("zeta")] = 0.0
    rho, _, verdict = by_node(pages("three"), points, tmp_path)
    ours = columns(atlases("three"), points)["verdict"]
    assert (ours == verdict).mean() > 0.99 and (verdict == 0).mean() > 0.3 and (rho[verdict == 0] == 1).all()


def test_outside_and_in_gaps_nothing_is_decided(atlases, tmp_path):
    """A box without a panel is cut out of an atlas."""
    from dataclasses import replace

    from drivetrain_jax.atlas import Gap

    whole = atlases("two")
    (panel,) = whole.stability.atlas.panels
    middle = (panel.lower + panel.upper) / 2
    gap = Gap(np.array([panel.lower[0], middle[1]]), panel.upper, "cut out")
    # The panel keeps its polynomials over the lower half of 1/Omega only.
    half = replace(panel, upper=np.array([panel.upper[0], middle[1]]), coefficients=_lower_half(panel.coefficients))
    inside = replace(whole.stability.atlas, panels=(half,), gaps=(gap,))
    cut = replace(whole, stability=replace(whole.stability, atlas=inside))
    (tmp_path / "page.html").write_text(cut.explore().text)
    points = np.array([[0.5, 0.21], [0.5, 1.9], [1.5, 1.9], [0.5, 0.1]])
    rho, error, verdict = by_node(tmp_path / "page.html", points, tmp_path)
    assert np.isnan(rho).tolist() == np.isnan(error).tolist() == [True, False, True, True]
    assert (verdict[[0, 2, 3]] == UNDECIDED).all()
    expected = columns(whole, points[1:2])["spectral_radius"]
    assert rho[1] == pytest.approx(expected[0], rel=1e-8)
    assert node(tmp_path / "page.html", "grid", 0, 1, 50, tmp_path / "found") == 2500
    codes = np.fromfile(tmp_path / "found", "<f8").reshape(3, 50, 50)[2]
    assert set(codes[:, 0]) == {3.0} and 3.0 not in codes[:, -1]


def _lower_half(coefficients):
    """The polynomials over the lower half of the second coordinate."""
    from drivetrain_jax.atlas.interpolation import analysis_matrix, nodes
    from drivetrain_jax.atlas.panels import chebyshev

    n = coefficients.shape[1]
    matrix = analysis_matrix(n) @ chebyshev((nodes(n) - 1) / 2, n)
    return np.einsum("ij,ajm->aim", matrix, coefficients)


@pytest.mark.full
def test_the_nearest_changes_are_those_of_query(atlases, pages):
    atlas, point = atlases("two"), {"beta": 0.6, "Omega": 1.2}
    told = node(pages("two"), "nearest", *point.values())
    from drivetrain_jax.runs.atlas_answers import query

    expected = query(atlas, point).data["nearest"]
    for each in told:
        for side in ("below", "above"):
            crossing = expected[each["name"]][side]
            if crossing is None or abs(crossing["value"]) > 1.39:
                continue
            assert each[side] == pytest.approx(crossing["value"], rel=1e-7), (each, side)


@pytest.mark.full
@pytest.mark.parametrize(("name", "axes", "limit"), [("two", (0, 1), 1.8), ("four", (0, 1), 1.5)])
def test_a_chart_is_redrawn_while_a_slider_moves(pages, name, axes, limit):
    """512 x 512 cells in multiples of a plain loop over arrays, which a slow or busy machine slows as much."""
    least = node(pages(name), "speed", *axes, 512, 25)
    assert least["chart"] < limit * least["loop"], least
