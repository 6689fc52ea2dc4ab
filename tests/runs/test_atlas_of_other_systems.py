"""Atlases of a system of another package: units without physical data, and a parameter that is an integer."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax import systems
from drivetrain_jax._errors import InputError
from drivetrain_jax.runs import resolve as resolve_module
from drivetrain_jax.runs.resolve import choose_atlas
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.through_atlas import fixed_of
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves


class Pendulum(System):
    """x'' + 2 zeta omega x' + (1 + depth cos(order tau)) x = 0, tau from 0 to 2 pi."""

    name = "pendulum"
    title = "Pendulum on a moving support"

    omega: float = parameter("rad/s", "frequency of the support", lower=0.0, open_lower=True)
    depth: float = parameter("1", "depth of the excitation", lower=0.0)
    mass: float = parameter("kg", "mass", default=1.0, lower=0.0, open_lower=True)
    order: int = parameter("1", "periods of the excitation per turn", default=1, lower=1, integer=True)

    @serves("atlas")
    @serves("floquet")
    def floquet_model(self):
        def rows(tau):
            stiffness = (1 + self.depth * jnp.cos(self.order * tau)) / (self.mass * self.omega**2)
            return (0, 1.0), (-stiffness, -0.02 + 0 * self.omega)

        form = LinearPeriodic(rows, 2 * math.pi, log_determinant=lambda: -0.04 * math.pi + 0 * self.omega)
        return FloquetModel(natural=form, reduced=form)


SCENE = {
    "system": "pendulum",
    "analysis": "atlas",
    "axes": {"omega": {"start": 0.8, "stop": 1.2}},
    "fixed": {"depth": 0.3, "mass": 1.0, "order": 1},
}


@pytest.fixture(scope="module", autouse=True)
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(systems._REGISTERED, "pendulum", Pendulum)
        yield


@pytest.fixture(scope="module")
def atlas():
    return dt.open_atlas(dt.run(SCENE))


@pytest.mark.full
def test_values_may_have_units(atlas):
    speed = 1.1 / (2 * math.pi)
    expected = atlas(omega=1.1).spectral_radius.item()
    assert atlas(omega=f"{speed} Hz", mass="1000 g").spectral_radius.item() == pytest.approx(expected, rel=1e-12)
    two = atlas(omega=[f"{speed} Hz", "1 rad/s"])
    assert two.omega.values == pytest.approx([1.1, 1.0]) and two.spectral_radius[0].item() == pytest.approx(expected)
    grid = atlas.grid(omega=[f"{speed} Hz", "1 rad/s"])
    assert np.array_equal(grid.spectral_radius, two.spectral_radius)


@pytest.mark.full
def test_a_grid_of_the_engine_may_have_units(tmp_path):
    dt.run(SCENE, out=tmp_path / "a.nc")
    found = xr.open_dataset(tmp_path / "a.nc", engine="drivetrain", grid={"omega": ("0.14 Hz", "0.16 Hz", 3)})
    assert found.omega.values == pytest.approx(2 * math.pi * np.array([0.14, 0.15, 0.16]))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"omega": "4 mm"}, ["omega = '4 mm'", "rad/s"]),
        ({"omega": 1.1, "mass": "2 kg"}, ["mass = 2: the atlas is made for mass = 1"]),
        ({"omega": ["1 rad/s", "4 mm"]}, ["'4 mm'", "rad/s"]),
    ],
)
def test_wrong_units_and_other_fixed_values_are_refused(atlas, values, words):
    with pytest.raises(InputError) as error:
        atlas(**values)
    assert all(word in str(error.value) for word in words) and "\n" not in str(error.value)


def test_traced_numbers_are_refused_in_one_line(atlas):
    with pytest.raises(InputError, match=r"^omega = [^\n]*: expected numbers"):
        jax.jit(lambda omega: atlas(omega=omega).spectral_radius.values)(1.1)


def test_every_number_of_an_integer_is_checked():
    with pytest.raises(InputError, match=r"order = 1\.5: expected integer"):
        Pendulum(omega=1.0, depth=0.3, order=np.array([1, 1.5, 2]))


def test_an_integer_is_no_range_of_an_atlas(monkeypatch):
    """Between integers the motion of this pendulum has no such period, so its multipliers mean nothing."""
    axes = {"order": {"start": 1, "stop": 3}}
    fixed = {"omega": 1.1, "depth": 0.3}
    with pytest.raises(InputError, match=r"axes\.order: an integer; expected for atlas a"):
        load_scene(SCENE | {"axes": axes, "fixed": fixed})
    many = {"order": {"start": 1, "stop": 3, "num": 3}, "omega": {"start": 0.8, "stop": 1.2, "num": 400}}
    chart = {"system": "pendulum", "analysis": "floquet", "axes": many, "fixed": {"depth": 0.3}}
    monkeypatch.setattr(resolve_module, "_WORTHWHILE", 0)
    assert choose_atlas(load_scene(chart)) is None
    with pytest.raises(InputError, match="order is an integer; expected auto and direct"):
        choose_atlas(load_scene(chart | {"options": {"method": "atlas"}}))


class Chain(System):
    """A pendulum of several masses."""

    name = "chain"
    title = "Chain"
    omega: float = parameter("rad/s", "frequency of the support", lower=0.0, open_lower=True)
    mass: tuple = parameter("kg", "masses", lower=0.0, open_lower=True, listed=True)

    @serves("atlas")
    @serves("floquet")
    def floquet_model(self):
        def rows(tau):
            return (0, 1.0), (-(1 + 0.3 * jnp.cos(tau)) / (sum(self.mass) * self.omega**2), -0.02 + 0 * self.omega)

        form = LinearPeriodic(rows, 2 * math.pi)
        return FloquetModel(natural=form, reduced=form)


@pytest.mark.parametrize(
    "points",
    [
        {"axes": {"omega": [0.8, 0.9, 1.0], "mass[1]": [0.5]}},
        {"points": {"omega": [0.8, 0.9, 1.0], "mass[1]": [0.5] * 3}},
    ],
)
def test_an_entry_of_one_value_takes_its_place_in_the_list(monkeypatch, points):
    monkeypatch.setitem(systems._REGISTERED, "chain", Chain)
    fixed, options = {"mass": [0.5, 3.0, 0.1]}, {"method": "atlas"}
    scene = load_scene({"system": "chain", "analysis": "floquet", **points, "fixed": fixed, "options": options})
    ranges, _ = choose_atlas(scene)
    assert ranges == {"omega": (0.8, 1.0)} and fixed_of(scene, ranges) == {"mass": (0.5, 0.5, 0.1)}


@pytest.mark.full
def test_an_integer_has_no_sensitivity():
    point = {"omega": 1.1, "depth": 0.3, "mass": 1.0, "order": 1}
    found = dt.point("pendulum", "floquet", sensitivities=True, **point)
    assert {each.name for each in found.sensitivities} == {"omega", "depth", "mass"}


class Rotor(Pendulum):
    """A pendulum whose excitation is a sine, with damping."""

    name = "rotor"
    damping: float = parameter("1", "damping", default=0.02, lower=0.0)

    def rows(self, tau):
        """The rows of A."""
        return (0, 1.0), (-(1 + self.depth * jnp.sin(tau)) / self.omega**2, -self.damping)

    def floquet_model(self):
        form = LinearPeriodic(self.rows, 2 * math.pi)
        return FloquetModel(natural=form, reduced=form)


def test_a_subclass_has_its_own_equations_and_parameters():
    """An overridden method serves the same analyses; what it needs is known without repeating the marks."""
    model = Rotor.models["floquet"]
    assert "damping" in model.parameters
    values = {"omega": 2.0, "depth": 0.5, "mass": 1.0, "order": 1, "damping": 0.3}
    np.testing.assert_allclose(
        model.build(values).reduced.matrix(0.5 * math.pi), [[0, 1], [-1.5 / 4, -0.3]], atol=1e-15
    )


class HalfPeriod(System):
    """x'' + 2 d x' + (a - 2 q cos 2t) x = 0 over half a period, the rest by reversal."""

    name = "half_period"
    title = "Mathieu's equation by halves"
    a: float = parameter("1", "stiffness")
    q: float = parameter("1", "modulation")
    d: float = parameter("1", "damping")

    def rows(self, t):
        return (0, 1.0), (2 * self.q * jnp.cos(2 * t) - self.a, -2 * self.d)

    def reversal(self):
        return ((0, 1.0), (1.0, -2 * self.d)), ((2 * self.d, 1.0), (1.0, 0))

    @serves("floquet", "atlas")
    def floquet_model(self):
        half = LinearPeriodic(self.rows, math.pi / 2, reversal=self.reversal)
        return FloquetModel(natural=LinearPeriodic(self.rows, math.pi), reduced=half)


@pytest.mark.full
def test_an_atlas_of_a_form_with_a_reversal_has_the_values_of_solves(monkeypatch):
    monkeypatch.setitem(systems._REGISTERED, "half_period", HalfPeriod)
    axes = {"a": {"start": 0.5, "stop": 1.5}, "q": {"start": 0.1, "stop": 0.4}}
    atlas = dt.open_atlas(dt.run({"system": "half_period", "analysis": "atlas", "axes": axes, "fixed": {"d": 0.05}}))
    found = atlas(a=[1.0, 1.3], q=[0.3, 0.2])
    np.testing.assert_allclose(found.spectral_radius, [1.36305001, 0.85463600], rtol=1e-8)
    assert (found.spectral_radius_error < 1e-10).all() and len(atlas.stability.atlas.panels) == 1
