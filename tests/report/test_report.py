"""Reports: the answer, the figure and the scene of every result in one page that is complete in itself."""

from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from drivetrain_jax.report import report
from drivetrain_jax.report.statements import statements, values_table
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
    assert "Stability of the equilibrium: stable 50 %, unstable 50 %." in text
    assert "Unstable at Omega = 1.41 to 1.415." in text
    first = float(dt.open_result(files[1]).critical_speed[0])
    assert f"Critical speed: {first:.6g}" in text and f"{first:.6g}" in page.words
    assert f"Order 2 (joints) meets modes at {first / 2:.6g}, " in text


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


def test_ranges_of_a_chart_hold_for_all_other_values():
    said = statements(_described(results.chart()))
    dataset = results.chart()
    everywhere = dataset.Omega.values[(dataset.verdict == 0).all("beta").values]
    (sentence,) = [s for s in said if s.startswith("Stable for all values of beta at ")]
    assert f"{everywhere[0]:.6g}" in sentence and f"{everywhere[-1]:.6g}" in sentence
    assert any(s.startswith("Undecided points") for s in said)


def test_few_points_are_tabulated_with_their_places(files):
    rows = values_table(dt.open_result(files[0]))
    assert ("verdict", "Omega = 1.415", "unstable", "1") in rows


def _described(dataset: xr.Dataset) -> xr.Dataset:
    """The synthetic result with the meanings of its codes, as files have them."""
    for name, words in (("verdict", "stable unstable undecided"), ("outcome", "success remark failure")):
        dataset[name].attrs |= {"flag_values": np.array([0, 1, 2], np.int8), "flag_meanings": words}
    return dataset
