"""Without damping stable means bounded: all multipliers are simple and on the unit circle, by every method."""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy.special import mathieu_a, mathieu_b

import drivetrain_jax as dt
from drivetrain_jax.invariants import check
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves
from tests.sizes import full_after

OUTPUTS = ["spectral_radius", "spectral_radius_error", "verdict"]


class Mathieu(System):
    """``x'' + damping x' + (a - 2 q cos 2t) x = 0``."""

    name, title = "mathieu_without_damping", "Mathieu's equation"
    a: Any = parameter("1", "stiffness")
    q: Any = parameter("1", "excitation")
    damping: Any = parameter("1", "damping", default=0.0)

    def rows(self, t):
        return (0, 1.0), (2 * self.q * jnp.cos(2 * t) - self.a, -self.damping)

    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, math.pi)
        return FloquetModel(natural=form, reduced=form)


class TwoMasses(Mathieu):
    """Two pendulums, joined by a spring: ``x'' = -K(t) x``; ``twist`` makes K unsymmetric."""

    name = "two_masses_without_damping"
    twist: Any = parameter("1", "part of the coupling that is no spring", default=0.0)

    def rows(self, t):
        k = self.a - 2 * self.q * jnp.cos(2 * t)
        coupling = 0.3 + self.twist
        return (0, 0, 1.0, 0), (0, 0, 0, 1.0), (-k - 0.3, 0.3, -self.damping, 0), (coupling, -k - 0.3, 0, -self.damping)

    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, math.pi)
        return FloquetModel(natural=form, reduced=form)


A, Q = np.meshgrid(np.linspace(-0.9, 9.3, 18), np.linspace(0.2, 4.0, 6))


def bounded(a: np.ndarray, q: np.ndarray) -> np.ndarray:
    """True between the characteristic values of Mathieu's equation."""
    return np.any([(mathieu_a(n, q) < a) & (a < mathieu_b(n + 1, q)) for n in range(8)], axis=0)


@pytest.mark.parametrize("method", full_after(1, ["direct", "diffrax"]))
def test_an_ince_strutt_diagram_has_stable_regions(method):
    found = jax.vmap(lambda a, q: dt.floquet(Mathieu(a=a, q=q), outputs=OUTPUTS, method=method))(A.ravel(), Q.ravel())
    expected = bounded(A, Q).ravel()
    assert found.verdict.tolist() == (1 - expected).tolist() and 20 < expected.sum() < 88
    assert np.all(np.asarray(found.spectral_radius)[expected] == 1)


class Unregistered(dt.Cardan):
    """A subclass that inherits the name of its parent, which must not be solved in its place."""

    @serves("floquet")
    def floquet_model(self):
        return Mathieu(a=self.Omega, q=self.beta).floquet_model()


@pytest.mark.full
def test_a_class_that_is_not_installed_is_swept(tmp_path):
    shaft = Unregistered(beta=0.5, Omega=2.0, zeta=0.1, alpha=1.0, mu=1.0, gamma=1.0)
    outputs = ["spectral_radius", "verdict", "floquet_multiplier", "floquet_multiplier_error"]
    chart = dt.sweep(dt.floquet, shaft, over={"Omega": [1.0, 2.0]}, outputs=outputs, out=tmp_path / "chart.nc")
    assert chart.drivetrain.named().verdict.values.tolist() == ["unstable", "stable"]
    assert chart.verdict.attrs["long_name"] == "stability of the equilibrium"
    assert set(chart.data_vars) == {*outputs, "outcome"} and chart.floquet_multiplier.dims == ("Omega", "multiplier")
    assert not [str(f) for f in check(chart) if f.broken] and dt.plot(chart).axes


# a, q and |trace|/2 - 1 at edges of bands, by Taylor series of 260 bits: within the period solutions grow up to 1e12 times.
EDGES = np.array([
    (-152.86096230651398, 132.25485445667033, 0.15308510132462463),
    (-142.57791794097508, 155.25975069540155, 0.14268388633519455),
    (-139.68974490361666, 78.58271971601185, 0.016110527522535802),
    (-138.79833381742287, 152.62569995168226, -0.02925867528999017),
    (-53.004980424483264, 155.57921414008686, 6.80451308263632e-05),
    (-81.74027957148884, 47.645299649699666, 1.4833321709035173e-05),
    (-26.969831798909805, 131.39276457983962, -8.82297088088834e-07),
    (-21.30486062, 25.0, 510.861100303945820),
    (1.0139188200111349, 5.0, 10.176599660527210),
]).T  # fmt: skip


@pytest.mark.parametrize(
    ("method", "rtol"), full_after(1, itertools.product(["direct", "diffrax"], [1e-9, 1e-6, 1e-12]), several=True)
)
def test_bounds_hold_where_solutions_grow_within_the_period(method, rtol):
    a, q, above = EDGES
    exact = np.where(above > 0, 1 + above + np.sqrt(np.maximum(above * (2 + above), 0)), 1.0)
    found = jax.vmap(lambda a, q: dt.floquet(Mathieu(a=a, q=q), outputs=OUTPUTS, method=method, rtol=rtol))(a, q)
    error = np.abs(np.asarray(found.spectral_radius) - exact)
    assert np.all(error <= found.spectral_radius_error), error / found.spectral_radius_error
    assert not np.any((found.verdict == 0) & (exact > 1)) and not np.any((found.verdict == 1) & (exact == 1))
    assert found.verdict[-2:].tolist() == [1, 1]


@pytest.mark.full
def test_a_multiplier_below_the_rounding_of_the_matrix_has_its_own_error():
    """x'' = 25 x: of the multipliers exp(+-5 pi) the smaller one is below the rounding, that of x'' = 4 x is not."""
    outputs = ["floquet_multiplier", "floquet_multiplier_error", "spectral_radius"]
    found = jax.vmap(lambda a: dt.floquet(Mathieu(a=a, q=0.0), outputs=outputs))(np.array([-4.0, -25.0, -121.0]))
    exact = np.exp(math.pi * np.array([[2.0, -2.0], [5.0, -5.0], [11.0, -11.0]]))
    error = np.abs(np.asarray(found.floquet_multiplier) - exact)
    assert (error < 1e-8 * exact).all()
    assert np.all(error <= found.floquet_multiplier_error) and found.outcome.tolist() == [0] * 3
    assert np.all(error[:, 0] <= 1e-9 * exact[:, 0])
    turning = dt.floquet(Mathieu(a=2.0, q=0.0), outputs=outputs)
    angle = math.sqrt(2) * math.pi - 2 * math.pi
    assert (
        np.abs(turning.floquet_multiplier - np.exp([1j * angle, -1j * angle])).max()
        <= turning.floquet_multiplier_error[0]
    )


@pytest.mark.full
def test_masses_without_damping():
    """Modes in and against phase: Mathieu's equation with a and with a + 0.6."""
    found = jax.vmap(lambda a, q: dt.floquet(TwoMasses(a=a, q=q), outputs=OUTPUTS))(A.ravel(), Q.ravel())
    expected = bounded(A, Q) & bounded(A + 0.6, Q)
    assert found.verdict.tolist() == (1 - expected).ravel().tolist() and expected.sum() > 10


@pytest.mark.parametrize(
    "changes", full_after(3, [{"damping": 1e-15}, {"damping": -1e-15}, {"a": 4.0, "q": 0.0}, {"twist": 1e-12}])
)
def test_what_may_grow_is_not_called_stable(changes):
    """At a = 4, q = 0 there is a double multiplier at 1."""
    given = {"a": 2.0, "q": 0.5} | changes
    system = TwoMasses if "twist" in changes else Mathieu
    assert int(dt.floquet(system(**given), outputs=["verdict"]).verdict) == 2


@pytest.mark.full
def test_methods_and_points_agree_with_an_atlas(tmp_path):
    fixed = {"zeta": 0.0, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    axes = {"beta": {"start": 0.2, "stop": 0.6}, "Omega": {"start": 1.3, "stop": 1.5}}
    dt.run({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": fixed}, out=tmp_path / "a.nc")
    beta, omega = np.linspace(0.21, 0.59, 5), np.linspace(1.31, 1.49, 12)
    over = {"beta": beta, "Omega": omega}
    shaft = dt.Cardan(beta=0.3, Omega=1.4, **fixed)
    chart = dt.sweep(dt.floquet, shaft, over=over, outputs=[*OUTPUTS, "floquet_multiplier"], method="direct")
    cells = dt.open_atlas(tmp_path / "a.nc")(beta=chart.beta, Omega=chart.Omega).transpose(*chart.verdict.dims)
    assert np.array_equal(cells.verdict, chart.verdict) and set(chart.verdict.values.ravel()) == {0, 1}
    one = dt.point("cardan", "floquet", beta=beta[1], Omega=omega[0], **fixed)
    assert one.verdict == 0 and one.spectral_radius == 1 and not one.growth
    assert not [str(f) for f in check(chart) if f.broken]
    assert not [str(f) for f in check(cells.assign_attrs(analysis="floquet")) if f.broken]


def test_the_rule_of_the_verdict():
    """Undecided at 1 (older files) and stable where the radius is known to be 1 hold; stable within an error does not."""
    rho, error = [1.0, 1.0, 1 + 1e-12, 0.5, 2.0, 1.0], [1e-11, 8e-16, 1e-11, 1e-9, 1e-9, 8e-16]
    verdicts, broken = [2, 0, 0, 2, 0, 2], [False, False, True, True, True, True]
    for row in zip(rho, error, verdicts, broken, strict=True):
        values = {"spectral_radius": row[0], "spectral_radius_error": row[1], "verdict": np.int8(row[2])}
        found = check(xr.Dataset(values | {"outcome": np.int8(0)}, attrs={"analysis": "floquet"}))
        assert any(f.broken for f in found if "verdict follows" in f.rule) is row[3], row
