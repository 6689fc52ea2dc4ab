"""Coefficients that jump within the period: Meissner's equation against its closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.analysis.numerics.collocation import propagators_along
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves
from tests.sizes import full_after

PERIOD = 2 * math.pi
OUTPUTS = ["floquet_multiplier", "spectral_radius", "spectral_radius_error", "verdict"]


class Meissner(System):
    """x'' + 2 zeta x' + k(t) x = 0, k = delta + jump for the first part ``duty`` of the period, then delta - jump."""

    name = "meissner"
    title = "Meissner's equation"

    delta: float = parameter("1", "mean stiffness")
    jump: float = parameter("1", "jump of the stiffness")
    zeta: float = parameter("1", "damping")
    duty: float = parameter("1", "share of the stiffer part")

    def rows(self, t):
        stiffness = jnp.where(t < PERIOD * self.duty, self.delta + self.jump, self.delta - self.jump)
        return (0, 1.0), (-stiffness, -2 * self.zeta)

    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, PERIOD, breakpoints=(PERIOD * self.duty,))
        return FloquetModel(form, form)


class Undeclared(Meissner):
    """The same without breakpoints."""

    name = "undeclared"

    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, PERIOD)
        return FloquetModel(form, form)


def closed_form(delta, jump, zeta, duty):
    """Multipliers to 30 digits, the larger one first."""
    with mpmath.workdps(30):
        whole = mpmath.eye(2)
        for k, share in (
            (mpmath.mpf(delta) + jump, mpmath.mpf(duty)),
            (mpmath.mpf(delta) - jump, 1 - mpmath.mpf(duty)),
        ):
            t, zeta, w = 2 * mpmath.pi * share, mpmath.mpf(zeta), mpmath.sqrt(mpmath.mpc(k) - mpmath.mpf(zeta) ** 2)
            c, s = mpmath.cos(w * t), mpmath.sin(w * t) / w
            part = mpmath.matrix([[c + zeta * s, s], [-k * s, c - zeta * s]])
            whole = mpmath.exp(-zeta * t) * part * whole
        half, product = (whole[0, 0] + whole[1, 1]) / 2, mpmath.exp(-4 * mpmath.pi * zeta)
        root = mpmath.sqrt(half**2 - product)
        return np.array(sorted((complex(half + root), complex(half - root)), key=abs, reverse=True))


def cases(count):
    """Parameters with ratios of 1/2 and others, with real and complex multipliers."""
    rng = np.random.default_rng(3)
    ends = np.array([0.5, 1e-3, 0.999, 0.25])
    return {
        "delta": rng.uniform(0, 4, count),
        "jump": rng.uniform(0, 3, count),
        "zeta": rng.uniform(0, 0.1, count),
        "duty": np.concatenate([ends, rng.uniform(0.05, 0.95, count - len(ends))]),
    }


EVERY_WAY = [{"method": "direct"}, {"method": "diffrax"}, {"method": "diffrax", "form": "published"}]


@pytest.mark.parametrize(
    ("options", "count"), full_after(1, [(EVERY_WAY[0], 4), *((way, 24) for way in EVERY_WAY)], several=True)
)
def test_meissners_equation_has_its_closed_form(options, count):
    values = cases(count)
    found = jax.vmap(lambda own: dt.floquet(Meissner(**own), outputs=OUTPUTS, rtol=1e-12, **options).variables)(values)
    exact = np.array([closed_form(*row) for row in zip(*values.values(), strict=True)])
    radius = abs(exact[:, 0])
    off = abs(found["spectral_radius"] - radius)
    assert (off <= found["spectral_radius_error"]).all()
    assert (abs(abs(found["floquet_multiplier"][:, 0]) - radius) <= 1e-12 * radius).all()
    assert (off <= 1e-12 * radius).all()
    assert (found["outcome"] == Outcome.SUCCESS).all()
    clear = abs(radius - 1) > 1e-6
    np.testing.assert_array_equal(found["verdict"][clear], radius[clear] > 1)


def test_undeclared_jumps_miss_the_tolerance():
    """Why breakpoints are declared: equal steps over a jump converge slowly."""
    found = dt.floquet(Undeclared(delta=1.0, jump=0.6, zeta=0.01, duty=0.3), outputs=OUTPUTS, rtol=1e-12)
    assert found.outcome == Outcome.TOLERANCE_NOT_MET


@pytest.mark.full
@pytest.mark.parametrize("values", [(1.0, 0.6, 0.02, 0.5), (0.4, 0.9, 0.01, 0.27)], ids=["half", "other"])
def test_derivatives_include_the_motion_of_the_jump(values):
    names = ("delta", "jump", "zeta", "duty")
    found = jax.jacobian(lambda s: dt.floquet(s, outputs=["spectral_radius"]).spectral_radius)(
        Meissner(**dict(zip(names, values, strict=True)))
    )
    assert np.isreal(closed_form(*values)).all()
    for i, name in enumerate(names):
        step = 1e-4 * np.eye(4)[i]
        ahead = [abs(closed_form(*(np.array(values) + k * step))[0]) for k in (-2, -1, 1, 2)]
        expected = np.dot(ahead, [1, -8, 8, -1]) / 12e-4
        assert getattr(found, name) == pytest.approx(expected, rel=1e-9), name


@pytest.mark.full
def test_several_breakpoints():
    """Four jumps of a decaying first-order equation, whose multiplier is the exponential of its mean."""
    rates, ends = np.array([3.0, -1.0, 0.5, 2.0, -4.0]), (0.1, 0.15, 0.9, 1.3)

    class Steps(System):
        name = "steps"
        title = "Steps"
        scale: float = parameter("1", "scale")

        def rows(self, t):
            index = jnp.searchsorted(jnp.array(ends), t, side="right")
            return (((self.scale * jnp.asarray(rates)[index]),),)

        @serves("floquet")
        def floquet_model(self):
            form = LinearPeriodic(self.rows, 2.0, breakpoints=ends)
            return FloquetModel(form, form)

    exact = np.exp(rates @ np.diff([0.0, *ends, 2.0]))
    assert dt.floquet(Steps(scale=1.0)).spectral_radius == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize(
    ("breakpoints", "message"),
    [
        ((4.0,), r"breakpoints\[0\] = 4: expected 0 < breakpoints\[0\] < 3"),
        ((0.0,), r"breakpoints\[0\] = 0: expected 0 < breakpoints\[0\] < 3"),
        ((1.0, 1.0), r"breakpoints\[1\] = 1: expected 1 < breakpoints\[1\] < 3"),
        ((1.0, math.nan), r"breakpoints\[1\] = nan: expected 1 < breakpoints\[1\] < 3"),
    ],
)
def test_breakpoints_outside_of_the_period_are_refused(breakpoints, message):
    with pytest.raises(dt.InputError, match=f"^{message}$"):
        LinearPeriodic(lambda t: ((0 * t,),), 3.0, breakpoints=breakpoints)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (jnp.eye(2), r"rows: got \w*Array\w*, expected tuples \(\(a, b\), \(c, d\)\) for two states"),
        (((0.0, 1.0), (1.0,)), r"rows\[1\]: 1 entries; expected 2, as many as there are rows"),
    ],
)
def test_rows_that_are_no_square_matrix_are_refused(rows, message):
    with pytest.raises(dt.InputError, match=f"^{message}$"):
        LinearPeriodic(lambda t: rows, 3.0).matrix(0.0)


@pytest.mark.full
def test_a_lane_with_a_breakpoint_outside_of_the_period_has_no_value():
    systems = jax.vmap(lambda duty: replace(Meissner(delta=1.0, jump=0.6, zeta=0.01, duty=0.3), duty=duty))
    found = jax.vmap(lambda s: dt.floquet(s, outputs=OUTPUTS).variables)(systems(jnp.array([0.3, 1.2, -0.1])))
    np.testing.assert_array_equal(found["outcome"], [Outcome.SUCCESS, Outcome.NOT_FINITE, Outcome.NOT_FINITE])
    assert np.isfinite(found["spectral_radius"][0]) and np.isnan(found["spectral_radius"][1:]).all()


def test_series_refuse_breakpoints():
    form = LinearPeriodic(lambda t: ((0 * t,),), 3.0, breakpoints=(1.0,))
    with pytest.raises(dt.InputError, match=r"^breakpoints: got 1; expected none with a series$"):
        propagators_along(form, 1, jnp.int32(4), jnp.zeros(1))
