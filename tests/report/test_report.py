"""Reports: the answer, the figure and the scene of every result in one page that is complete in itself."""

from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.report import report
from drivetrain_jax.report.statements import axes_table, statements, values_tables
from tests.view import results

HOSTILE = "</title><script>alert(1)</script>"
SHAFT = {"beta": 0.3, "zeta": 1e-3, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
SPEEDS = {"Omega": {"values": [1.2, 1.41, 1.415, 1.6]}}


class Page(HTMLParser):
    """Counts of the elements, text, and references to anything outside of the page."""

    def __init__(self, text):
        super().__init__()
        self.count, self.words, self.outside, self.ids = {}, [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.count[tag] = self.count.get(tag, 0) + 1
        links = (v for k, v in attrs if k in ("src", "href", "xlink:href") and v)
        self.outside += [link for link in links if not link.startswith(("#", "data:image/png;base64,"))]
        self.ids += [v for k, v in attrs if k == "id"]

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    scene = {"title": HOSTILE, "system": "cardan", "analysis": "floquet", "axes": SPEEDS, "fixed": SHAFT}
    dt.run(scene, out=folder / "chart.nc")
    fixed = {"length": [0.3, 1.2, 0.3], "EI": [8e4, 5e4, 8e4], "rhoA": [20.0, 15.0, 20.0], "k_A": 5e6, "k_D": 5e6}
    shaft = {"title": "Stepped shaft", "system": "bicardan", "analysis": "critical_speeds", "fixed": fixed}
    dt.run(shaft | {"options": {"modes": 2}}, out=folder / "shaft.nc")
    return folder / "chart.nc", folder / "shaft.nc"


def test_one_page_joins_results_and_needs_nothing_else(files, tmp_path):
    out = tmp_path / "report.html"
    assert main(["report", *map(str, files), "--out", str(out), "--title", "Two & one"]) == 0
    page = Page(out.read_text())
    # One point of a shaft is an interference diagram, and all its values are in a table.
    assert (page.count["section"], page.count["svg"]) == (2, 2)
    assert "script" not in page.count and not page.outside
    assert len(set(page.ids)) == len(page.ids)
    text = " ".join(page.words)
    assert "Two & one" in text and HOSTILE in text
    assert "Stability of the equilibrium at the points computed: stable 50 %, unstable 50 %." in text
    # Not only between the points: 1.41 and 1.415 are unstable.
    assert "Unstable at Omega = 1.40025 to 1.43236 (S21)." in text
    first = float(dt.open_result(files[1]).critical_speed[0])
    assert f"Critical speed: {first:.6g}" in text and f"{first:.6g}" in page.words
    assert f"Order 2 (joints) meets modes at {first / 2:.6g}, " in text


@pytest.mark.full
def test_a_report_is_the_same_each_time(files):
    assert report(files) == report(files)


def test_damaged_files_and_wrong_names_are_refused(files, tmp_path, capsys):
    bad = tmp_path / "bad.nc"
    data = bytearray(files[0].read_bytes())
    place = data.find(np.array([1.2, 1.41]).tobytes())
    data[place] ^= 1
    bad.write_bytes(data)
    for arguments, word in (
        ([str(bad), "--out", str(tmp_path / "r.html")], "damaged"),
        ([str(files[0]), "--out", str(tmp_path / "r.pdf")], "ends in .html"),
        ([str(tmp_path / "none.nc"), "--out", str(tmp_path / "r.html")], "none.nc"),
    ):
        assert main(["report", *arguments]) == 2
        error = capsys.readouterr().err
        assert word in error and error.count("\n") == 1
    assert not list(tmp_path.glob("r.*"))


def test_the_chain_of_a_driveline_is_drawn_with_the_names_of_its_parts(tmp_path):
    fixed = {"beta": ["8 deg", 0.0, "20 deg"], "phase": [0.0, 0.0, "90 deg"], "ratio": [1, 1, "11/41"]}
    scene = {"system": "driveline", "analysis": "phasing", "parts": ["front", "<b>rear", "axle"], "fixed": fixed}
    dt.run(scene, out=tmp_path / "chain.nc")
    page = Page(report([tmp_path / "chain.nc"]))
    assert page.count["svg"] == 2 and "b" not in page.count
    # A joint of no angle and a gear of ratio 1 are not drawn.
    drawn = {"front", "8 deg", "<b>rear", "axle", "20 deg", "phase 90 deg", "0.268293"}
    assert drawn | {"1 front", "2 <b>rear", "3 axle"} <= set(page.words)
    assert not {"0 deg", "phase 0 deg"} & set(page.words)


def test_ranges_of_a_chart_hold_for_all_other_values():
    said = statements(_described(results.chart()))
    dataset = results.chart()
    everywhere = dataset.Omega.values[(dataset.verdict == 0).all("beta").values]
    (sentence,) = [s for s in said if s.startswith("Stable for all values of beta at ")]
    assert f"{everywhere[0]:.6g}" in sentence and f"{everywhere[-1]:.6g}" in sentence
    assert any(s.startswith("Undecided points") for s in said)


def test_an_undecided_motion_has_no_remedy_by_rtol():
    dataset = _described(results.with_axes(results.grid(np.array([0, 2]), "zeta"), zeta=np.array([0.1, 0.2])))
    dataset["verdict"].attrs["flag_meanings"] = "fixed_point periodic undecided"
    said = "\n".join(statements(dataset.drop_vars("spectral_radius")))
    assert "Undecided at zeta = 0.2." in said and "rtol" not in said


def test_points_without_a_value_are_no_verdicts():
    dataset = _described(results.grid(np.array([[0, 1, 3], [3, 0, 1]]), "beta", "Omega"))
    dataset = results.with_axes(dataset, beta=np.array([0.3, 0.1]), Omega=np.array([1.2, 1.9, 1.4]))
    said = "\n".join(statements(dataset))
    assert "stable 33.333 %, unstable 33.333 %, without a value 33.333 %" in said and "undecided" not in said.lower()
    (_, rows), *_ = values_tables(dataset)
    assert sum("no value" in row for row in rows) == 2
    assert [row[2:4] for row in axes_table(dataset)] == [("0.1", "0.3"), ("1.2", "1.9")]


def test_ranges_of_a_list_are_those_of_its_order():
    dataset = _described(results.grid(np.array([[0, 0, 1]]), "beta", "Omega"))
    dataset = results.with_axes(dataset, beta=np.array([0.3]), Omega=np.array([1.2, 1.9, 1.4]))
    assert any(s.startswith("Stable") and "1.2, 1.9" in s for s in statements(dataset))


def test_few_points_are_tabulated_with_their_places(files):
    ((head, rows),) = values_tables(dt.open_result(files[0]))
    assert [row[head.index("verdict")] for row in rows if row[head.index("Omega")] == "1.415"] == ["unstable"]


TRUCK = {"J1": "2 kg m2", "J2": "0.5 kg m2", "k1": 6e4, "k2": 4e4, "c1": 0.3464, "c2": 0.1414, "angle": "12 deg"}


@pytest.fixture(scope="module")
def truck(tmp_path_factory):
    """Stability and forced motion of a truck shaft at three speeds: unstable, near a forced resonance, and stable."""
    folder, speeds = tmp_path_factory.mktemp("truck"), {"speed": {"values": ["1425 rpm", "1560 rpm", "2000 rpm"]}}
    common = {"system": "cardan", "axes": speeds, "fixed": TRUCK}
    dt.run(common | {"analysis": "floquet", "outputs": ["spectral_radius", "verdict"]}, out=folder / "stability.nc")
    dt.run(common | {"analysis": "forced", "outputs": ["amplitude"]}, out=folder / "forced.nc")
    return folder / "stability.nc", folder / "forced.nc"


@pytest.mark.full
def test_units_are_those_asked_for_or_those_of_the_scene(truck, tmp_path):
    out = tmp_path / "report.html"
    assert main(["report", *map(str, truck), "--out", str(out), "--units", "Hz,mrad"]) == 0
    text = " ".join(Page(out.read_text()).words)
    amplitude = dt.open_result(truck[1]).amplitude.values[1]
    assert (
        "Unstable at speed = 23.75 to 23.8185 (S11) Hz." in text
        and "speed [Hz]" in text
        and "rpm" not in text.split("Scene")[0]
    )
    assert f"to {1e3 * amplitude[1]:.6g} mrad at speed = 26 Hz" in text and " angle joint angle 209.44 mrad" in _plain(
        text
    )
    text = _plain(" ".join(Page(report(truck)).words))
    assert "Unstable at speed = 1425 to 1429.11 (S11) rpm." in text and " angle joint angle 12 deg" in text


@pytest.mark.full
def test_a_unit_that_nothing_measures_is_refused(truck, files, tmp_path, capsys):
    for option, value, words in (
        ("--units", "kg m", "units = 'kg m': nothing in the report measures that; expected units of"),
        ("--units", "rpm,Hz", "units = 'Hz': measures the same as rpm"),
        ("--amplitude", "2 deg", "amplitude = '2 deg': no result has a forced motion to compare"),
        ("--amplitude", "2 mm", "mm is a unit of another quantity"),
    ):
        results = {"2 mm": truck, "2 deg": files[1:]}.get(value, truck[:1])
        assert main(["report", *map(str, results), "--out", str(tmp_path / "r.html"), option, value]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_the_report_says_what_stable_means(truck):
    point = dt.point("cardan", "floquet", speed="1425 rpm", **TRUCK)
    text = " ".join(Page(report(truck[:1])).words)
    growth = point.growth
    assert (
        f"fastest at speed = 1425 rpm: {growth['rate']:.4g} 1/s, by a factor {growth['per_turn']:.6g} per turn; "
        f"it doubles in {growth['time_to_double']:.4g} s, {growth['turns_to_double']:.4g} turns."
    ) in text
    stable = dt.open_result(truck[0]).isel(speed=[2])
    (said,) = [s for s in statements(stable) if s.startswith("Stable means that every small disturbance dies out")]
    assert "it halves in " in said and " 1/s, by a factor 0.99" in said


def _chart(radius: list[float], verdict: list[int]) -> xr.Dataset:
    """Radii and verdicts of a shaft with two periods a turn, over its speed."""
    dataset = results.with_axes(results.grid(np.array(verdict), "Omega"), Omega=1.0 + np.arange(len(radius)))
    dataset["spectral_radius"].values[:] = radius
    return _described(dataset).assign_attrs(periods_per_turn=2)


def _growth(dataset: xr.Dataset) -> list[str]:
    return [s for s in statements(dataset) if s.startswith(("Stable means", "Unstable means"))]


def test_a_factor_per_turn_may_underflow():
    (said,) = _growth(_chart([1e-200, 1e-250], [0, 0]))
    assert f"it halves in {np.log(2) / (400 * np.log(10)):.4g} turns" in said


def test_an_undecided_radius_neither_grows_nor_dies_out():
    (said,) = _growth(_chart([0.9, 1 + 1e-12], [0, 2]))
    assert said.startswith("Stable means") and "slowest at Omega = 1:" in said
    assert _growth(_chart([1.0, 1 + 3e-9], [0, 2])) == []


@pytest.mark.full
def test_the_report_compares_the_forced_motion_with_a_limit(truck):
    amplitude = np.rad2deg(dt.open_result(truck[1]).amplitude.max("shaft").values)
    assert amplitude[2] < 2 < amplitude[1]
    text = " ".join(Page(report(truck, amplitude="2 deg")).words)
    assert f"up to {amplitude[1]:.6g} deg at speed = 1560 rpm, shaft = driven, above the limit of 2 deg" in text
    inside = ", ".join(f"{speed}" for speed in np.array([1425, 1560, 2000])[amplitude <= 2])
    assert f"within it at speed = {inside} rpm." in text
    assert "within the limit of 1.57 rad." in " ".join(Page(report(truck[1:], amplitude=1.57)).words)


@pytest.mark.full
def test_the_report_compares_the_forced_motion_of_a_stability_result(truck):
    stable, amplitude = truck[0], np.rad2deg(dt.open_result(truck[1]).amplitude.values)
    text = _plain(" ".join(Page(report([stable], amplitude="2 deg")).words))
    assert f"where stable: up to {amplitude[1].max():.6g} deg at speed = 1560 rpm, shaft = driven, above" in text
    assert "of 2 deg; within it at speed = 2000 rpm." in text
    # At 1425 rpm the shaft is unstable: no amplitude is within a limit there.
    text = _plain(" ".join(Page(report([stable], amplitude="1.5 rad")).words))
    assert "within the limit of 1.5 rad; within it at speed = 1560 to 2000 rpm." in text


def _plain(text: str) -> str:
    return " ".join(text.split())


def _described(dataset: xr.Dataset) -> xr.Dataset:
    """The synthetic result with the meanings of its codes, as files have them."""
    for name, words in (("verdict", "stable unstable undecided"), ("outcome", "success remark failure")):
        dataset[name].attrs |= {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": words}
    return dataset


def test_a_report_on_modes_of_one_kind_begins_with_the_speeds_of_the_orders():
    chain = {"J": [1.0, 0.5, 2.0], "k": [1e4, 2e4, 3e4], "beta": [0.1, 0.0, 0.0]}
    said = statements(dt.run({"system": "driveline", "analysis": "modes", "fixed": chain}))
    assert said[0] == "Order 2 (joints) meets modes at 214.959, 756.706, 1639.14 rpm of the driving end."
    assert not any("torsional" in sentence or "Share" in sentence for sentence in said)
