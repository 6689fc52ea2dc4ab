"""Without damping stable means bounded: all multipliers are simple and on the unit circle, by every method."""

from __future__ import annotations

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


@pytest.mark.parametrize("method", ["direct", "diffrax"])
def test_an_ince_strutt_diagram_has_stable_regions(method):
    found = jax.vmap(lambda a, q: dt.floquet(Mathieu(a=a, q=q), outputs=OUTPUTS, method=method))(A.ravel(), Q.ravel())
    expected = bounded(A, Q).ravel()
    assert found.verdict.tolist() == (1 - expected).tolist() and 20 < expected.sum() < 88
    assert np.all(np.asarray(found.spectral_radius)[expected] == 1)


@pytest.mark.full
def test_masses_without_damping():
    """Modes in and against phase: Mathieu's equation with a and with a + 0.6."""
    found = jax.vmap(lambda a, q: dt.floquet(TwoMasses(a=a, q=q), outputs=OUTPUTS))(A.ravel(), Q.ravel())
    expected = bounded(A, Q) & bounded(A + 0.6, Q)
    assert found.verdict.tolist() == (1 - expected).ravel().tolist() and expected.sum() > 10


@pytest.mark.parametrize("changes", [{"damping": 1e-15}, {"damping": -1e-15}, {"twist": 1e-12}, {"a": 4.0, "q": 0.0}])
def test_what_may_grow_is_not_called_stable(changes):
    """The last one has a double multiplier at 1."""
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
