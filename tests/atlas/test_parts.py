"""An atlas of propagators from their parts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.atlas_direct import BASE, CARDAN, propagators, solves
from drivetrain_jax import InputError
from drivetrain_jax.analysis import Request, get_analysis
from drivetrain_jax.analysis.periodic import floquet_propagator
from drivetrain_jax.atlas import Domain, Quantity, construct, run, span_parts, values_at
from drivetrain_jax.atlas.construction import construct_from_parts
from drivetrain_jax.atlas.decay import foreseen, needed, remainder
from drivetrain_jax.atlas.parts import Product, product
from drivetrain_jax.sweep.scene import load_scene
from drivetrain_jax.systems._smooth import identity

COUNT, TOLERANCE = 8, 1e-9
DOMAIN = Domain(("s", "x"), (1.0, -1.0), (30.0, 1.0), (identity("s"), identity("x")), {})
WHOLE = Quantity(4)


def parts(points):
    """Turns by ``s (phi_(k+1) - phi_k)``, stretched in one direction and the other by turns, so that they do not commute."""
    s, x = points.T
    ends = [
        k / COUNT * (1 + 0.5 * np.sin(x)) + 0.02 * np.sin(np.pi * k / COUNT) * np.cos(3 * x) for k in range(COUNT + 1)
    ]
    found = []
    for k, (start, stop) in enumerate(pairwise(ends)):
        angle, stretch = s * (stop - start), 1.5 if k % 2 else 0.8
        found += [np.cos(angle), stretch * np.sin(angle), -np.sin(angle) / stretch, np.cos(angle)]
    return np.stack(found, axis=1)


def whole(points):
    return product(parts(points), COUNT)


def sample(count=2000):
    lower, upper = np.array(DOMAIN.lower), np.array(DOMAIN.upper)
    return lower + (upper - lower) * np.random.default_rng(5).random((count, 2))


def errors(atlas, points):
    found, bound = values_at(atlas, points)
    return np.linalg.norm(found - whole(points), axis=1), bound


def test_the_last_part_stands_on_the_left():
    shear, turn = [1.0, 1.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]
    assert product(np.array([shear + turn]), 2)[0].tolist() == [0.0, 1.0, -1.0, -1.0]


def test_parts_take_fewer_solves_and_bounds_hold():
    atlas = run(construct_from_parts(DOMAIN, WHOLE, COUNT, TOLERANCE), parts)
    alone = run(construct(DOMAIN, WHOLE, TOLERANCE), whole)
    error, bound = errors(atlas, sample())
    assert not atlas.gaps and (error <= bound).all() and error.max() < TOLERANCE and bound.max() < 10 * TOLERANCE
    assert 2 * atlas.solves < alone.solves
    # What is interpolated in the end is the same function.
    assert atlas.panels[0].degrees == pytest.approx(alone.panels[0].degrees, abs=3)


def test_parts_of_which_only_the_product_is_smooth_are_not_used():
    """Each part in coordinates of its own that jump from point to point: their product is none the wiser."""

    def rough(points):
        random = np.random.default_rng(np.abs(points.view(np.int64)).sum() % 2**32)
        matrices = parts(points).reshape(-1, COUNT, 2, 2)
        for k in range(COUNT - 1):
            turn = np.eye(2) + 1e-3 * random.standard_normal((len(points), 2, 2))
            matrices[:, k] = turn @ matrices[:, k]
            matrices[:, k + 1] = matrices[:, k + 1] @ np.linalg.inv(turn)
        return matrices.reshape(len(points), -1)

    atlas = run(construct_from_parts(DOMAIN, WHOLE, COUNT, TOLERANCE), rough)
    error, bound = errors(atlas, sample())
    assert not atlas.gaps and (error <= bound).all() and error.max() < TOLERANCE


def test_what_no_solve_reaches_stays_a_gap():
    def lost(points):
        return np.where(points[:, :1] > 24, np.nan, parts(points))

    atlas = run(construct_from_parts(DOMAIN, WHOLE, COUNT, TOLERANCE), lost)
    assert atlas.panels and atlas.gaps and all("solves failed" in gap.reason for gap in atlas.gaps)
    points = sample()
    error, bound = errors(atlas, points)
    covered = np.isfinite(bound)
    assert (error[covered] <= bound[covered]).all() and (points[~covered, 0] > 22).all() and covered.mean() > 0.7


def test_held_out_points_see_a_wrong_product(monkeypatch):
    """Nodes a millionth off are not accepted: they are solved instead."""
    on_grid = Product.on_grid
    monkeypatch.setattr(Product, "on_grid", lambda self, axes: (1 + 1e-6) * on_grid(self, axes))
    atlas = run(construct_from_parts(DOMAIN, WHOLE, COUNT, TOLERANCE), parts)
    error, bound = errors(atlas, sample())
    assert not atlas.gaps and (error <= bound).all() and error.max() < TOLERANCE


def test_the_solver_gives_the_parts_of_what_it_solves():
    columns = {**BASE, "beta": np.array([0.3, 1.4, 1.2]), "Omega": np.array([1.0, 0.3, 0.06])}
    exact = propagators(columns, 1e-13)
    for rtol in (1e-9, 1e-13):
        solved = solves(columns, rtol, 8)
        error = np.linalg.norm(product(solved[:, :-16], 8) - exact, axis=1)
        assert error == pytest.approx(0.0, abs=30 * rtol + 1e-12)
        assert (error <= np.linalg.norm(solved[:, -16:], axis=1) + 1e-12).all()
    stiff = {**BASE, "zeta": 20.0, "beta": np.array([0.5]), "Omega": np.array([0.2])}
    found = product(propagators(stiff, 1e-11, 4), 4)
    assert found == pytest.approx(propagators(stiff, 1e-11), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("ranges", "change", "tolerance", "count"),
    [
        ({"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}, {}, 1e-11, 22),
        ({"beta": (0.0, 1.5), "Omega": (0.02, 2.0)}, {}, 1e-11, 32),
        ({"beta": (0.0, 0.2), "Omega": (5.0, 9.0)}, {}, 1e-9, 1),
        ({"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}, {}, 1e-13, 1),
        ({"beta": (0.0, 1.5), "Omega": (0.1, 2.0)}, {"zeta": 10.0}, 1e-11, 1),
    ],
)
def test_parts_by_the_slowest_corner_none_where_it_is_stiff_or_rounding_shows(ranges, change, tolerance, count):
    fixed = {name: value for name, value in {**BASE, **change}.items() if name not in ranges}
    assert span_parts(CARDAN, ranges, fixed, tolerance) == count


def test_a_tail_of_rounding_leaves_nothing_out():
    falling = 10.0 ** -np.arange(12.0)
    assert remainder(falling, 1e-9) == pytest.approx(1e-10 / 99, rel=1e-9)
    flat = np.concatenate([falling, np.full(6, 1e-13)])
    assert remainder(flat, 1e-9) == 1e-13 and remainder(flat, 1e-12) == np.inf


def test_all_solves_failing_leaves_one_gap():
    atlas = run(construct_from_parts(DOMAIN, WHOLE, COUNT, TOLERANCE), lambda points: np.nan * parts(points))
    assert not atlas.panels and all("direct solves failed" in gap.reason for gap in atlas.gaps)


@pytest.mark.parametrize("told", [True, False])
def test_bounds_include_what_all_solves_are_wrong_by(told):
    """Every part a little too long, which no held-out point can show, but the solves know it of the product."""
    wrong = (1 + 1e-7) ** (1 / COUNT)

    def off(points):
        values = wrong * parts(points)
        return np.concatenate([values, 2 * (whole(points) - product(values, COUNT))], axis=1) if told else values

    quantity = Quantity(4, derived=lambda values: values[:, :1] * values[:, 3:])
    atlas = run(construct_from_parts(DOMAIN, quantity, COUNT, TOLERANCE), off)
    points = sample()
    exact = whole(points)
    found, bound = values_at(atlas, points)
    held = np.linalg.norm(found - exact, axis=1) <= bound
    derived = np.array([atlas.panels[k].derived_error[0] for k in atlas.find(atlas.to_coordinates(points))])
    derived_held = np.abs(quantity.derived(found) - quantity.derived(exact))[:, 0] <= derived
    assert not atlas.gaps and bound.max() < 4e-6 and derived.max() < 4e-6
    assert (held.all(), derived_held.all()) == (told, told)


def test_a_little_more_than_a_line_shows_is_foreseen():
    """Of a geometric fall exactly, of a faster one not below; not of a kink, of noise or of what is far away."""
    geometric = 0.2 ** np.arange(17.0)
    assert foreseen(geometric, 0.2**20.5) == 21 == needed(0.2 ** np.arange(40.0), 0.2**20.5)
    assert foreseen(geometric, 0.2**30) is None
    assert foreseen(geometric, 0.2**10.5) == 11 == needed(geometric, 0.2**10.5)
    entire = np.cumprod(4 / np.arange(4.0, 44.0))
    assert (needed(entire, 1e-9), foreseen(entire[:17], 1e-9)) == (19, 20)
    assert (needed(entire, 1e-11), foreseen(entire[:17], 1e-11)) == (21, None)
    assert foreseen(1 / np.arange(1.0, 18.0) ** 2, 1e-4) is None
    assert foreseen(np.full(17, 1e-9), 1e-10) is None


def test_parts_are_an_option_of_the_propagator_and_of_no_scene():
    solves = floquet_propagator.ANALYSIS
    assert solves.methods == {"direct": ("rtol", "parts")} and [o.default for o in solves.options] == [1e-10, 1]
    scene = {
        "system": "cardan",
        "analysis": "atlas",
        "axes": {"beta": {"start": 0.0, "stop": 0.3}, "Omega": {"start": 1.3, "stop": 1.5}},
        "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0},
        "options": {"parts": 2},
    }
    with pytest.raises(InputError, match=r"^options.parts = 2: not used by method direct; allowed is method, rtol$"):
        load_scene(scene)
    atlas = get_analysis("atlas")
    assert len(atlas.solvers(CARDAN, Request(atlas.default_outputs, "direct", {"rtol": 1e-9}))) == 2
