"""Numbers of polynomials and truncation errors that are known beforehand, and nodes from power series."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drivetrain_jax.atlas import construction, floquet, interpolation
from drivetrain_jax.atlas.floquet import floquet_domain, series_nodes
from drivetrain_jax.atlas.panels import position
from drivetrain_jax.atlas.proof import polynomials_needed
from drivetrain_jax.systems import Coordinate, Smoothness
from drivetrain_jax.systems.cardan import SMOOTH
from tests.oracles.atlas_direct import BASE, CARDAN, cardan_atlas, direct_radius, random_points, solves

RANGES = {"beta": (0.0, 1.4), "Omega": (0.2, 2.0)}
NAMES = ("beta", "Omega", "zeta", "alpha", "mu", "gamma")


def balanced(x, middle):
    """ln |T Phi S| for coordinates ``x``, which may be complex, by another integrator and in another clock than the package.

    tan(chi) = sqrt(cos beta) tan(tau), with chi real.
    """
    s, zeta, alpha, mu, g = (x[name] for name in NAMES[1:])
    c = np.exp(-x["beta"])

    def field(chi, y):
        a, b = np.sin(chi) ** 2 + c * np.cos(chi) ** 2, np.cos(chi) ** 2 + c * np.sin(chi) ** 2
        w, eta = np.sqrt(c) / a, a / b
        f = zeta * np.array([[1 + alpha * eta**2, 0], [-2 * alpha * g * eta, alpha * g**2]])
        v = np.array([[1 + mu * eta**2, -mu * g * eta], [-mu * g * eta, mu * g**2]])
        return (s * w * np.block([[-f, np.eye(2)], [f.T @ f - v, -f.T]]) @ y.reshape(4, 4)).ravel()

    phi = solve_ivp(field, (0, np.pi / 2), np.eye(4, dtype=complex).ravel(), method="DOP853", rtol=1e-7, atol=1e-9).y[
        :, -1
    ]
    root_mu, typical = middle["mu"] ** 0.5, middle["gamma"] ** -0.5
    t, k, first = max(root_mu, 1) ** 0.5 / np.sqrt(c), (root_mu * typical) ** 0.5, (1 + root_mu**2) ** 0.25
    left, right = np.array([t, k, 1 / t, 1 / k]), np.array([1 / first, 1 / k, first, k])
    return np.log(np.linalg.norm(left[:, None] * phi.reshape(4, 4) * right))


@pytest.mark.parametrize("seed", range(12))
def test_growth_bounds_propagators_of_complex_coordinates(seed):
    """Each coordinate in turn is complex, also far from the real axis."""
    random = np.random.default_rng(seed)
    x = {
        "beta": random.uniform(0, 2.5),
        "Omega": 10 ** random.uniform(-0.3, 0.8),
        "zeta": random.choice([0.0, 10 ** random.uniform(-3, 0)]),
        **{name: 10 ** random.uniform(-1, 1) for name in ("alpha", "mu")},
        "gamma": 10 ** random.uniform(-1.5, 0.5),
    }
    middle = {"mu": 10 ** random.uniform(-1, 1), "gamma": 10 ** random.uniform(-1, 3)}
    name = NAMES[seed % len(NAMES)]
    if name == "beta":
        x[name] = random.uniform(-1, 2.5) + 1j * random.uniform(-3, 3)
    else:
        x[name] = x[name] * (random.uniform(-2, 2) + 1j * random.uniform(-2, 2))
    assert balanced(x, middle) <= SMOOTH.enclosure.growth(x, middle)


@pytest.mark.parametrize(
    ("ranges", "change"),
    [(RANGES, {}), ({"mu": (0.5, 4.0), "Omega": (0.4, 2.0)}, {"beta": 0.9}), ({"Omega": (0.1, 1.0)}, {"zeta": 0.05})],
)
def test_truncation_errors_lie_within_their_bound(ranges, change):
    """A coarse target, so that truncation exceeds rounding; against an interpolant of many more nodes."""
    fixed = {name: value for name, value in ({**BASE, "beta": 0.9} | change).items() if name not in ranges}
    domain, function = floquet._function(CARDAN, ranges, fixed, 1e-9, lambda points: points)
    box = domain.box()
    counts, bound = polynomials_needed(CARDAN, domain, 0.3, box.lower, box.upper)
    t = np.random.default_rng(1).uniform(-1, 1, (500, len(counts)))

    def interpolated(counts):
        axes = [box.place(interpolation.nodes(n), k) for k, n in enumerate(counts)]
        return interpolation.evaluate(interpolation.coefficients(function.grid(axes), counts), t)

    coarse, fine = interpolated(counts), interpolated([n + 24 for n in counts])
    error = np.linalg.norm(coarse - fine, axis=1).max()
    assert 1e-12 < error <= bound < 10


def test_held_out_points_lie_on_all_faces():
    for d in (1, 2, 3, 4):
        t = construction._held_out(d)
        assert len(t) == 64 and len(np.unique(t, axis=0)) == 64
        alone = t[(np.abs(t) == 1).sum(axis=1) == 1]
        assert all((alone[:, k] == end).any() for k in range(d) for end in (-1, 1)) or d == 1


@pytest.mark.full
def test_coefficients_on_a_face_lie_within_their_bounds():
    """The chart in whose face Omega = min the former bounds of a_1 to a_3, from points inside, were exceeded 2.7 times."""
    from drivetrain_jax.analysis.floquet import quartic

    ranges = {"beta": (0.0, 1.42082), "Omega": (0.26157, 1.43413), "mu": (0.13379, 5.44455)}
    fixed = {"zeta": 0.0038643, "gamma": 10.9676, "alpha": 1.0}
    stability = cardan_atlas(ranges, 1.386e-8, fixed)
    atlas = stability.atlas
    points = random_points(stability, 400, seed=4)
    points[:, 1] = atlas.lower[1]
    x = atlas.to_coordinates(points)
    (panel,) = atlas.panels
    found = interpolation.evaluate(panel.coefficients, position(panel, x)).T
    exact = solves({**fixed, **dict(zip(ranges, points.T, strict=True))}, 1e-13)[:, :16].T
    e, _, errors = quartic.invariants(quartic.blocks(found), panel.value_error)
    for value, error, true in zip(e, errors, quartic.invariants(quartic.blocks(exact))[0], strict=True):
        assert (np.abs(np.asarray(value) - np.asarray(true)) <= np.asarray(error)).all()


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
    axes = {"beta": np.array([0.2, 1.0, 1.3]), "Omega": 1 / np.linspace(1.0, 3.0, 20), "mu": np.array([0.5, 2.0])}
    ranges = {name: (float(axis.min()), float(axis.max())) for name, axis in axes.items()}
    found = {}
    for order in (("beta", "Omega", "mu"), ("mu", "beta", "Omega"), ("Omega", "mu", "beta")):
        domain = domain_of({name: ranges[name] for name in order})
        coordinates = [c.forward(axes[name]) for c, name in zip(domain.coordinates, order, strict=True)]
        values = series_nodes(CARDAN, domain, 1e-11).grid(coordinates).reshape(*map(len, coordinates), 16)
        found[order] = np.transpose(values, (*(order.index(name) for name in axes), 3))
    first, *others = found.values()
    assert all(other == pytest.approx(first, abs=1e-12) for other in others)


def test_a_coordinate_may_be_negative(monkeypatch):
    """The coordinate -1/Omega gives the same lines from their other ends."""
    axes = [np.array([0.3, 1.2]), np.linspace(0.5, 5.0, 20)]
    one = series_nodes(CARDAN, domain_of(RANGES), 1e-11).grid(axes)
    forward, inverse = (lambda x: -1 / np.asarray(x),) * 2
    turned = Coordinate("-1/Omega", forward, inverse, lambda x: 1 / np.asarray(x) ** 2)
    model = CARDAN.models["atlas"]
    smooth = replace(model.smooth, coordinates={**model.smooth.coordinates, "Omega": turned})
    monkeypatch.setitem(CARDAN.models, "atlas", replace(model, smooth=smooth))
    assert series_nodes(CARDAN, domain_of(RANGES), 1e-11).grid([axes[0], -axes[1]]) == pytest.approx(one, abs=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("series", ["mu", "zeta"])
def test_a_wrong_declaration_costs_time_but_no_accuracy(monkeypatch, series):
    """The matrix is proportional to neither."""
    model = CARDAN.models["atlas"]
    monkeypatch.setitem(CARDAN.models, "atlas", replace(model, smooth=Smoothness(model.smooth.coordinates, series)))
    ranges = {"beta": (0.0, 0.9), series: (0.1, 0.3) if series == "zeta" else (0.8, 1.5)}
    atlas = cardan_atlas(ranges, 1e-10, {**BASE, "Omega": 0.9})
    points = random_points(atlas, 300)
    assert atlas.atlas.solves > 64 and not atlas.atlas.gaps
    assert atlas.at(points)["spectral_radius"] == pytest.approx(direct_radius(atlas, points)[0], abs=1e-8)
