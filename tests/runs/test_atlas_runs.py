"""Scenes computed through an atlas, atlas files, and the questions they answer."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr
from interrupts import stop_after

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.atlas.criteria import Criteria, has_boundaries
from drivetrain_jax.cli import main
from drivetrain_jax.runs import atlas_answers, atlas_chart, through_atlas
from drivetrain_jax.runs import resolve as resolve_module
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.output import missed
from drivetrain_jax.runs.resolve import choose_atlas
from drivetrain_jax.runs.run import Incomplete, Interrupted, run_to_file
from drivetrain_jax.runs.scene import load_scene
from tests.atlases import atlas_file
from tests.sizes import full_after

BASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
BETA, OMEGA = (0.0, 0.6), (1.0, 2.0)
ATLAS = {
    "system": "cardan",
    "analysis": "atlas",
    "axes": {"beta": {"start": BETA[0], "stop": BETA[1]}, "Omega": {"start": OMEGA[0], "stop": OMEGA[1]}},
    "fixed": BASE,
}
AT_ONE_SPEED = ATLAS | {
    "axes": {"beta": {"start": 0.1, "stop": 0.5}, "mu": {"start": 0.5, "stop": 1.5}},
    "fixed": {"zeta": 0.001, "alpha": 1.0, "Omega": 1.3, "gamma": 100.0},
}


def floquet(method, axes=None, **more):
    axes = axes or {
        "Omega": {"start": OMEGA[1], "stop": OMEGA[0], "num": 41},
        "mu": {"values": [1.0]},
        "beta": {"start": BETA[0], "stop": BETA[1], "num": 13},
    }
    fixed = {name: value for name, value in BASE.items() if name not in axes}
    return {
        "system": "cardan",
        "analysis": "floquet",
        "axes": axes,
        "fixed": fixed,
        "options": {"method": method},
        **more,
    }


def assert_same_arrays(a, b):
    assert set(a.variables) == set(b.variables)
    for name in a.variables:
        np.testing.assert_array_equal(a[name].values, b[name].values, err_msg=name)


def assert_agree(found, exact):
    error = np.abs(found["spectral_radius"] - exact["spectral_radius"])
    bound = found["spectral_radius_error"] + exact["spectral_radius_error"]
    assert found["spectral_radius"].dims == exact["spectral_radius"].dims
    assert bool((error <= bound).all()) and float(bound.median()) < 1e-9
    decided = (found["verdict"] < 2) & (exact["verdict"] < 2)
    assert bool((found["verdict"] == exact["verdict"]).where(decided, True).all()) and bool(decided.mean() > 0.99)


@pytest.fixture(scope="module")
def direct():
    return dt.run(floquet("direct"))


@pytest.fixture(scope="module")
def stored():
    return dt.open_result(atlas_file(ATLAS))


@pytest.fixture(scope="module")
def atlas(stored):
    return dt.open_atlas(stored)


def test_a_chart_through_an_atlas(direct):
    found = dt.run(floquet("atlas"))
    assert_agree(found, direct)
    assert found.attrs["atlas_uncovered"] == 0 and found.attrs["atlas_solves"] == 64
    assert found.sizes["mu"] == 1 and (found["outcome"] <= Outcome.TOLERANCE_NOT_MET).all()


def test_the_file_of_an_atlas_shows_a_chart_without_this_package(stored, atlas):
    chart = stored[["spectral_radius", "verdict"]]
    assert chart.verdict.dims == atlas.parameters and set(chart.sizes.values()) == {256}
    expected = atlas.grid(**{name: chart[name].values for name in chart.dims})
    np.testing.assert_array_equal(chart.verdict, expected.verdict)
    bound = stored.spectral_radius_error + expected.spectral_radius_error
    assert bool((abs(chart.spectral_radius - expected.spectral_radius) <= bound).all())


@pytest.mark.full
def test_the_stored_chart_of_three_parameters_lies_in_the_middle_of_the_third():
    axes = {
        "Omega": {"start": 1.9, "stop": 2.0},
        "beta": {"start": 0.0, "stop": 0.1},
        "mu": {"start": 1.0, "stop": 1.1},
    }
    fixed = {name: value for name, value in BASE.items() if name != "mu"}
    chart = dt.run({**ATLAS, "axes": axes, "fixed": fixed, "options": {"rtol": 1e-6}})
    assert chart.verdict.dims == ("Omega", "beta") and chart.mu.item() == 1.05
    point = dt.point("cardan", "floquet", beta=0.1, Omega=2.0, mu=1.05, **fixed)
    assert abs(chart.spectral_radius[-1, -1] - point.spectral_radius) < 1e-6


@pytest.mark.full
def test_points_and_multipliers_through_an_atlas():
    random = np.random.default_rng(0)
    points = {"Omega": random.uniform(*OMEGA, 50).tolist(), "beta": random.uniform(*BETA, 50).tolist()}
    scene = {**floquet("atlas"), "outputs": ["floquet_multiplier", "spectral_radius"], "points": points, "axes": {}}
    scene["fixed"] = BASE
    found = dt.run(scene)
    exact = dt.run({**scene, "options": {"method": "direct"}})
    assert found["floquet_multiplier"].dims == ("point", "multiplier")
    np.testing.assert_allclose(found["spectral_radius"], exact["spectral_radius"], rtol=1e-9)
    modulus = np.abs(found["floquet_multiplier"])
    np.testing.assert_allclose(modulus.max("multiplier"), found["spectral_radius"], rtol=1e-12)


def test_auto_uses_an_atlas_for_many_points(monkeypatch, direct):
    assert "atlas_solves" not in dt.run(floquet("auto")).attrs
    monkeypatch.setattr(resolve_module, "_WORTHWHILE", 500)
    # An eighth of the effort of 533 points is that of some 30 solves, too few for an atlas of two parameters.
    assert "atlas_solves" not in dt.run(floquet("auto")).attrs
    monkeypatch.setattr(resolve_module, "_FEWEST", (1, 1))
    found = dt.run(floquet("auto"))
    # A forced attempt stops at the first round, and all points are solved directly.
    assert found.attrs["atlas_uncovered"] == 533
    assert_same_arrays(found, direct)
    monkeypatch.setattr(resolve_module, "_SHARE", 10.0)
    assert_agree(dt.run(floquet("auto")), direct)


def test_the_message_names_another_route_of_auto(monkeypatch, tmp_path):
    path = tmp_path / "r.nc"
    run_to_file(floquet("auto"), path)
    for name, value in (("_WORTHWHILE", 600), ("_FEWEST", (1, 1))):
        monkeypatch.setattr(resolve_module, name, value)
    large = floquet("auto", floquet("auto")["axes"] | {"beta": {"start": BETA[0], "stop": BETA[1], "num": 25}})
    with pytest.raises(InputError, match="route is an atlas, was direct solves") as refused:
        run_to_file(large, path)
    assert "the code has changed" not in str(refused.value)


@pytest.mark.parametrize(("slowest", "fastest", "tried"), [(0.1, 2.0, True), (0.005, 2.0, False), (1e-9, 1e-8, False)])
def test_auto_counts_the_effort_of_solves_not_their_number(slowest, fastest, tried):
    """At Omega down to .005 a node costs as much as some fifty cells, so direct solves are cheaper.

    Below 1e-8 no solver can compute a cell.
    """
    axes = {"beta": {"start": 0.0, "stop": 1.5, "num": 400}, "Omega": {"start": slowest, "stop": fastest, "num": 400}}
    assert (choose_atlas(load_scene(floquet("auto", axes))) is not None) is tried


def test_points_outside_an_atlas_are_solved(monkeypatch, direct):
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 50)
    found = dt.run(floquet("atlas"))
    assert found.attrs["atlas_uncovered"] == 533 and found.attrs["atlas_panels"] == 0
    assert_same_arrays(found, direct)


def test_gaps_of_an_atlas_are_noted(monkeypatch, tmp_path):
    assert run_to_file(floquet("atlas"), tmp_path / "whole.nc").note == ""
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 50)
    told = (
        "the atlas has 0 panels and 1 gap (more than 50 solves would be needed): what lies in a gap is solved directly"
    )
    for name, scene in (("chart.nc", floquet("atlas")), ("atlas.nc", ATLAS)):
        assert run_to_file(scene, tmp_path / name).note == told


def interrupted_run(scene, out, reports):
    """Start a run and interrupt it after this many reports."""
    with pytest.raises(Interrupted):
        run_to_file(scene, out, report=stop_after(reports))


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("scene", "chunks"),
    full_after(1, [(ATLAS, 1), (AT_ONE_SPEED, 1), (AT_ONE_SPEED, 3), (AT_ONE_SPEED, 6)], several=True),
)
def test_an_interrupted_atlas_is_resumed_with_the_same_bits(tmp_path, scene, chunks):
    """The interrupt is in the only round of solves, or in the first or a later round of an atlas with solved nodes."""
    out, whole = tmp_path / "a.nc", dt.run(scene)
    interrupted_run(scene, out, chunks)
    assert not out.exists() and (tmp_path / "a.nc.parts").is_dir()
    progress = run_to_file(scene, out)
    assert progress.reused > 0 and progress.reused + progress.computed == progress.total == whole.attrs["solves"]
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert_same_arrays(found, whole)
    again = run_to_file(scene, out)
    assert again.computed == 0 and again.reused == whole.attrs["solves"]


def test_an_interrupted_chart_is_resumed_with_the_same_bits(tmp_path):
    out, scene = tmp_path / "a.nc", floquet("atlas")
    interrupted_run(scene, out, 2)
    progress = run_to_file(scene, out)
    assert progress.total == progress.computed == 533 and progress.failed == 0
    with xr.open_dataset(out, engine="h5netcdf") as found:
        assert_same_arrays(found, dt.run(scene))


def test_solves_are_kept_when_a_chart_fails_after_them(tmp_path, monkeypatch):
    out, scene = tmp_path / "a.nc", floquet("atlas")

    def failing(*_):
        raise OSError("no luck")

    with monkeypatch.context() as broken:
        broken.setattr(through_atlas, "evaluate", failing)
        with pytest.raises(Incomplete, match="no luck"):
            run_to_file(scene, out)
    monkeypatch.setattr(Job, "compute", failing)
    assert run_to_file(scene, out).computed == 533


@pytest.mark.full
def test_the_solves_of_an_atlas_run_on_workers(stored, monkeypatch):
    """All solves run on workers, none in this process, and have the same bits as in threads."""
    monkeypatch.setattr(Job, "compute", None)
    assert_same_arrays(dt.run(ATLAS, workers=2), stored)


@pytest.mark.full
def test_the_function_of_the_parameters(atlas, direct):
    assert atlas.parameters == ("beta", "Omega") and atlas.ranges == {"beta": BETA, "Omega": OMEGA}
    omega, beta = direct["Omega"].values, direct["beta"].values
    grid = atlas.grid(Omega=omega, beta=beta)
    assert grid["spectral_radius"].dims == ("Omega", "beta")
    assert_agree(grid, direct.isel(mu=0, drop=True))
    points = atlas(beta=xr.DataArray(beta, dims="b"), Omega=xr.DataArray(omega, dims="w"))
    assert points["verdict"].dims == ("b", "w")
    np.testing.assert_allclose(points["spectral_radius"].T, grid["spectral_radius"], atol=1e-9)
    assert atlas(beta=0.31, Omega=1.2)["spectral_radius"].shape == ()
    line = atlas.grid(beta=0.31, Omega=omega)
    assert line["spectral_radius"].dims == ("Omega",) and float(line["beta"] if "beta" in line.coords else 0.31) == 0.31


@pytest.mark.full
def test_single_points_empty_arrays_and_wrong_shapes(atlas):
    point = atlas.grid(beta=0.31, Omega=1.2)
    assert point["spectral_radius"].shape == ()
    assert float(point["spectral_radius"]) == float(atlas(beta=0.31, Omega=1.2)["spectral_radius"])
    assert dict(atlas(beta=np.empty(0), Omega=1.2).sizes) == {"point": 0}
    crossed = atlas(beta=np.full((2, 1), 0.31), Omega=np.full((1, 3), 1.2))["spectral_radius"]
    assert crossed.shape == (2, 3) and (crossed == point["spectral_radius"]).all()
    with pytest.raises(dt.InputError, match=r"shapes beta \(2,\), Omega \(3,\): expected arrays that broadcast"):
        atlas(beta=[0.1, 0.2], Omega=[1.1, 1.2, 1.3])
    row = atlas.grid(beta=[0.1, 0.2], Omega=np.full(100, 1.3))["spectral_radius"].values
    assert np.isfinite(row).all() and (row == row[:, :1]).all()


@pytest.mark.full
def test_an_atlas_of_another_range_is_refused(tmp_path):
    run_to_file(ATLAS, tmp_path / "a.nc")
    with pytest.raises(dt.InputError, match=r"axes.beta is the range from 0 to 0\.5, was the range from 0 to 0\.6;"):
        run_to_file(ATLAS, tmp_path / "a.nc", overrides={"axes.beta.stop": 0.5})


def test_labelled_arrays_keep_their_labels_and_must_agree(atlas):
    grid = atlas.grid(beta=[0.1, 0.31], Omega=[1.1, 1.2, 1.3])
    outer = atlas(beta=grid["beta"], Omega=grid["Omega"])
    assert outer.indexes.keys() == {"beta", "Omega"} and outer["beta"].attrs["units"] == "rad"
    assert float(outer["verdict"].sel(beta=0.31, Omega=1.2)) == float(grid["verdict"].sel(beta=0.31, Omega=1.2))
    beta = xr.DataArray([0.1, 0.2], dims="shaft", coords={"shaft": ["a", "b"]})
    fleet = atlas(beta=beta, Omega=1.2)
    assert fleet["shaft"].values.tolist() == ["a", "b"] and fleet["Omega"].dims == ("shaft",)
    with pytest.raises(dt.InputError, match="of the same labels along a dimension that they share"):
        atlas(beta=beta, Omega=xr.DataArray([1.1, 1.2], dims="shaft", coords={"shaft": ["b", "c"]}))


@pytest.mark.full
@pytest.mark.parametrize("outputs", [["floquet_multiplier", "verdict"], ["spectral_radius"]])
def test_an_atlas_without_a_panel_has_all_its_points_solved(monkeypatch, tmp_path, outputs):
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 50)
    scene = floquet("atlas") | {"outputs": outputs}
    exact = dt.run(scene | {"options": {"method": "direct"}})
    for found in (dt.run(scene), dt.run(scene, out=tmp_path / "r.nc")):
        assert found.attrs["atlas_panels"] == 0
        assert_same_arrays(found, exact)


@pytest.mark.full
def test_values_that_coincide_in_the_coordinates_of_an_atlas():
    """The speeds differ by a rounding, and the squares of the angles underflow."""
    for axes in (
        {"beta": {"values": [0.1, 0.3]}, "Omega": {"values": [1.9, 1.9000000000000001]}},
        {"beta": {"start": 0.0, "stop": 1e-170, "num": 3}, "Omega": {"values": [1.3, 1.4]}},
    ):
        found, exact = (dt.run(floquet(method, axes)) for method in ("atlas", "direct"))
        assert found.attrs["atlas_panels"] > 0 and (found["outcome"] == 0).all()
        np.testing.assert_allclose(found["spectral_radius"], exact["spectral_radius"], rtol=1e-11)


def test_points_that_are_not_finite_are_never_stable(atlas):
    """In compiled code the largest of moduli that are all NaN is -inf, which is less than 1."""
    panels = tuple(replace(panel, coefficients=np.nan * panel.coefficients) for panel in atlas.stability.atlas.panels)
    lost = replace(atlas.stability, atlas=replace(atlas.stability.atlas, panels=panels))
    for outputs in (["spectral_radius", "verdict"], ["spectral_radius", "verdict", "floquet_multiplier"]):
        found = lost.at(np.array([[0.3, 1.2], [0.4, 1.3]]), outputs)
        assert (found["outcome"] == Outcome.NOT_FINITE).all() and (found["verdict"] == 2).all()
        assert all(np.isnan(found[name]).all() for name in outputs if name != "verdict")


def test_a_system_without_an_atlas_is_refused_before_anything_is_written(tmp_path, capsys):
    assert (
        main(["run", "sweeps/tripod_tongue.toml", "--out", str(tmp_path / "t.nc"), "--set", "options.method=atlas"])
        == 2
    )
    assert "tripod has no model for it; expected auto, direct, diffrax" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_gaps_of_a_stored_atlas_are_solved(monkeypatch):
    monkeypatch.setattr(through_atlas, "MAX_SOLVES", 50)
    atlas = dt.open_atlas(dt.run(ATLAS))
    assert "0 panels, 1 gap" in repr(atlas)
    found, exact = atlas(beta=0.3, Omega=1.3), dt.point("cardan", "floquet", beta=0.3, Omega=1.3, **BASE)
    assert float(found["spectral_radius"]) == pytest.approx(exact.spectral_radius, rel=1e-12)


def test_a_file_of_other_coordinates_is_refused(stored):
    with pytest.raises(dt.InputError, match="made by another version of cardan"):
        dt.open_atlas(stored.assign_attrs(coordinates_of_panels='["beta", "Omega"]'))
    with pytest.raises(dt.InputError, match="holds the analysis 'floquet'; expected an atlas"):
        dt.open_atlas(stored.assign_attrs(analysis="floquet"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"beta": 0.3}, "Omega: missing; expected 1 <= Omega <= 2"),
        ({"beta": 0.3, "Omega": 2.5}, "Omega = 2.5: expected 1 <= Omega <= 2"),
        ({"beta": [0.3, np.nan], "Omega": 1.5}, "beta = nan: expected 0 <= beta <= 0.6, in rad"),
        ({"beta": "deg", "Omega": 1.5}, "beta = 'deg': expected a number, -1.570796327 < beta < 1.570796327"),
        ({"beta": None, "Omega": 1.5}, "beta = None: expected numbers"),
        ({"beta": [[0.1], [0.1, 0.2]], "Omega": 1.5}, "beta = [[0.1], [0.1, 0.2]]: expected numbers"),
        (
            {"beta": 0.3, "Omga": 1.5},
            "Omga = 1.5: not a parameter of the atlas (did you mean Omega?); "
            "expected 0 <= beta <= 0.6, in rad; 1 <= Omega <= 2",
        ),
        ({"beta": 0.3, "Omega": 1.5, "mu": 1.01}, "mu = 1.01: the atlas is made for mu = 1; expected that value"),
    ],
)
def test_questions_outside_the_atlas(atlas, given, message):
    with pytest.raises(dt.InputError) as error:
        atlas(**given)
    assert str(error.value) == message


def test_fixed_values_may_be_given_again(atlas):
    found = atlas(beta=0.3, Omega=1.5, **atlas.fixed)
    xr.testing.assert_identical(found, atlas(beta=0.3, Omega=1.5))


@pytest.mark.full
def test_nearest_boundaries_of_a_point(atlas):
    reply = atlas_answers.query(atlas, {"beta": 0.31, "Omega": 1.2})
    data = json.loads(reply.to_json())
    assert data["values"]["verdict"] == 0 and data["nearest"]["Omega"]["below"] is None
    omega = data["nearest"]["Omega"]["above"]["value"]
    radius = [dt.point("cardan", "floquet", beta=0.31, Omega=omega + d, **BASE).spectral_radius for d in (-1e-7, 1e-7)]
    assert radius[0] < 1 < radius[1]
    steps = [dt.point("cardan", "floquet", beta=0.31, Omega=1.2 + d, **BASE).spectral_radius for d in (-1e-4, 1e-4)]
    assert data["gradient"]["Omega"] == pytest.approx((steps[1] - steps[0]) / 2e-4, rel=1e-6)
    assert set(data["gradient"]) == {"beta", "Omega", *BASE} and "per rad" in str(reply)
    assert f"Omega = {omega:.6g}" in str(reply) and "verdict                  stable (0)" in str(reply)


@pytest.mark.full
def test_the_same_point_in_physical_units(atlas):
    stiffness, inertia = 1000.0, 2.0
    damping = 2 * 0.001 * (stiffness * inertia) ** 0.5
    rpm = 1.2 * (stiffness / inertia) ** 0.5 * 60 / (2 * np.pi)
    shaft = {"J1": inertia, "J2": 100 * inertia, "k1": stiffness, "k2": stiffness, "c1": damping, "c2": damping}
    reply = atlas_answers.query(atlas, {**shaft, "speed": rpm, "angle": np.degrees(0.31)})
    plain = atlas_answers.query(atlas, {"beta": 0.31, "Omega": 1.2})
    assert reply.data["values"]["spectral_radius"] == pytest.approx(plain.data["values"]["spectral_radius"], abs=1e-12)
    assert "rpm" in str(reply) and "rpm" not in str(plain)
    assert reply.data["physical"]["speed"] == {"value": pytest.approx(rpm), "units": "rpm"}
    assert reply.data["physical"]["angle"]["value"] == pytest.approx(np.degrees(0.31)) and plain.data["physical"] == {}
    above, per_unit = reply.data["nearest"]["Omega"]["above"], rpm / 1.2
    assert above["physical"]["speed"]["value"] == pytest.approx(above["value"] * per_unit)
    assert reply.data["meanings"] == {"verdict": "stable", "outcome": "success"}
    windows = atlas_answers.speed_windows(atlas, {**shaft, "angle": np.degrees(0.31)}).data["windows"]
    assert windows[0]["physical"]["speed"]["value"] == pytest.approx([x * per_unit for x in windows[0]["safe"]])
    with pytest.raises(dt.InputError, match=r"^speed = 1000: expected [\d.]+ <= speed <= [\d.]+, in rpm$"):
        atlas_answers.query(atlas, {**shaft, "speed": 1000.0, "angle": 10.0})
    with pytest.raises(dt.InputError, match=r"^angle: missing; expected 0 <= angle <= 34\.37\d*, in deg$"):
        atlas_answers.query(atlas, {**shaft, "speed": rpm})
    with pytest.raises(dt.InputError, match=r"^k1: missing; Omega = speed sqrt\(J1/k1\) needs k1$"):
        atlas_answers.query(atlas, {"J1": 1.0, "speed": 100.0})
    with pytest.raises(
        dt.InputError, match=r"^k2 = 2000 N m/rad: the atlas is made for k2 = 1000 N m/rad; expected that"
    ):
        atlas_answers.query(atlas, {**shaft, "k2": 2000.0, "speed": rpm, "angle": 10.0})
    with pytest.raises(dt.InputError, match=r"^beta = 0\.1: given besides angle; expected one of the two$"):
        atlas_answers.query(atlas, {**shaft, "speed": rpm, "angle": 10.0, "beta": 0.1})


def test_the_parameter_of_the_answer_is_not_given(atlas):
    shaft = {"J1": 2.0, "J2": 200.0, "k1": 1000.0, "k2": 1000.0, "c1": 0.0894427191, "c2": 0.0894427191}
    refused = "is the answer; leave it out"
    with pytest.raises(dt.InputError, match=f"^Omega = 1.1: {refused}, or LOW:HIGH$"):
        atlas_answers.speed_windows(atlas, {"beta": 0.31, "Omega": 1.1})
    with pytest.raises(dt.InputError, match=f"^speed = 250: {refused}, or LOW:HIGH$"):
        atlas_answers.speed_windows(atlas, {**shaft, "angle": 10.0, "speed": 250.0})
    with pytest.raises(dt.InputError, match=f"^angle = 20: {refused}$"):
        atlas_answers.widest_angle(atlas, {**shaft, "speed": (250.0, 260.0), "angle": 20.0})


@pytest.mark.full
def test_a_range_of_speeds_restricts_the_windows(atlas):
    (window,) = atlas_answers.speed_windows(atlas, {"beta": "0.31 rad", "Omega": (1.1, 1.2)}).data["windows"]
    assert window["safe"] == [1.1, 1.2] and [end["kind"] for end in window["ends"]] == ["range", "range"]
    assert window["check"]["agrees"]


def test_physical_arrays_and_four_digits(atlas):
    """A fixed parameter may be typed with four digits: mu = 1.0002 is the 1 of the atlas."""
    shaft = {"J1": 2.0, "J2": 200.0, "k1": 1000.0, "k2": 1000.2, "c1": 0.08944, "c2": 0.08944}
    found = atlas(**shaft, speed=np.array([250.0, 260.0]), angle="10 deg")
    exact = np.array([250.0, 260.0]) * np.pi / 30 / np.sqrt(500)
    assert found.Omega.values == pytest.approx(exact) and found.beta.values == pytest.approx(np.radians(10))
    with pytest.raises(dt.InputError, match=r"^mu = 1\.002: the atlas is made for mu = 1"):
        atlas(**shaft | {"k2": 1002.0}, speed=250.0, angle=10)


@pytest.mark.full
def test_design_answers_are_checked_by_direct_solves(atlas):
    angle = atlas_answers.widest_angle(atlas, {"Omega": (1.3, 1.5)})
    assert angle.data["value"] == pytest.approx(0.1063331213, abs=1e-8)  # the tip of S21
    assert angle.data["check"]["agrees"] and "direct solves agree" in str(angle)
    reply = atlas_answers.speed_windows(atlas, {"beta": 0.31}, margin=0.02)
    windows = reply.data["windows"]
    assert len(windows) == 2 and all(w["check"]["agrees"] for w in windows)
    assert "Omega = 1 (the end of the atlas) to " in str(reply) and reply.data["undecided"] == []
    edge = json.loads(atlas_answers.query(atlas, {"beta": 0.31, "Omega": 1.2}).to_json())["nearest"]["Omega"]["above"]
    assert windows[0]["safe"][1] == pytest.approx(edge["value"] * 0.98, rel=1e-8)
    with pytest.raises(dt.InputError, match=r"^file: the atlas does not vary zeta"):
        atlas_answers.least_damping(atlas, {"Omega": (1.0, 1.2)})
    with pytest.raises(dt.InputError, match=r"^Omega = 1\.2: a range is needed"):
        atlas_answers.widest_angle(atlas, {"Omega": 1.2})
    with pytest.raises(dt.InputError, match=r"^margin = 2: expected 0 <= margin < 1; did you mean 2 %\?$"):
        atlas_answers.speed_windows(atlas, {"beta": 0.31}, margin=2)


def test_a_system_without_boundary_functions_has_values_and_charts(atlas, stored, monkeypatch):
    system = atlas.scene.system
    build = system.models["floquet"].build
    assert has_boundaries(atlas.stability.atlas, system)
    for reduced in (lambda model: model.natural, lambda model: replace(model.reduced, log_determinant=None)):
        changed = lambda values, of=reduced: replace(build(values), reduced=of(build(values)))  # noqa: E731
        model = replace(system.models["floquet"], build=changed)
        other = type("Variant", (system,), {"models": system.models | {"floquet": model}})
        with pytest.raises(
            dt.InputError, match="system = 'cardan': has no boundary functions; expected for boundaries"
        ):
            Criteria.of(atlas.stability.atlas, other)
    for module in (atlas_answers, atlas_chart):
        monkeypatch.setattr(module, "has_boundaries", lambda *_: False)
    reply = atlas_answers.query(atlas, {"beta": 0.31, "Omega": 1.2})
    assert reply.data["nearest"] == {} and "nearest change" not in str(reply)
    assert not [name for name in chart(stored, {}, 5).coords if name.startswith(("boundary", "tip"))]


@pytest.mark.full
def test_least_damping_of_a_range_of_speeds():
    axes = {"Omega": {"start": 1.3, "stop": 1.6}, "zeta": {"start": 0.0, "stop": 0.05}}
    fixed = {name: value for name, value in BASE.items() if name != "zeta"}
    atlas = dt.open_atlas(dt.run({**ATLAS, "axes": axes, "fixed": {**fixed, "beta": 0.2}}))
    data = atlas_answers.least_damping(atlas, {"Omega": (1.35, 1.5)}).data
    assert data["certain"] and data["check"]["agrees"]

    def largest(zeta):
        speeds = {"start": 1.35, "stop": 1.5, "num": 601}
        scene = floquet("direct", {"Omega": speeds})
        return float(dt.run({**scene, "fixed": {**fixed, "beta": 0.2, "zeta": zeta}})["spectral_radius"].max())

    assert largest(0.999 * data["value"]) > 1 > largest(1.001 * data["value"])


@pytest.mark.full
def test_a_chart_of_a_stored_atlas(stored):
    found = chart(stored, {"Omega": (1.3, 1.5)}, 60)
    assert found["verdict"].shape == (60, 60) and found["Omega"].values[[0, -1]].tolist() == [1.3, 1.5]
    assert found["tip"].values.tolist() == ["S21"]
    assert float(found["tip_beta"][0]) == pytest.approx(0.1063331213, abs=1e-8)
    on_curve = found["boundary_beta"].dropna("boundary")
    beta, omega = on_curve.values, found["boundary_Omega"].dropna("boundary").values
    radius = dt.open_atlas(stored)(beta=beta, Omega=omega)["spectral_radius"]
    assert len(beta) > 20 and float(np.abs(radius - 1).max()) < 1e-9
    with pytest.raises(dt.InputError, match=r"^Omega = 1\.5:3: expected a number or LOW:HIGH, 1 <= Omega <= 2$"):
        chart(stored, {"Omega": (1.5, 3.0)}, 60)
    with pytest.raises(dt.InputError, match=r"^part: fixes beta, Omega; a chart needs a varying parameter"):
        chart(stored, {"Omega": 1.5, "beta": 0.1}, 60)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axes": {}}, "axes: 0 are given; atlas allows 1 to 4"),
        (
            {"axes": {"beta": {"start": 0.0, "stop": 1.0, "num": 5}}},
            "axes.beta.num = 5: an atlas has ranges; expected start and stop",
        ),
        (
            {"axes": {"beta": {"values": [0.1]}}},
            "axes.beta.values = [0.1]: an atlas has ranges; expected start and stop",
        ),
        ({"axes": {"beta": {"start": 1.0, "stop": 1.0}}}, "axes.beta.stop = 1.0: expected stop > start = 1.0"),
        ({"axes": {"beta": {"start": 0.0}}}, "axes.beta.stop: missing; expected start and stop"),
        ({"axes": {}, "points": {"beta": [0.1]}}, "points: atlas needs ranges; expected axes with start and stop"),
    ],
)
def test_wrong_ranges(change, message):
    with pytest.raises(dt.InputError) as error:
        dt.run({**ATLAS, **change})
    assert str(error.value) == message


def test_too_many_parameters_for_an_atlas():
    axes = {n: {"start": 0.5, "stop": 1.0, "num": 2} for n in ("beta", "Omega", "zeta", "alpha", "mu")}
    with pytest.raises(
        dt.InputError, match=r"^options\.method = 'atlas': the scene varies 5 parameters; expected at most 4$"
    ):
        dt.run({**floquet("atlas", axes), "fixed": {"gamma": 100.0}})


@pytest.fixture
def file(tmp_path):
    return shutil.copy(atlas_file(ATLAS), tmp_path / "atlas.nc")


def answer(capsys, *arguments):
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.full
def test_questions_on_the_command_line(file, capsys):
    code, out, _ = answer(capsys, "query", file, "beta=0.31", "Omega=1.2", "--json")
    assert code == 0 and json.loads(out)["values"]["verdict"] == 0
    code, out, _ = answer(capsys, "design", "widest-angle", file, "Omega=1.3:1.5")
    assert code == 0 and "stable up to beta = 0.106333 (error at most" in out and "direct solves agree" in out
    expected = "expected a number or LOW:HIGH, with or without units (200:4000rpm)"
    code, out, err = answer(capsys, "query", file, "beta=0.31", "Omega=wide")
    assert (code, out, err) == (2, "", f"drivetrain: Omega = 'wide': {expected}\n")
    code, _, err = answer(capsys, "query", file, "beta=0.31", "spede=1.2")
    assert code == 2 and err.startswith("drivetrain: spede = 1.2: not a parameter of the atlas (did you mean speed?)")
    code, _, err = answer(capsys, "design", "narrowest-angle", file)
    assert code == 2 and "least-damping" in err and err.count("\n") == 1


@pytest.mark.full
def test_a_zoom_on_the_command_line(file, capsys):
    figure = file.with_name("zoom.png")
    code, _, err = answer(
        capsys, "plot", file, "--out", figure, "--part", "Omega=1.3:1.5", "beta=0:0.3", "--cells", "80"
    )
    assert (code, err) == (0, "") and figure.stat().st_size > 20_000
    code, _, err = answer(capsys, "plot", file, "--out", figure, "--part", "Omega=3")
    assert code == 2 and err == "drivetrain: Omega = 3: expected a number or LOW:HIGH, 1 <= Omega <= 2\n"


def test_damaged_panels_are_refused(file, tmp_path, capsys):
    damaged, figure = tmp_path / "damaged.nc", tmp_path / "f.png"
    shutil.copy(file, damaged)
    with h5py.File(damaged, "r+") as store:
        store["coefficients"][0, 0] *= 2
    for question in (
        ("query", damaged, "beta=0.31", "Omega=1.2"),
        ("design", "widest-angle", damaged, "Omega=1.3:1.5"),
        ("plot", damaged, "--out", figure),
    ):
        code, out, err = answer(capsys, *question)
        assert (code, out, err.count("\n")) == (2, "", 1) and "damaged (coefficients" in err
    assert not figure.exists()
    with pytest.raises(InputError, match=r"damaged \(coefficients"):
        dt.open_atlas(damaged)
    with h5py.File(damaged, "r+") as store:
        del store.attrs["checksums"]
    with pytest.raises(InputError, match=r"damaged \(its checksums are gone\)"):
        dt.open_atlas(damaged)


@pytest.mark.parametrize(
    ("lengths", "rows"), [((3873, 5164), 448), ((173, 174), 173), ((100_000, 100), 20_992), ((5, 3000, 1500), 1408)]
)
def test_blocks_of_a_grid_cover_it_once(lengths, rows):
    """Blocks have equal numbers of rows, whole tiles of them, except the last block."""
    boxes = through_atlas._boxes(lengths)
    blocks = list(map(boxes.place, range(boxes.count)))
    places = [tuple(part.start for part in block) for block in blocks]
    sizes = [[part.stop - part.start for part in block] for block in blocks]
    assert len(set(places)) == len(places)
    assert sum(map(math.prod, sizes)) == math.prod(lengths)
    assert {size[-2] for size in sizes} <= {rows, lengths[-2] % rows}


@pytest.mark.full
def test_the_kernel_of_single_cells_compiles_during_the_solves(monkeypatch):
    """A large chart compiles this kernel while the solves compile, and no other one afterwards."""
    from drivetrain_jax.atlas import stability

    made = []
    once = stability._point_kernel.__wrapped__
    stability._point_kernel.cache_clear()
    monkeypatch.setattr(stability, "_point_kernel", lambda *key: made.append(key) or once(*key))
    monkeypatch.setattr(through_atlas, "_LARGE", 1)
    monkeypatch.setattr(stability, "_FEW", 0)
    dt.run(floquet("atlas"))
    assert len(set(made)) == 1


def test_the_remark_about_wide_bounds_of_an_atlas_names_the_remedy(tmp_path):
    with h5py.File(tmp_path / "chart.nc", "w") as file:
        file.attrs.update({"options": '{"rtol": 1e-9}', "atlas_solves": 64})
        file["outcome"] = np.array([1, 0], np.int8)
    assert missed(tmp_path / "chart.nc", 1, 2) == (
        "1 of 2 values misses the tolerance 1e-09; direct solves (method = 'direct') have closer bounds; "
        "outcome = 1 marks it"
    )


@pytest.mark.parametrize(
    ("codes", "words"), [([2, 5, 2], "; 1 of them undecided; "), ([2, 2, 5], "; the verdicts are decided; ")]
)
def test_the_remark_counts_undecided_verdicts_by_their_meaning(tmp_path, codes, words):
    """Verdicts of `lyapunov` have the code 2 for a motion that is quasi-periodic."""
    meanings = "fixed_point periodic quasi_periodic parametrically_unstable chaotic undecided"
    with h5py.File(tmp_path / "kinds.nc", "w") as file:
        file["outcome"], file["verdict"] = np.array([1, 1, 0], np.int8), np.array(codes, np.int8)
        file["verdict"].attrs.update({"flag_meanings": meanings, "flag_values": np.arange(6, dtype=np.int8)})
    assert words in missed(tmp_path / "kinds.nc", 2, 3)
