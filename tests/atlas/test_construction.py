"""Construction of atlases of known functions: rounds, panels, splits, and functions that are not smooth."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas import Domain, Quantity, construct, from_arrays, run, to_arrays, values_at
from drivetrain_jax.systems import Coordinate
from drivetrain_jax.systems._models import identity

TOLERANCE = 1e-10
SQUARE = Domain(("x", "y"), (-1.0, 0.5), (2.0, 3.0), (identity("x"), identity("y")), {})


def values(atlas, points):
    return values_at(atlas, points)[0]


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


def test_smooth_function_is_met_within_tolerance_and_bounds():
    atlas = run(construct(SQUARE, Quantity(2), TOLERANCE), waves)
    points = sample(SQUARE)
    error = np.linalg.norm(values(atlas, points) - waves(points), axis=1)
    assert len(atlas.panels) == 1 and not atlas.gaps
    assert error.max() < TOLERANCE and error.max() < atlas.panels[0].value_error < 100 * TOLERANCE
    assert 64 < atlas.solves < 4000


def test_determinant_over_frequency_and_support_stiffness():
    stiffness = Coordinate("ln k", np.log, np.exp, lambda k: 1 / np.asarray(k))
    domain = Domain(("q", "k"), (0.5, 0.1), (12.0, 50.0), (identity("q"), stiffness), {})
    atlas = run(construct(domain, Quantity(1), TOLERANCE), beam)
    points = sample(domain)
    largest = np.abs(beam(points)).max()
    assert not atlas.gaps and np.abs(values(atlas, points) - beam(points)).max() < TOLERANCE * largest


def test_one_three_and_four_parameters():
    def f(p):
        return np.stack([np.cos(p.sum(axis=1)), np.exp(-p.prod(axis=1))], axis=1)

    for d, tolerance in ((1, 1e-12), (3, 1e-8), (4, 1e-6)):
        names = tuple("abcd"[:d])
        domain = Domain(names, (0.0,) * d, (1.0,) * d, tuple(map(identity, names)), {})
        atlas = run(construct(domain, Quantity(2), tolerance), f)
        points = sample(domain, 500)
        assert np.linalg.norm(values(atlas, points) - f(points), axis=1).max() < 2 * tolerance
        if d > 1:
            slice_ = atlas.slice({"b": 0.3})
            rest = np.delete(points, 1, axis=1)
            points[:, 1] = 0.3
            assert slice_.parameters == (names[0], *names[2:]) and slice_.fixed == {"b": 0.3}
            assert np.abs(values(slice_, rest) - values(atlas, points)).max() < 1e-13


def test_rounds_are_deterministic_and_request_no_point_twice():
    def questions():
        asked, rounds = [], construct(SQUARE, Quantity(2), TOLERANCE, max_nodes=20)
        points = next(rounds)
        while True:
            asked.append(points)
            try:
                points = rounds.send(waves(points))
            except StopIteration as end:
                return asked, end.value

    (first, atlas), (second, again) = questions(), questions()
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    everything = np.concatenate(first)
    assert len(np.unique(everything, axis=0)) == len(everything) == atlas.solves
    # Panels no larger than allowed tile the square.
    assert len(atlas.panels) > 1 and max(max(p.degrees) for p in atlas.panels) <= 30
    area = sum(np.prod(p.upper - p.lower) for p in atlas.panels)
    assert area == pytest.approx(7.5, rel=1e-12)
    assert all(np.array_equal(a.coefficients, b.coefficients) for a, b in zip(atlas.panels, again.panels, strict=True))


def test_oscillation_beyond_the_node_limit_is_split():
    def fast(p):
        return np.cos(120 * p)

    domain = Domain(("x",), (0.0,), (2.0,), (identity("x"),), {})
    atlas = run(construct(domain, Quantity(1), 1e-10), fast)
    points = sample(domain)
    assert len(atlas.panels) >= 2 and not atlas.gaps
    assert np.abs(values(atlas, points) - fast(points)).max() < 1e-10


def kinked(p):
    x, y = p.T
    return (np.abs(x - 0.3) * np.cos(y))[:, None]


def stepped(p):
    x, y = p.T
    return (np.where(x > 0.3, 1.0, 0.0) + np.sin(x + y))[:, None]


@pytest.mark.parametrize("function", [kinked, stepped])
def test_gap_of_a_function_that_is_not_smooth_is_solved_directly(function):
    atlas = run(construct(SQUARE, Quantity(1), 1e-8), function)
    assert atlas.gaps and atlas.panels and atlas.solves < 20_000
    # The gaps contain the kink and are small compared with the domain.
    assert all("not smooth" in gap.reason and gap.lower[0] <= 0.3 <= gap.upper[0] for gap in atlas.gaps)
    points = sample(SQUARE)
    found, bound = values_at(atlas, points)
    known = np.isfinite(found[:, 0])
    assert 0.5 < known.mean() < 1 and (np.isfinite(bound) == known).all()
    asked = []

    def solve(p):
        asked.append(p)
        return function(p)

    everything, bound = values_at(atlas, points, solve)
    assert len(asked) == 1 and len(asked[0]) == (~known).sum()
    assert np.abs(everything - function(points)).max() < 1e-7 and np.array_equal(everything[known], found[known])
    assert (bound[~known] == 0).all()


def test_an_atlas_may_consist_of_gaps():
    def rough(p):
        return np.sign(np.sin(40 * p[:, :1])) * np.sign(np.sin(40 * p[:, 1:]))

    atlas = run(construct(SQUARE, Quantity(1), 1e-8), rough)
    assert not atlas.panels and atlas.gaps
    assert all("not smooth" in gap.reason for gap in atlas.gaps)
    points = sample(SQUARE, 50)
    with pytest.raises(ValueError, match="not smooth"):
        values_at(atlas, points)
    assert np.array_equal(values_at(atlas, points, rough)[0], rough(points))


def test_failed_solves_leave_a_gap():
    def partial(p):
        out = waves(p)
        out[(p[:, 0] > 1.5) & (p[:, 1] > 2.0)] = np.nan
        return out

    atlas = run(construct(SQUARE, Quantity(2), 1e-8), partial)
    assert atlas.panels and atlas.gaps
    assert all("solves failed" in gap.reason for gap in atlas.gaps)
    assert all(gap.upper[0] > 1.5 and gap.upper[1] > 2.0 for gap in atlas.gaps)
    everywhere = run(construct(SQUARE, Quantity(2), 1e-8), lambda p: np.full((len(p), 2), np.nan))
    assert not everywhere.panels and len(everywhere.gaps) == 1


def test_a_gap_names_noise_above_the_tolerance():
    rng = np.random.default_rng(0)
    atlas = run(construct(SQUARE, Quantity(2), 1e-12), lambda p: waves(p) + 1e-9 * rng.standard_normal((len(p), 2)))
    assert not atlas.panels and "scatter" in atlas.gaps[0].reason


def test_limit_of_solves_is_kept():
    atlas = run(construct(SQUARE, Quantity(2), TOLERANCE, max_solves=200), waves)
    assert atlas.solves <= 200 and "more than 200 solves" in atlas.gaps[0].reason


def test_even_coordinate_folds_the_domain():
    even = Coordinate("x^2", np.square, np.sqrt, lambda x: 2 * np.asarray(x), even=True)
    domain = Domain(("x",), (-1.0,), (3.0,), (even,), {})
    atlas = run(construct(domain, Quantity(1), 1e-11), np.cos)
    points = sample(domain)
    assert atlas.panels[0].lower == 0.0 and atlas.panels[0].upper == 9.0
    assert np.abs(values(atlas, points) - np.cos(points)).max() < 1e-11


def test_arrays_and_back():
    atlas = run(construct(SQUARE, Quantity(2), TOLERANCE, max_nodes=20), waves)
    arrays = to_arrays(atlas)
    again = from_arrays(arrays, atlas.parameters, atlas.coordinates, {}, TOLERANCE, atlas.solves)
    assert len(arrays["coefficients"]) < sum(np.prod(panel.degrees) for panel in atlas.panels)
    for a, b in zip(atlas.panels, again.panels, strict=True):
        assert np.array_equal(a.coefficients, b.coefficients) and a.value_error == b.value_error
    assert np.array_equal(values(again, sample(SQUARE)), values(atlas, sample(SQUARE)))


def test_slice_outside_the_domain_is_refused():
    atlas = run(construct(SQUARE, Quantity(2), 1e-6), waves)
    with pytest.raises(KeyError, match="z"):
        atlas.slice({"z": 1.0})
    with pytest.raises(ValueError, match=r"x = 5\.0: allowed is -1 to 2"):
        atlas.slice({"x": 5.0})


def test_function_beyond_the_range_of_numbers_ends_as_gaps():
    """No coefficient is small enough relative to the smallest values."""

    def solve(points):
        return np.exp(-1 / points)

    coordinate = Coordinate("x", np.asarray, np.asarray, lambda x: np.ones_like(np.asarray(x, float)))
    domain = Domain(("x",), (5e-4,), (0.1,), (coordinate,), {})
    norm = Quantity(1, lambda values: np.sqrt(np.sum(values**2, axis=1)))
    atlas = run(construct(domain, norm, 1e-11), solve)
    assert len(atlas.gaps) and atlas.solves < 5_000
