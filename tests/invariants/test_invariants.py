"""Rules of results: what a sound result obeys, and what each kind of wrong number is called."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray as xr

from drivetrain_jax import InputError
from drivetrain_jax._quantities import FIRST_FAILURE
from drivetrain_jax.analysis import Outcome, analysis_names, get_analysis
from drivetrain_jax.invariants import check, declared, verify
from drivetrain_jax.store.consolidate import write_result
from drivetrain_jax.store.parts import PartsFolder
from drivetrain_jax.systems import get_system, system_names
from tests.labels import labelled


def flag(values, count):
    return (
        "x",
        np.array(values, np.int8),
        {"units": "1", "long_name": "l", "flag_values": np.arange(count, dtype="i1")},
    )


def real(values, *dims):
    return (("x", *dims), np.array(values), {"units": "1", "long_name": "l"})


@pytest.fixture
def chart():
    """Two points of a floquet result with a value, one without."""
    variables = {
        "spectral_radius": real([0.5, 2.0, np.nan]),
        "spectral_radius_error": real([1e-9, 1e-9, np.nan]),
        "floquet_multiplier": real([[0.5, 0.5j], [2.0, -0.1], [np.nan, np.nan]], "multiplier"),
        "liouville_residual": real([1e-10, -1e-10, np.nan]),
        "verdict": flag([0, 1, 2], 3),
        "outcome": flag([0, 0, 4], 6),
    }
    coords = {"x": ("x", [0.1, 0.2, 0.3], {"units": "m", "long_name": "place"})}
    return xr.Dataset(variables, coords, {"analysis": "floquet", "Conventions": "CF-1.11"})


def broken(dataset):
    return [finding.rule for finding in check(dataset) if finding.broken]


def test_a_sound_result_breaks_nothing(chart):
    assert broken(chart) == [] and len(check(chart)) > 10
    assert broken(chart.isel(x=0)) == [] and broken(chart.drop_vars(["verdict", "liouville_residual"])) == []


@pytest.mark.parametrize(
    ("name", "place", "value", "rule"),
    [
        ("outcome", 0, 9, "outcome is one of its 6 codes"),
        ("verdict", 0, -1, "verdict is one of its 3 codes"),
        ("spectral_radius", 0, np.nan, "spectral_radius has a value where outcome says so"),
        ("outcome", 1, 3, "a value is missing where outcome says so"),
        ("spectral_radius_error", 0, -1e-12, "spectral_radius_error >= 0"),
        ("spectral_radius", 0, 0.6, "spectral_radius is the largest modulus of floquet_multiplier"),
        ("floquet_multiplier", (1, 1), 3.0, "floquet_multiplier falls along multiplier"),
        ("verdict", 1, 0, "verdict follows from spectral_radius and its bound"),
        ("liouville_residual", 0, 1e-3, "liouville_residual lies within the bound of spectral_radius"),
    ],
)
def test_a_wrong_number_is_found(chart, name, place, value, rule):
    chart[name].values[place] = value
    assert rule in broken(chart)


def test_the_first_wrong_point_is_named(chart):
    chart["verdict"].values[1] = 0
    finding = next(f for f in check(chart) if f.broken)
    assert "broken at 1 of 3 points, first at x = 0.2" in str(finding)


@pytest.mark.parametrize(
    ("analysis", "variables", "rule"),
    [
        ("modes", {"natural_frequency": real([[1.0, 3.0, 2.0]], "mode")}, "natural_frequency rises along mode"),
        ("modes", {"participation": real([[[0.5, 0.4]]], "mode", "family")}, "sum of participation over family = 1"),
        ("modes", {"mac": real([[1.1]], "mode")}, "0 <= mac <= 1"),
        (
            "lyapunov",
            {"lyapunov_spectrum": real([[1.0, -2.0]], "exponent"), "sum_rule_residual": real([0.5])},
            "the exponents sum to the mean divergence",
        ),
        ("lyapunov", {"lyapunov_spectrum": real([[-2.0, 1.0]], "exponent")}, "lyapunov_spectrum falls along exponent"),
        (
            "critical_speeds",
            {"critical_speed": real([[61.0]], "mode"), "natural_frequency": real([[1.0]], "mode")},
            "critical_speed = 60/max(|order|, 1) natural_frequency",
        ),
        (
            "critical_speeds",
            {"natural_frequency": real([[5.0, 1.0, np.inf]], "mode")},
            "natural_frequency rises along mode",
        ),
        ("whirl", {"whirl_frequency": real([[1.0, np.inf, 3.0]], "mode")}, "whirl_frequency rises along mode"),
        (
            "critical_speeds",
            {"critical_speed": real([[np.inf]], "mode"), "natural_frequency": real([[1.0]], "mode")},
            "critical_speed = 60/max(|order|, 1) natural_frequency",
        ),
        ("steady_state", {"u_min": real([1.0]), "u_max": real([0.5])}, "u_min <= u_max"),
        ("steady_state", {"u_min": real([-1.0]), "u_max": real([0.5]), "u_rms": real([1.2])}, "u_rms <= max |u|"),
        ("steady_state", {"contact_fraction": real([[1.5]], "flank")}, "0 <= contact_fraction <= 1"),
        (
            "basins",
            {"basin_fraction": real([[0.5, np.nan]], "attractor"), "unsettled_fraction": real([0.2])},
            "sum of basin_fraction over attractor + unsettled_fraction = 1",
        ),
        ("forced", {"condition": real([0.5])}, "1 <= condition"),
        (
            "history",
            {"event_time": real([[0.5, np.nan]], "event"), "event_count": real([2.0])},
            "event_time has event_count values, up to its length",
        ),
        (
            "frequency_response",
            {"branch_amplitude": real([[[0.1, 0.3], [0.2, 0.1]]], "branch", "shaft")},
            "largest branch_amplitude rises along branch",
        ),
        *(
            (
                "frequency_response",
                {
                    "branch_stability": ("branch", np.array([code], np.int8)),
                    "branch_spectral_radius": ("branch", np.array([radius])),
                },
                "branch_stability follows from branch_spectral_radius",
            )
            for code, radius in ((0, 1.1), (1, 0.9), (2, 0.5), (0, np.nan))
        ),
    ],
)
def test_rules_of_the_analyses(analysis, variables, rule):
    dataset = xr.Dataset(variables | {"outcome": flag([0], 6)}, {"x": [1.0]}, {"analysis": analysis})
    assert rule in broken(dataset)


@pytest.mark.parametrize(
    ("analysis", "outcome", "variables"),
    [
        ("basins", 2, {"basin_fraction": real([[np.nan]], "attractor"), "unsettled_fraction": real([1.0])}),
        ("forced", 2, {"condition": real([1e17])}),
        *(
            ("history", 0, {"event_time": real([times], "event"), "event_count": real([count])})
            for times, count in (([0.5, np.nan], 1.0), ([0.5, 0.7], 3.0))
        ),
        (
            "lyapunov",
            0,
            {"lyapunov_spectrum": real([[0.2]], "exponent"), "lyapunov_standard_error": real([[np.nan]], "exponent")},
        ),
        ("lyapunov", 1, {"lyapunov_spectrum": real([[0.2]], "exponent"), "sum_rule_residual": real([5.0])}),
        ("lyapunov", 0, {"lyapunov_spectrum": real([[0.0]], "exponent"), "sum_rule_residual": real([1e-18])}),
        ("floquet", 3, {"floquet_multiplier": real(np.empty((1, 0)), "multiplier")}),
        (
            "critical_speeds",
            0,
            {
                "critical_speed": real([[0.0, 60.0, np.inf, np.inf]], "mode"),
                "natural_frequency": real([[0.0, 1.0, np.inf, np.inf]], "mode"),
            },
        ),
        ("frequency_response", 0, {"branch_amplitude": real([[[0.1, 0.3], [np.nan, np.nan]]], "branch", "shaft")}),
    ],
)
def test_what_may_be_missing_or_kept_breaks_nothing(analysis, outcome, variables):
    dataset = xr.Dataset(variables | {"outcome": flag([outcome], 6)}, {"x": [1.0]}, {"analysis": analysis})
    assert broken(dataset) == []


def test_a_function_has_no_outcome():
    atlas = xr.Dataset({"lower": real([0.0, 2.0]), "upper": real([1.0, 1.0]), "value_error": real([0.0, 0.0])})
    atlas.attrs["analysis"] = "atlas"
    assert broken(atlas) == ["lower <= upper"]


def test_an_unknown_analysis_has_the_rules_of_every_result(chart):
    chart.attrs["analysis"] = "of another package"
    assert broken(chart) == [] and len(check(chart)) < 10
    assert broken(xr.Dataset()) == ["outcome is stored"]


def test_what_is_declared_exists():
    """Names in the register are results of the analyses that they are registered for."""
    for analysis in analysis_names():
        if not declared(analysis).has_points:
            continue
        served = [system for system in map(get_system, system_names()) if analysis in system.models]
        names = {v.name for system in served for v in get_analysis(analysis).for_system(system).variables} | {"outcome"}
        known = declared(analysis)
        used = {name for rule in known.rules for name in rule.variables} | {*known.gaps, *known.kept}
        assert used <= names, (analysis, used - names)
    assert FIRST_FAILURE == Outcome.NOT_CONVERGED


@pytest.fixture
def path(chart, tmp_path):
    write_result(labelled(chart), tmp_path / "r.nc", tmp_path / "tmp")
    return tmp_path / "r.nc"


def test_verify_a_file(path, chart):
    report = verify(path)
    assert report.problem == "" and report.complete and report.lines[0] == "checksums: all agree"
    wrong = chart.copy(deep=True)
    wrong["verdict"].values[1] = 0
    write_result(labelled(wrong), path, path.with_name("tmp"))
    assert verify(path).problem.startswith("verdict follows from spectral_radius and its bound: broken at 1 of 3")
    data = path.read_bytes().replace(np.float64(2.0).tobytes(), np.float64(2.5).tobytes())
    path.write_bytes(data)
    assert verify(path).problem.startswith("floquet_multiplier, spectral_radius: damaged")


def test_verify_a_file_without_checksums(chart, tmp_path):
    chart.to_netcdf(tmp_path / "r.nc", engine="h5netcdf")
    assert verify(tmp_path / "r.nc").lines[0] == "checksums: none in this file"


def test_a_result_that_has_lost_its_checksums_is_not_sound(chart, tmp_path):
    path = tmp_path / "r.nc"
    write_result(labelled(chart.assign_attrs(digest="abc")), path, tmp_path / "tmp")
    with h5py.File(path, "r+") as file:
        del file.attrs["checksums"]
    report = verify(path)
    assert report.lines == ("checksums: gone",) and "its checksums are gone; restore" in report.problem


def test_verify_unfinished_work(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        verify(tmp_path / "r.nc")
    folder = PartsFolder(tmp_path / "r.nc")
    folder.open()
    folder.start({"digest": "abc"})
    for number in (0, 1):
        folder.write(number, {"outcome": np.zeros(2, np.int8)})
    folder.close()
    report = verify(tmp_path / "r.nc")
    assert (report.problem, report.complete) == ("", False) and report.lines == (
        "unfinished: 2 of 2 finished blocks are intact",
    )
    part = next(folder.path.glob("0*.npz"))
    part.write_bytes(part.read_bytes()[:-1])
    assert verify(tmp_path / "r.nc").lines[0] == "unfinished: 1 of 2 finished blocks are intact"
