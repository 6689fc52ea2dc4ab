"""Construction of atlases of known functions: panels, splits, gaps, and nodes that are given."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas import Domain, Function, construct, from_arrays, to_arrays
from drivetrain_jax.atlas.interpolation import evaluate
from drivetrain_jax.atlas.panels import position
from drivetrain_jax.systems import Coordinate
from drivetrain_jax.systems._smoothness import identity

TOLERANCE = 1e-10
SQUARE = Domain(("x", "y"), (-1.0, 0.5), (2.0, 3.0), (identity("x"), identity("y")), {})


def built(domain, solve, tolerance=TOLERANCE, **more):
    """An atlas of ``solve(points)``, whose tolerance is relative to the largest value."""

    def solved(x):
        values = solve(domain.points(x))
        return values, np.zeros(len(values))

    scale = lambda values: np.full(len(values), np.linalg.norm(values, axis=1).max())  # noqa: E731
    return construct(domain, Function(solved, scale, more.pop("grid", None)), tolerance, **more)


def values(atlas, points):
    """Values of the panels and their bounds, NaN elsewhere."""
    x = atlas.to_coordinates(points)
    number = atlas.find(x)
    found, bound = np.full((len(x), atlas.panels[0].coefficients.shape[-1]), np.nan), np.full(len(x), np.nan)
    for k, panel in enumerate(atlas.panels):
        found[number == k] = evaluate(panel.coefficients, position(panel, x[number == k]))
        bound[number == k] = panel.value_error
    return found, bound


def sample(domain, count=2000):
    lower, upper = np.array(domain.lower), np.array(domain.upper)
    return lower + (upper - lower) * np.random.default_rng(3).random((count, len(lower)))


def waves(p):
    x, y = p.T
    return np.stack([np.cos(7 * x * y), np.exp(-(x**2)) / (1 + y**2)], axis=1)


def beam(p):
    """Closed form of det/2 of a cantilever with an elastic end support, cosh cos + 1 + k (cosh sin - sinh cos)/q^3."""
    q, k = p.T
    det = np.cosh(q) * np.cos(q) + 1 + k * (np.cosh(q) * np.sin(q) - np.sinh(q) * np.cos(q)) / q**3
    return det[:, None] / np.cosh(q)[:, None]


def holds(atlas, function, domain=SQUARE, limit=TOLERANCE):
    """True if all errors at random points are within the bounds and the limit."""
    points = sample(domain)
    found, bound = values(atlas, points)
    error = np.linalg.norm(found - function(points), axis=1)
    return not atlas.gaps and bool((error <= bound).all()) and error.max() < limit


def test_smooth_function_is_met_within_tolerance_and_bounds():
    atlas = built(SQUARE, waves)
    assert holds(atlas, waves) and len(atlas.panels) == 1 and 64 < atlas.solves < 4000
    assert atlas.panels[0].value_error < 30 * TOLERANCE


def test_determinant_over_frequency_and_support_stiffness():
    stiffness = Coordinate("ln k", np.log, np.exp, lambda k: 1 / np.asarray(k))
    domain = Domain(("q", "k"), (0.5, 0.1), (12.0, 50.0), (identity("q"), stiffness), {})
    assert holds(built(domain, beam), beam, domain, 10 * TOLERANCE)


def test_one_three_and_four_parameters():
    def f(p):
        return np.stack([np.cos(p.sum(axis=1)), np.exp(-p.prod(axis=1))], axis=1)

    for d, tolerance in ((1, 1e-12), (3, 1e-8), (4, 1e-6)):
        names = tuple("abcd"[:d])
        domain = Domain(names, (0.0,) * d, (1.0,) * d, tuple(map(identity, names)), {})
        atlas = built(domain, f, tolerance)
        assert holds(atlas, f, domain, 2 * tolerance)
        if d > 1:
            points = sample(domain, 500)
            slice_ = atlas.slice({"b": 0.3})
            rest = np.delete(points, 1, axis=1)
            points[:, 1] = 0.3
            assert slice_.parameters == (names[0], *names[2:]) and slice_.fixed == {"b": 0.3}
            assert np.abs(values(slice_, rest)[0] - values(atlas, points)[0]).max() < 1e-13


@pytest.mark.parametrize("d", [1, 2, 3])
def test_points_of_a_grid_have_the_values_of_single_points(d):
    """Points that share coordinates share products; the order of the points does not matter."""
    random = np.random.default_rng(d)
    tensor = random.normal(size=(*(5, 4, 6)[:d], 3))
    grid = np.stack(np.meshgrid(*[random.uniform(-1, 1, 9)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    x = random.permutation(grid)
    alone = np.concatenate([evaluate(tensor, point[None]) for point in x])
    assert evaluate(tensor, x) == pytest.approx(alone, abs=1e-13)
    expected = sum(
        tensor[k] * np.prod([np.cos(j * np.arccos(t)) for j, t in zip(k, x[0], strict=True)])
        for k in np.ndindex(tensor.shape[:-1])
    )
    assert alone[0] == pytest.approx(expected, abs=1e-13)


def test_oscillation_beyond_the_node_limit_is_split():
    def fast(p):
        return np.cos(120 * p)

    domain = Domain(("x",), (0.0,), (2.0,), (identity("x"),), {})
    atlas = built(domain, fast)
    assert len(atlas.panels) >= 2 and holds(atlas, fast, domain)
    assert sum(float(p.upper[0] - p.lower[0]) for p in atlas.panels) == pytest.approx(2.0, rel=1e-12)


def kinked(p):
    x, y = p.T
    return (np.abs(x - 0.3) * np.cos(y))[:, None]


def stepped(p):
    x, y = p.T
    return (np.where(x > 0.3, 1.0, 0.0) + np.sin(x + y))[:, None]


@pytest.mark.parametrize("function", [kinked, stepped])
def test_a_function_that_is_not_smooth_leaves_gaps(function):
    atlas = built(SQUARE, function, 1e-8)
    assert atlas.gaps and atlas.panels and atlas.solves < 30_000
    assert all("not resolved" in gap.reason and gap.lower[0] <= 0.3 <= gap.upper[0] for gap in atlas.gaps)
    points = sample(SQUARE)
    found, bound = values(atlas, points)
    known = np.isfinite(found[:, 0])
    assert 0.9 < known.mean() < 1 and (np.isfinite(bound) == known).all()
    assert np.abs(found - function(points))[known].max() < 1e-7


def test_failed_solves_leave_a_gap():
    def partial(p):
        out = waves(p)
        out[(p[:, 0] > 1.5) & (p[:, 1] > 2.0)] = np.nan
        return out

    atlas = built(SQUARE, partial, 1e-8)
    assert atlas.panels and atlas.gaps
    assert all("solves failed" in gap.reason for gap in atlas.gaps)
    assert all(gap.upper[0] > 1.5 and gap.upper[1] > 2.0 for gap in atlas.gaps)
    everywhere = built(SQUARE, lambda p: np.full((len(p), 2), np.nan), 1e-8)
    assert not everywhere.panels and len(everywhere.gaps) == 1


def test_a_gap_names_noise_above_the_tolerance():
    rng = np.random.default_rng(0)
    atlas = built(SQUARE, lambda p: waves(p) + 1e-9 * rng.standard_normal((len(p), 2)), 1e-12)
    assert not atlas.panels and "scatter" in atlas.gaps[0].reason and atlas.solves < 1000


def test_limit_of_solves_is_kept():
    atlas = built(SQUARE, waves, max_solves=200)
    assert atlas.solves <= 200 and "more than 200 solves" in atlas.gaps[0].reason


def on_grid(function):
    """The values of a function of parameters on grids of coordinates."""

    def values_at(axes):
        x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return function(SQUARE.points(x))

    return values_at


def test_only_held_out_points_are_solved_where_nodes_are_given():
    atlas = built(SQUARE, waves, grid=on_grid(waves))
    assert holds(atlas, waves) and atlas.solves == 64 and max(atlas.panels[0].degrees) < 70


@pytest.mark.parametrize("factor", [1 + 1e-6, np.nan])
def test_nodes_that_differ_from_solves_are_not_used(factor):
    atlas = built(SQUARE, waves, grid=on_grid(lambda p: factor * waves(p)))
    assert holds(atlas, waves) and atlas.solves > 64


def test_bounds_include_the_error_that_all_solves_report():
    def solved(x):
        points = SQUARE.points(x)
        return (1 + 1e-7) * waves(points), 2e-7 * np.linalg.norm(waves(points), axis=1)

    largest = lambda values: np.full(len(values), np.linalg.norm(values, axis=1).max())  # noqa: E731
    assert holds(construct(SQUARE, Function(solved, largest), TOLERANCE), waves, limit=1e-6)


def test_even_coordinate_folds_the_domain():
    even = Coordinate("x^2", np.square, np.sqrt, lambda x: 2 * np.asarray(x), even=True)
    domain = Domain(("x",), (-1.0,), (3.0,), (even,), {})
    atlas = built(domain, np.cos, 1e-11)
    assert atlas.panels[0].lower == 0.0 and atlas.panels[0].upper == 9.0 and holds(atlas, np.cos, domain)


def test_arrays_and_back():
    atlas = built(SQUARE, waves)
    arrays = to_arrays(atlas)
    again = from_arrays(arrays, atlas.parameters, atlas.coordinates, {}, TOLERANCE, atlas.solves)
    assert len(arrays["coefficients"]) < sum(np.prod(panel.degrees) for panel in atlas.panels)
    for a, b in zip(atlas.panels, again.panels, strict=True):
        assert np.array_equal(a.coefficients, b.coefficients) and a.value_error == b.value_error
        assert a.proved_error == b.proved_error == np.inf
    assert np.array_equal(values(again, sample(SQUARE))[0], values(atlas, sample(SQUARE))[0])


def test_slice_outside_the_domain_is_refused():
    atlas = built(SQUARE, waves, 1e-6)
    with pytest.raises(KeyError, match="z"):
        atlas.slice({"z": 1.0})
    with pytest.raises(ValueError, match=r"x = 5\.0: expected -1 to 2"):
        atlas.slice({"x": 5.0})
