"""Proved bounds and verdicts of an atlas are attacked: by exact values, by wrong panels, on faces and at the boundary."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.atlas import balls, proof
from drivetrain_jax.atlas.floquet import middle_of
from drivetrain_jax.systems import cardan_bounds, get_system
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, direct_radius, propagators, random_points
from tests.oracles.cardan_precise_reference import multipliers

RANGES = {"beta": (0.0, 1.2), "Omega": (0.3, 2.0)}


def proved(atlas):
    """The same atlas with the proved errors of its panels."""
    panels = tuple(replace(p, proved_error=proof.proved_error(atlas.atlas, p, CARDAN)[0]) for p in atlas.atlas.panels)
    return replace(atlas, atlas=replace(atlas.atlas, panels=panels))


@pytest.fixture(scope="module")
def chart():
    return proved(cardan_atlas(RANGES, 1e-10))


@pytest.fixture(scope="module")
def undamped_chart(undamped):
    return proved(undamped)


def polynomial(atlas, points):
    """The polynomial of the panel at points, and bounds of the norms of its errors there."""
    x, wrong = zip(*map(cardan_bounds._coordinate, atlas.atlas.parameters, points.T), strict=True)
    return proof._evaluated(atlas.atlas.panels[0], np.stack(x, axis=-1), np.stack(wrong, axis=-1))


def faces(atlas, count, seed=0):
    """Random points, points on all faces, and the corners."""
    points, ends = random_points(atlas, count, seed), np.stack([atlas.atlas.lower, atlas.atlas.upper])
    for i, (k, end) in enumerate(itertools.product(range(points.shape[1]), (0, 1))):
        points[i::8, k] = ends[end, k]
    return np.concatenate([points, np.array(list(itertools.product(*ends.T)))])


def test_ball_arithmetic_confirms_panels_and_refutes_wrong_ones(chart):
    pytest.importorskip("flint")
    points = random_points(chart, 1, seed=11)
    stated = chart.at(points)["verdict"]
    sharper = replace(chart.atlas, panels=tuple(replace(p, proved_error=1e-16) for p in chart.atlas.panels))
    assert balls.contradictions(chart.atlas, CARDAN, points, stated) == 0
    assert balls.contradictions(chart.atlas, CARDAN, points, 1 - stated) == 1
    assert balls.contradictions(sharper, CARDAN, points, stated) == 1


def test_nodes_integrate_polynomials():
    t, q, sums = cardan_bounds._tables()
    ends = np.append(t, 1.0)
    for n in range(len(t)):
        exact = (ends ** (n + 1) - (-1.0) ** (n + 1)) / (n + 1)
        assert q @ t**n == pytest.approx(exact, abs=4e-16)
    assert (np.diff(sums[2:]) < 0).all() and sums[1] >= np.abs(q).sum(axis=1).max()


@pytest.mark.parametrize("seed", range(8))
def test_rates_bound_the_matrix_on_ellipses(seed):
    """The matrix at complex points on the ellipses, and the derivatives of its terms on the parts."""
    random = np.random.default_rng(seed)
    given = {name: 10 ** random.uniform(-1, 1) for name in ("alpha", "mu", "gamma")}
    given["zeta"] = random.choice([0.0, 0.01, 1.0])
    lines = cardan_bounds._Lines(np.array([1.0, 10 ** random.uniform(-1.5, 0)]), given, 1.0, 6)
    k1, k2 = lines.scales
    balance = np.stack([k1, k2, 1 / k1, 1 / k2], axis=-1)
    for radius in (1.0, 1.3, 2.0, 4.6):
        bound, steep = lines.rates(radius)
        for angle in random.uniform(0, 2 * np.pi, 20):
            z = radius * np.exp(1j * angle)
            u = lines.middle + lines.half * (z + 1 / z) / 2
            matrix = balance[..., :, None] * lines.matrix(u) / balance[..., None, :]
            # Near a pole there is no bound, nor a finite matrix.
            assert (np.linalg.norm(matrix, 2, axis=(-2, -1)) <= bound).all()
        if radius == 1:
            (w, eta), (w1, eta1) = lines.clock(lines.middle), lines.clock(lines.middle + 1e-6 * lines.half)
            for k in range(5):
                change = np.abs(np.log(w1 * eta1**k / (w * eta**k))) / (1e-6 * lines.half)
                assert (change <= steep * (1 + 1e-3)).all()


@pytest.mark.parametrize("seed", range(4))
def test_propagators_lie_within_their_bounds(seed):
    """Against direct solves, whose errors are smaller than the bounds, for other parameters too."""
    random = np.random.default_rng(seed)
    given = {
        "zeta": random.choice([0.0, 1e-3, 0.03]),
        **{n: 10 ** random.uniform(-1, 1) for n in ("alpha", "mu", "gamma")},
    }
    beta, omega = random.uniform(0, 1.45, 5), random.uniform(0.3, 2, 6)
    phi, error = cardan_bounds.propagators(np.cos(beta), 1 / omega, given, given)
    columns = dict(zip(("Omega", "beta"), np.meshgrid(omega, beta, indexing="ij"), strict=True))
    exact = propagators({**given, **{n: x.ravel() for n, x in columns.items()}}, 1e-14).reshape(phi.shape)
    root_mu, g = given["mu"] ** 0.5, given["gamma"] ** -0.5
    t, k, first = max(root_mu, 1) ** 0.5 / np.cos(beta) ** 0.5, (root_mu * g) ** 0.5, (1 + given["mu"]) ** 0.25
    left = np.stack([t, 0 * t + k, 1 / t, 0 * t + 1 / k], axis=-1)
    balanced = left[:, :, None] * exact * np.array([1 / first, 1 / k, first, k])
    assert (np.linalg.norm(balanced - phi, axis=(2, 3)) <= error).all() and error.max() < 1e-10


def test_the_bound_holds_and_would_not_if_it_were_ten_times_smaller(chart):
    """A panel with one wrong coefficient, whose error is therefore known."""
    (panel,) = chart.atlas.panels
    assert panel.proved_error < 1e-10
    for place, wrong in (
        ((0, 0, 0), 1e-9),
        ((7, 11, 5), 1e-7),
        ((panel.degrees[0] - 1, panel.degrees[1] - 1, 3), 1e-3),
    ):
        coefficients = panel.coefficients.copy()
        coefficients[place] += wrong
        bound = proof.proved_error(chart.atlas, replace(panel, coefficients=coefficients), CARDAN)[0]
        assert wrong - panel.value_error <= bound < 10 * wrong


def test_coefficients_on_faces_lie_within_the_proved_bound(chart):
    """The coefficients e_k of p, against 60 digits; with an error of at most eps in Phi they are wrong by d_k."""
    points = faces(chart, 4, seed=1)
    phi, rounded = polynomial(chart, points)
    assert (rounded < 1e-11).all()
    z = proof._SWAP @ np.swapaxes(phi, 1, 2) @ proof._SWAP @ phi
    size, eps = np.linalg.norm(phi, axis=(1, 2)), chart.atlas.panels[0].proved_error + rounded
    for i, point in enumerate(points):
        sigma = multipliers({**BASE, "beta": point[0], "Omega": point[1]})
        for k, weight in ((1, 1.0), (2, 5.0), (3, 10.0)):
            exact = float(sum(np.prod(part) for part in itertools.combinations(sigma, k)).real)
            found = (-1) ** k * np.poly(z[i])[k].real
            allowed = weight * 2.1 * size[i] * eps[i] * np.linalg.norm(z[i]) ** (k - 1)
            # The truth is far nearer: rounding of the proof counts as if it always added up.
            assert abs(found - exact) < allowed / 10


def test_verdicts_agree_with_direct_solves(chart):
    """Random points, faces and corners, and points beside the boundary at all distances down to rounding."""
    points = faces(chart, 2000, seed=2)
    radius = chart.at(points)["spectral_radius"]
    inside, outside = points[radius < 1][:60], points[radius > 1][:60]
    for _ in range(45):
        middle = (inside + outside) / 2
        stable = (chart.at(middle)["spectral_radius"] < 1)[:, None]
        inside, outside = np.where(stable, middle, inside), np.where(stable, outside, middle)
        points = np.concatenate([points, middle[:10]])
    found, (radius, _) = proof.verdicts(chart.atlas, CARDAN, points), direct_radius(chart, points)
    sure = np.abs(radius - 1) > 1e-9
    assert (found[sure & (found != 2)] == (radius[sure & (found != 2)] > 1)).all()
    # At random points nearly nothing is open, at the boundary everything is.
    assert (found[:2000] == 2).mean() < 2e-3 and (proof.verdicts(chart.atlas, CARDAN, inside) == 2).mean() > 0.9


def test_the_nearest_decided_cells_are_decided_rightly(chart):
    """Against 30 digits: the decided points of a fine grid that are nearest to the boundary."""
    axes = np.linspace(0, 1.2, 150), np.linspace(0.3, 2, 300)
    points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=-1)
    found, radius = proof.verdicts(chart.atlas, CARDAN, points), chart.at(points)["spectral_radius"]
    decided = np.flatnonzero(found != 2)
    nearest = decided[np.argsort(np.abs(radius[decided] - 1))[:6]]
    for point, verdict in zip(points[nearest], found[nearest], strict=True):
        outside = max(abs(s) for s in multipliers({**BASE, "beta": point[0], "Omega": point[1]})) > 1
        assert verdict == outside


@pytest.mark.parametrize("size", [1e-11, 1e-8, 1e-5, 1e-2, 0.3])
def test_verdicts_allow_for_every_error_within_the_bound(chart, size):
    """Phi is changed by exactly the bound: no verdict may differ from the true one."""
    random, points = np.random.default_rng(3), faces(chart, 2000, seed=3)
    phi, _ = polynomial(chart, points)
    change = random.normal(size=phi.shape)
    # Half of the changes have rank one.
    change[::2] = random.normal(size=(len(change[::2]), 4, 1)) * random.normal(size=(len(change[::2]), 1, 4))
    change *= size / np.linalg.norm(change, axis=(1, 2))[:, None, None]
    log_d = proof._log_determinant(cardan_bounds.ENCLOSURE, chart.atlas, points)
    found = proof._verdict(phi + change, np.full(len(phi), size), log_d)
    truth = chart.at(points)["spectral_radius"] > 1
    assert (found[found != 2] == truth[found != 2]).all() and (size > 0.1 or (found != 2).any())


def test_without_damping_stable_means_distinct_multipliers_on_the_circle(undamped_chart):
    points = faces(undamped_chart, 2000, seed=4)
    found, known = proof.verdicts(undamped_chart.atlas, CARDAN, points), undamped_chart.at(points)["verdict"]
    decided = (found != 2) & (known != 2)
    assert (found[decided] == known[decided]).all() and decided.mean() > 0.95
    # At the angle 0 nothing is unstable, and multipliers that meet are open.
    assert not (found[points[:, 0] == 0] == 1).any()


@pytest.mark.full
@pytest.mark.parametrize(
    ("ranges", "fixed"),
    [
        ({"beta": (-0.7, 0.5), "Omega": (0.5, 2.0)}, BASE),
        ({"Omega": (0.2, 1.0)}, {**BASE, "beta": 0.8}),
        ({"beta": (0.0, 1.4)}, {**BASE, "Omega": 0.4, "zeta": 0.02}),
    ],
)
def test_other_domains_are_proved_too(ranges, fixed):
    chart = proved(cardan_atlas(ranges, 1e-10, fixed))
    assert all(panel.proved_error < 1e-10 for panel in chart.atlas.panels)
    points = faces(chart, 300)
    found, (radius, _) = proof.verdicts(chart.atlas, CARDAN, points), direct_radius(chart, points)
    assert (found != 2).mean() > 0.97 and (found[found != 2] == (radius > 1)[found != 2]).all()


def test_nothing_is_proved_where_the_proof_does_not_hold(chart):
    (panel,) = chart.atlas.panels
    other = replace(chart.atlas, parameters=("beta", "mu"))
    assert proof.proved_error(other, panel, CARDAN)[0] == np.inf
    assert proof.proved_error(chart.atlas, panel, get_system("tripod"))[0] == np.inf
    thin = replace(panel, lower=panel.upper * (1 - 1e-15))
    assert not proof.proved_error(chart.atlas, thin, CARDAN)[0] < 1
    strong = replace(chart.atlas, fixed={**chart.atlas.fixed, "zeta": 30.0})
    assert proof.proved_error(strong, panel, CARDAN)[0] == np.inf
    sliced = chart.slice({"Omega": 1.0})
    assert (proof.verdicts(sliced.atlas, CARDAN, np.array([[0.5], [0.9]])) == 2).all()
    # Beyond the box.
    assert (proof.verdicts(chart.atlas, CARDAN, np.array([[1.3, 1.0], [0.5, 2.1]])) == 2).all()


@pytest.mark.parametrize("value", [1e-300, 1e300])
@pytest.mark.parametrize("name", ["zeta", "alpha", "mu", "gamma", "Omega"])
def test_extreme_parameters_are_no_error(name, value):
    """A heavy driven disk is unstable: direct solves give a radius of 1.011413 for gamma from 1e8 to 1e300."""
    found = proof.verdict_at(CARDAN, {**BASE, "beta": 0.3, "Omega": 1.4, name: value})
    assert found == 1 if (name, value) == ("gamma", 1e300) else found in (0, 2)


def test_middles_determine_the_balance(chart):
    """T and S of the proof are those of the construction."""
    from drivetrain_jax.atlas.floquet import balanced_entries, floquet_domain

    domain, point = floquet_domain(CARDAN, RANGES, BASE), np.array([[0.7, 0.9]])
    phi = propagators({**BASE, "beta": 0.7, "Omega": 0.9}, 1e-14)
    expected = balanced_entries(CARDAN, domain, point, phi).reshape(4, 4)
    found, error = cardan_bounds.propagators(np.cos([0.7]), 1 / np.array([0.9]), BASE, middle_of(domain))
    assert np.linalg.norm(found[0, 0] - expected) <= error[0, 0] + 1e-13
