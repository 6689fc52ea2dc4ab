"""An atlas whose nodes come in lines from a source and whose held-out points are solved."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.effort import steps_needed
from drivetrain_jax.analysis.floquet.power_series import propagators_along
from drivetrain_jax.analysis.numerics.kernels import predicted
from drivetrain_jax.atlas import Domain, Quantity, construct, run, values_at
from drivetrain_jax.atlas import floquet as series_module
from drivetrain_jax.atlas.floquet import floquet_domain, series_nodes
from drivetrain_jax.systems import Coordinate, Series, Smoothness
from drivetrain_jax.systems._models import identity
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, direct_radius, random_points

TOLERANCE = 1e-9
SQUARE = Domain(("x", "s"), (-1.0, 1.0), (1.0, 30.0), (identity("x"), identity("s")), {})
WAVES = Quantity(2, derived=lambda values: values[:, :1] * values[:, 1:])


def waves(points):
    """A function that turns by some 20 rad along ``s``, and by a fraction of that along ``x``."""
    x, s = points[:, 0], points[:, -1]
    angle = s * (1 + 0.3 * np.sin(2 * x)) + (0.2 * points[:, 1:-1].sum(axis=1))
    return np.stack([np.cos(angle), np.exp(0.3 * x) * np.sin(angle)], axis=1)


class Lines:
    """A source that gives ``function`` along the last coordinate, and records the requested grids."""

    positions = 8

    def __init__(self, domain=SQUARE, function=waves, rate=1.3):
        self.domain, self.function, self.rate = domain, function, rate
        self.axis, self.asked = len(domain.parameters) - 1, []

    def radians(self, lower, upper):
        return self.rate * (upper[self.axis] - lower[self.axis]) / 2

    def start(self, axes):
        self.asked.append([len(axis) for axis in axes])
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return lambda: self.function(self.domain.points(grid))


def sample(domain=SQUARE, count=2000):
    lower, upper = np.array(domain.lower), np.array(domain.upper)
    return lower + (upper - lower) * np.random.default_rng(5).random((count, len(lower)))


def holds(atlas, function=waves, domain=SQUARE):
    """True if all points are covered, with errors within their bounds and the tolerance."""
    points = sample(domain)
    found, bound = values_at(atlas, points)
    error = np.linalg.norm(found - function(points), axis=1)
    return bool((error <= bound).all() and error.max() < TOLERANCE and bound.max() < 10 * TOLERANCE)


def test_only_held_out_points_are_solved_and_bounds_hold():
    source = Lines()
    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=source), waves)
    alone = run(construct(SQUARE, WAVES, TOLERANCE), waves)
    assert holds(atlas) and atlas.solves == 64 < alone.solves / 10
    # Both atlases interpolate the same function, and drop negligible coefficients.
    assert atlas.panels[0].degrees == pytest.approx(alone.panels[0].degrees, abs=4)
    assert all(count[1] % 8 == 0 for count in source.asked)


def test_a_tensor_grows_where_it_is_not_resolved():
    """The function turns twice as fast along the lines as the source predicts, and needs more than 32 nodes along x."""

    def faster(points):
        return waves(points * [1.0, 2.0])

    source = Lines(function=faster)
    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=source), faster)
    first, *_, last = source.asked
    assert holds(atlas, faster) and atlas.solves == 64 and len(source.asked) <= 5
    assert last[1] > first[1] and last[0] > first[0] == 32


def test_lines_that_turn_too_far_are_halved_first():
    domain = replace(SQUARE, lower=(-0.1, 1.0), upper=(0.1, 250.0))
    source = Lines(domain)
    atlas = run(construct(domain, WAVES, TOLERANCE, source=source), waves)
    assert holds(atlas, domain=domain) and len(atlas.panels) == 2
    # Two corners belong to both panels.
    assert atlas.solves == 126
    assert all(source.rate * np.ptp([panel.lower[1], panel.upper[1]]) / 2 < 128 for panel in atlas.panels)
    assert len(source.asked) <= 6


@pytest.mark.parametrize("rate", [np.inf, np.nan, 1e5])
def test_lines_with_too_many_boxes_are_solved(rate):
    source = Lines(rate=rate)
    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=source), waves)
    assert holds(atlas) and not source.asked


def test_many_coordinates_are_probed_along_the_edges_first():
    domain = Domain(
        ("x", "y", "z", "s"),
        (-1.0, 0.0, 0.0, 1.0),
        (1.0, 1.0, 5.0, 9.0),
        tuple(map(identity, ("x", "y", "z", "s"))),
        {},
    )
    source = Lines(domain)
    atlas = run(construct(domain, WAVES, TOLERANCE, source=source), waves)
    points = sample(domain)
    found, bound = values_at(atlas, points)
    error = np.linalg.norm(found - waves(points), axis=1)
    assert (error <= bound).all() and error.max() < TOLERANCE and atlas.solves == 64
    *probes, tensor = source.asked
    assert [sorted(count[:3]) for count in probes] == [[2, 2, 64]] * 3
    assert tensor[:3] == pytest.approx(atlas.panels[0].degrees[:3], abs=4)


@pytest.mark.parametrize("domain", [SQUARE, replace(SQUARE, lower=(0.3, 1.0), upper=(0.3, 30.0))], ids=["wide", "thin"])
def test_nodes_that_differ_from_solves_are_not_used(domain):
    """Held-out points show nodes with a relative error of a millionth; all nodes are then solved instead."""
    source = Lines(domain, lambda points: (1 + 1e-6) * waves(points))
    atlas = run(construct(domain, WAVES, TOLERANCE, source=source), waves)
    assert holds(atlas, domain=domain) and not atlas.gaps and atlas.solves > 64


def test_lines_without_values_are_solved():
    source = Lines(function=lambda points: np.where(points[:, 1:] > 24, np.nan, waves(points)))
    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=source), waves)
    assert holds(atlas) and not atlas.gaps


def test_boxes_are_halved_down_to_a_kink_which_is_a_gap():
    def kinked(points):
        return waves(points) + np.abs(points[:, :1] - 0.37)

    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=Lines(function=kinked), max_solves=20_000), kinked)
    points = sample()
    found, bound = values_at(atlas, points)
    covered = np.isfinite(bound)
    assert (np.linalg.norm(found - kinked(points), axis=1)[covered] <= bound[covered]).all() and covered.mean() > 0.99
    assert all(gap.lower[0] <= 0.37 <= gap.upper[0] and gap.upper[0] - gap.lower[0] < 1e-3 for gap in atlas.gaps)
    assert atlas.gaps and not np.isfinite(values_at(atlas, np.array([[0.37, 7.0]]))[1]).any()


@pytest.mark.parametrize("told", [True, False])
def test_bounds_include_the_common_error_of_all_solves(told):
    """Nodes and solves have the same error, which held-out points cannot show, but which solves may report."""

    def off(points):
        return (1 + 1e-7) * waves(points)

    def solve(points):
        return np.concatenate([off(points), 2 * (waves(points) - off(points))], axis=1) if told else off(points)

    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=Lines(function=off)), solve)
    points = sample()
    exact = waves(points)
    found, bound = values_at(atlas, points)
    derived = np.array([atlas.panels[k].derived_error[0] for k in atlas.find(atlas.to_coordinates(points))])
    held = np.linalg.norm(found - exact, axis=1) <= bound
    derived_held = np.abs(WAVES.derived(found) - WAVES.derived(exact))[:, 0] <= derived
    assert not atlas.gaps and bound.max() < 4e-6 and derived.max() < 4e-6 and atlas.solves == 64
    assert held.all() == derived_held.all() == told


def test_solves_that_fail_leave_gaps():
    lost = run(construct(SQUARE, WAVES, TOLERANCE, source=Lines()), lambda points: np.nan * waves(points))
    assert not lost.panels and all("direct solves failed" in gap.reason for gap in lost.gaps)

    def partly(points):
        return np.where(points[:, 1:] > 24, np.nan, waves(points))

    atlas = run(construct(SQUARE, WAVES, TOLERANCE, source=Lines()), partly)
    covered = np.isfinite(values_at(atlas, points := sample())[1])
    assert atlas.panels and atlas.gaps and (points[~covered, 1] > 22).all() and covered.mean() > 0.7


RANGES = {"beta": (0.0, 1.4), "Omega": (0.2, 2.0)}


def domain_of(ranges, **change):
    fixed = {name: value for name, value in {**BASE, **change}.items() if name not in ranges}
    return floquet_domain(CARDAN, ranges, fixed)


@pytest.mark.parametrize(
    ("ranges", "change", "tolerance", "given"),
    [
        (RANGES, {}, 1e-11, True),
        ({"Omega": (0.2, 2.0), "beta": (-1.0, 1.0)}, {}, 1e-9, True),
        (RANGES, {}, 1e-13, False),
        ({"beta": (0.0, 1.4), "mu": (1.0, 2.0)}, {"Omega": 0.5}, 1e-11, False),
        (RANGES, {"zeta": 30.0}, 1e-11, False),
    ],
)
def test_nodes_come_from_series_where_rounding_and_speed_allow(ranges, change, tolerance, given):
    assert (series_nodes(CARDAN, domain_of(ranges, **change), tolerance) is not None) == given


def test_grid_is_in_c_order_for_any_order_of_parameters():
    axes = {"beta": np.array([0.2, 1.0, 1.3]), "Omega": 1 / np.linspace(1.0, 3.0, 48), "mu": np.array([0.5, 2.0])}
    ranges = {name: (float(axis.min()), float(axis.max())) for name, axis in axes.items()}
    found = {}
    for order in (("beta", "Omega", "mu"), ("mu", "beta", "Omega"), ("Omega", "mu", "beta")):
        domain = domain_of({name: ranges[name] for name in order})
        coordinates = [c.forward(axes[name]) for c, name in zip(domain.coordinates, order, strict=True)]
        values = series_nodes(CARDAN, domain, 1e-11).start(coordinates)().reshape(*map(len, coordinates), 16)
        found[order] = np.transpose(values, (*(order.index(name) for name in axes), 3))
    first, *others = found.values()
    assert all(other == pytest.approx(first, abs=1e-12) for other in others)


def test_a_coordinate_may_be_negative(monkeypatch):
    """The coordinate -1/Omega gives the same lines from their other ends."""
    axes = [np.array([0.3, 1.2]), np.linspace(0.5, 5.0, 48)]
    one = series_nodes(CARDAN, domain_of(RANGES), 1e-11)
    forward, inverse = (lambda x: -1 / np.asarray(x),) * 2
    turned = Coordinate("-1/Omega", forward, inverse, lambda x: 1 / np.asarray(x) ** 2)
    model = CARDAN.models["atlas"]
    smooth = replace(model.smooth, coordinates={**model.smooth.coordinates, "Omega": turned})
    monkeypatch.setitem(CARDAN.models, "atlas", replace(model, smooth=smooth))
    other = series_nodes(CARDAN, domain_of(RANGES), 1e-11)
    ends = np.array([[0.3, 0.5], [1.2, 3.0]])
    assert other.radians(*(ends[::-1] * [1.0, -1.0])) == pytest.approx(one.radians(*ends), rel=1e-12)
    assert other.start([axes[0], -axes[1]])() == pytest.approx(one.start(axes)(), abs=1e-12)


@pytest.mark.full
def test_parts_by_predicted_steps_are_short_enough():
    """Random shafts with the number of parts of an atlas are compared with three times as many parts."""
    lanes, random = 16, np.random.default_rng(1)
    columns = {
        "beta": random.uniform(0.0, 1.55, lanes),
        **{name: 10 ** random.uniform(-1, 1.3, lanes) for name in ("alpha", "mu", "gamma")},
        "zeta": 10 ** random.uniform(-4, -1, lanes),
    }
    omega, build = 0.1, CARDAN.models["floquet"].build
    decay = predicted(series_module._stable_steps, (build,), columns | {"Omega": np.full(lanes, omega)})
    steps = steps_needed(CARDAN, columns | {"Omega": np.full(lanes, omega)}, series_module._STEPS_AT)
    parts = np.maximum(np.ceil(series_module._PARTS * steps), 1 + np.ceil(series_module._DECAY * decay))
    ends, x = jnp.array([np.inf, omega]), jnp.array([1.0, 0.7, -0.2])
    along = jax.jit(
        lambda parts: propagators_along(
            lambda value: build({**columns, "Omega": value}).reduced, ends, 2, lanes, parts, x
        )
    )
    for lane, count in enumerate(parts):
        found, exact = (np.asarray(along(jnp.int64(n))[0])[..., lane] for n in (count, 3 * count))
        assert np.abs(found - exact).max() < 1e-13 * np.abs(exact).max()


@pytest.mark.full
def test_lines_with_large_truncation_errors_are_computed_again(monkeypatch):
    monkeypatch.setattr(series_module, "_PARTS", 0.04)
    atlas = cardan_atlas(RANGES, 1e-11)
    points = random_points(atlas, 300)
    assert atlas.atlas.solves == 64 and not atlas.atlas.gaps
    assert atlas.at(points)["spectral_radius"] == pytest.approx(direct_radius(atlas, points)[0], abs=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("wrong", [Series("mu", first=2), Series("Omega", first=1), Series("zeta", first=2)])
def test_a_wrong_declaration_costs_time_but_no_accuracy(monkeypatch, wrong):
    """The propagator is not a power series in mu, has other entries without 1/Omega, or is quadratic in zeta."""
    model = CARDAN.models["atlas"]
    smooth = Smoothness(model.smooth.coordinates, series=wrong)
    monkeypatch.setitem(CARDAN.models, "atlas", replace(model, smooth=smooth))
    ranges = {"beta": (0.0, 0.9), wrong.parameter: (0.1, 0.3) if wrong.parameter == "zeta" else (0.8, 1.5)}
    fixed = {**BASE, "Omega": 0.9}
    atlas = cardan_atlas(ranges, 1e-10, fixed)
    points = random_points(atlas, 300)
    assert atlas.atlas.solves > 64 and not atlas.atlas.gaps
    assert atlas.at(points)["spectral_radius"] == pytest.approx(direct_radius(atlas, points)[0], abs=1e-8)
