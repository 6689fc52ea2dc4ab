"""The page: its texts in Node; the whole of it in a headless Chromium, where there is one."""

from __future__ import annotations

import json
import subprocess
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax.cli import main
from tests.atlases import SHAFT, stored_atlas
from tests.explore.browser import CHROMIUM, Browser
from tests.explore.conftest import NODE, columns

HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 2'>&{{DATA}}"
FOLDER = Path(__file__).parent
needs_node = pytest.mark.skipif(NODE is None, reason="no node on this machine")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def two(atlases, tmp_path_factory):
    page = tmp_path_factory.mktemp("page") / "two.html"
    atlases("two")
    assert main(["explore", str(atlases.folder / "two.nc"), "--out", str(page)]) == 0
    return page


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


def texts(page, fragment=""):
    done = subprocess.run([NODE, str(FOLDER / "texts.mjs"), str(page), fragment], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.full
@needs_node
def test_a_copied_scene_is_the_visible_chart(atlases, two):
    told = texts(two, "view.Omega=1.2:1.6&view.beta=0.1:0.7")
    scene = tomllib.loads(told["scene"])
    assert scene["axes"]["Omega"] == {"start": 1.2, "stop": 1.6, "num": 5} and scene["title"] == "atlas two"
    result = dt.run(scene, overrides={"axes.beta.num": 2, "axes.Omega.num": 2})
    expected = columns(atlases("two"), np.array([[0.1, 1.2], [0.1, 1.6], [0.7, 1.2], [0.7, 1.6]]))
    assert result.spectral_radius.values.ravel() == pytest.approx(expected["spectral_radius"], rel=1e-7)


@needs_node
def test_a_copied_command_gives_the_value_of_the_point(atlases, two, capfd):
    told = texts(two, "beta=0.6&Omega=1.4")
    assert main([*told["command"].split()[1:], "--json"]) == 0
    value = json.loads(capfd.readouterr().out)["values"]["spectral_radius"]["value"]
    assert value == pytest.approx(columns(atlases("two"), np.array([[0.6, 1.4]]))["spectral_radius"][0], rel=1e-8)


@needs_node
def test_curves_lie_on_the_boundary(atlases, two):
    """The verdict changes within a cell of every point of a curve."""
    told = texts(two, "view.Omega=1.0:2.0")
    points = np.reshape(told["boundary"], (-1, 2))[::7]
    cell = np.array([1.0, 1.6]) / 200
    sides = [
        columns(atlases("two"), np.clip(points + s * cell, [1.0, -0.2], [2.0, 1.4])[:, ::-1])["verdict"]
        for s in corners()
    ]
    assert len(points) > 50 and (np.ptp(sides, axis=0) == 1).all()


def corners():
    return [np.array([x, y]) for x in (-1, 0, 1) for y in (-1, 0, 1)]


@pytest.mark.full
@needs_node
def test_resonances_are_those_of_the_system(atlases, two, tmp_path):
    from drivetrain_jax.resonances import CARDAN

    (tmp_path / "four.html").write_text(atlases("four").explore().text)
    for page, mu in ((two, 1.0), (tmp_path / "four.html", 1.2)):
        expected = dict(zip(CARDAN.labels, CARDAN.values({"mu": mu, "gamma": 100.0}), strict=True))
        told = texts(page, f"mu={mu}")["resonances"]
        assert len(told) == 15 and {x["label"]: x["value"] for x in told} == pytest.approx(
            {x["label"]: expected[x["label"]] for x in told}, rel=1e-9
        )


@needs_node
def test_the_address_holds_the_state(two):
    fragment = (
        "beta=0.5&Omega=1.3&x=beta&y=Omega&view.Omega=1:1.5&map=growth&angle=deg&J=0.02&k=800&speed=rpm&band=1:1.2"
    )
    state = texts(two, fragment)["state"]
    assert state["hash"] == texts(two, state["hash"])["state"]["hash"]
    assert set(fragment.split("&")) <= set(state["hash"].split("&"))
    # What is not valid is left out.
    wrong = texts(two, "beta=9&Omega=x&x=no&view.Omega=3:1&J=-1&band=5")["state"]
    assert wrong["panes"][0]["values"] == [1.4, 1.1] and wrong["lower"] == [-0.2, 0.2] and wrong["axes"] == [0, 1]


@needs_node
def test_the_page_begins_with_the_data_that_the_file_knows(tmp_path):
    """A shaft of a data sheet is shown in rpm and degrees, with rounded numbers; the address keeps other choices."""
    (tmp_path / "page.html").write_text(stored_atlas(SHAFT).explore().text)
    told = texts(tmp_path / "page.html")
    assert told["state"]["units"] == {"angle": "deg", "speed": "rpm", "J": 2, "k": 6e4}
    assert (
        "angle = 12 deg" in told["fixed"]
        and "k2 = 40000 N m/rad" in told["fixed"]
        and "J=" not in told["state"]["hash"]
    )
    assert [(seen["symbol"], seen["unit"]) for seen in told["seen"]] == [("speed", "Hz"), ("c1", "N m s/rad")]
    assert [seen["factor"] for seen in told["seen"]] == pytest.approx([(6e4 / 2) ** 0.5 / (2 * np.pi), 2 * 12e4**0.5])
    # A copied scene is that of the data sheet.
    scene = tomllib.loads(told["scene"])
    assert scene["fixed"] == SHAFT["fixed"]
    assert scene["axes"] == {name: {**ends, "num": 5} for name, ends in SHAFT["axes"].items()}
    assert "'speed=23.5 Hz'" in told["command"] and "angle=12.0" in told["command"]
    other = texts(tmp_path / "page.html", "angle=rad&speed=1&J=3")["state"]
    assert other["units"] == {"angle": "rad", "speed": "1", "J": 3, "k": 6e4}
    assert {"angle=rad", "speed=1", "J=3"} <= set(other["hash"].split("&"))


@needs_node
def test_texts_and_colours(two):
    told = texts(two)
    assert told["words"] == ["H₁₂", "C⁺₁", "odd", "0.333333", "none"]
    assert told["ticks"] == ["0.25", "0.50", "0.75", "1.00", "1.25", "1.50", "1.75", "2.00"]
    # Beta rises upwards: the slow, wide angle is unstable, the small one stable.
    assert (
        told["bottom"] == [255, 255, 255, 255] and told["most"] == [45, 10, 43] and told["neutral"] == [208, 224, 239]
    )
    assert told["csv"][0] == "beta,Omega,spectral_radius,spectral_radius_error,verdict"
    assert told["csv"][1].startswith("-0.2,0.2,0.") and told["csv"][1].endswith(",stable")
    assert "<script>" not in told["svg"] and "&#60;script&#62;" in told["svg"]


def test_hostile_words_cannot_end_the_data(atlases):
    """Every `<` of the data is escaped; the template's marks in a title are not filled in."""
    whole = atlases("two")
    text = replace(whole, scene=replace(whole.scene, title=HOSTILE)).explore().text
    assert "<script>window.hacked" not in text and "<img" not in text
    data = text.split('id="data">')[1].split("</script>")[0]
    assert json.loads(data)["title"] == HOSTILE
    # Scripts of the page: evaluation, data, page.
    assert text.count("<script") == 3 == text.count("</script>")


def test_a_page_is_small_and_asks_for_nothing(two, atlases):
    text = two.read_text()
    assert len(text) < 1.5e6
    assert not [
        word
        for word in ("http:", "https:", "@import", "url(")
        if word in text.replace("http://www.w3.org/2000/svg", "").replace('"url(#cells)"', "")
    ]
    assert "default-src 'none'" in text


def test_a_system_whose_coordinates_the_page_lacks_is_refused(atlases):
    whole = atlases("two")
    inside = whole.stability.atlas
    odd = replace(inside.coordinates[1], name="sin(Omega)", forward=np.sin)
    changed = replace(inside, coordinates=(inside.coordinates[0], odd))
    with pytest.raises(dt.InputError, match=r"^Omega: its coordinate 'sin\(Omega\)' is not one that the page computes"):
        replace(whole, stability=replace(whole.stability, atlas=changed)).explore()


def test_damaged_and_foreign_files_are_refused_in_one_line(atlases, tmp_path, capfd):
    atlases("two")
    content = bytearray((atlases.folder / "two.nc").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 64] = bytes(64)
    (tmp_path / "damaged.nc").write_bytes(content)
    (tmp_path / "foreign.nc").write_text("no result")
    page = tmp_path / "page.html"
    for name, out in (
        ("damaged.nc", page),
        ("foreign.nc", page),
        ("absent.nc", page),
        ("damaged.nc", tmp_path / "page.txt"),
    ):
        assert main(["explore", str(tmp_path / name), "--out", str(out)]) == 2
        error = capfd.readouterr().err
        assert error.startswith("drivetrain: ") and error.count("\n") == 1 and not out.exists()


@pytest.mark.full
def test_a_notebook_shows_the_page(atlases):
    atlas = atlases("two")
    with xr.open_dataset(atlases.folder / "two.nc", engine="h5netcdf") as dataset:
        assert dataset.drivetrain.explore().text == atlas.explore().text
    with xr.open_dataset(atlases.folder / "two.nc", engine="drivetrain") as lazy:
        assert lazy.drivetrain.explore().text == atlas.explore().text
    shown = atlas.explore()._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "<script" not in shown


SETTLED = "!drivetrain.app.busy && drivetrain.app.level >= 512"


@needs_chromium
def test_chromium_evaluates_as_python_does(browser, atlases, two):
    browser.open(two)
    points = np.random.default_rng(3).uniform([-0.2, 0.2], [1.4, 2.0], (2000, 2))
    each = "([beta, Omega]) => Object.values(drivetrain.evaluate({beta, Omega}))"
    told = browser.run(f"drivetrain.ready.then(() => {json.dumps(points.tolist())}.map({each}))")
    rho, error, verdict = np.transpose(told)
    ours = columns(atlases("two"), points)
    assert (verdict == ours["verdict"]).all()
    assert (np.abs(rho - ours["spectral_radius"]) <= np.minimum(error, ours["spectral_radius_error"])).all()
    assert browser.run("drivetrain.evaluate({beta: 3, Omega: 1}).verdict") == 2
    assert browser.run(
        "(() => { try { drivetrain.evaluate({beta: 1}) } catch (e) { return e.message } })()"
    ).startswith("Omega: missing")


def cells(browser):
    return browser.run(
        "drivetrain.app.panes.map((p) => [...p.grid.verdict].reduce((a, v) => (a[v]++, a), [0, 0, 0, 0]))"
    )


@needs_chromium
def test_a_reader_uses_the_page(browser, two, tmp_path):
    browser.open(two)
    browser.wait(SETTLED)
    ((stable, unstable, *other),) = cells(browser)
    assert stable > unstable > 10_000 and sum(other) < 10
    # Keys: the point moves, the view is zoomed, and the address follows.
    browser.run("document.querySelector('.stack').focus()")
    before = browser.run("drivetrain.app.state.panes[0].values[1]")
    for key in ("ArrowRight", "+", "+"):
        browser.call("Input.dispatchKeyEvent", type="keyDown", key=key)
    assert browser.run("drivetrain.app.state.panes[0].values[1]") == pytest.approx(before + 0.005 * 1.8)
    browser.wait("location.hash.includes('view.Omega') && " + SETTLED)
    assert cells(browser)[0][0] != stable
    # The wheel zooms about the pointer, a click sets the point, dragging moves the view.
    left, top = browser.run(
        "(() => { const r = document.querySelector('.stack').getBoundingClientRect(); return [r.x + 300, r.y + 200] })()"
    )
    span = "drivetrain.app.state.upper[1] - drivetrain.app.state.lower[1]"
    wide = browser.run(span)
    browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=left, y=top, deltaX=0, deltaY=-200)
    browser.wait(f"{span} < {wide * 0.9}")
    press(browser, left, top, left, top)
    assert browser.run("document.querySelector('.readout').textContent").count("nearest change") in (0, 2)
    low = browser.run("drivetrain.app.state.lower[1]")
    press(browser, left, top, left - 80, top)
    browser.wait(f"drivetrain.app.state.lower[1] > {low}")
    browser.wait("document.querySelector('.readout').textContent.includes('nearest change along β')")
    browser.screenshot(tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 30_000 and browser.problems() == []


def press(browser, x0, y0, x1, y1):
    browser.call("Input.dispatchMouseEvent", type="mousePressed", x=x0, y=y0, button="left", clickCount=1)
    for part in (0.3, 0.6, 1.0) if (x0, y0) != (x1, y1) else ():
        browser.call(
            "Input.dispatchMouseEvent",
            type="mouseMoved",
            x=x0 + part * (x1 - x0),
            y=y0 + part * (y1 - y0),
            button="left",
            buttons=1,
        )
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", x=x1, y=y1, button="left", clickCount=1)


def count(pane):
    """The number of unstable cells of a chart, as an expression."""
    return f"drivetrain.app.panes[{pane}].grid.verdict.filter((v) => v === 1).length"


@needs_chromium
@pytest.mark.full
def test_two_charts_compare_two_dampings(browser, atlases, tmp_path):
    page = tmp_path / "three.html"
    page.write_text(atlases("three").explore().text)
    browser.open(page, "#zeta=0.0005&compare=1&B.zeta=0.02&angle=deg&J=0.02&k=800&speed=rpm&band=0.9:1.1")
    browser.wait(SETTLED)
    little, much = cells(browser)
    assert little[1] > 1.2 * much[1]
    assert browser.run("document.querySelectorAll('.pane').length") == 2
    assert "growth per second" in browser.run("document.querySelector('.readout').textContent")
    assert "rpm" in browser.run("document.querySelector('[data-slider=\"1 0\"]').getAttribute('aria-valuetext')")
    # A slider of the second chart moves that chart alone.
    slider = "document.querySelector('[data-slider=\"2 1\"]')"
    browser.run(f"{slider}.value = 0.025, {slider}.dispatchEvent(new Event('input'))")
    browser.wait("drivetrain.app.state.panes[1].values[2] === 0.0005")
    browser.wait(f"{SETTLED} && Math.abs({count(1)} / {count(0)} - 1) < 0.001")
    browser.screenshot(tmp_path / "compare.png")
    assert browser.problems() == []


@needs_chromium
@pytest.mark.full
@pytest.mark.parametrize("name", ["one", "four", "mathieu"])
def test_atlases_of_other_parameters_are_drawn(browser, atlases, tmp_path, name):
    page = tmp_path / f"{name}.html"
    page.write_text(atlases(name).explore().text)
    browser.open(page)
    browser.wait("!drivetrain.app.busy && drivetrain.app.level >= 256")
    assert all(count[0] and count[1] for count in cells(browser)) and browser.problems() == []


@needs_chromium
def test_hostile_words_run_nothing(browser, atlases, tmp_path):
    whole = atlases("two")
    (tmp_path / "page.html").write_text(replace(whole, scene=replace(whole.scene, title=HOSTILE)).explore().text)
    browser.open(tmp_path / "page.html")
    browser.wait(SETTLED)
    assert browser.run("window.hacked === undefined && document.querySelector('h1').textContent") == HOSTILE
    assert browser.run("document.title") == HOSTILE and browser.problems() == []


@needs_chromium
@pytest.mark.full
def test_the_page_works_in_a_frame_and_without_workers(browser, atlases, tmp_path):
    """A notebook shows a frame; its policy may forbid workers."""
    shown = atlases("two").explore()._repr_html_()
    (tmp_path / "frame.html").write_text(f"<script>window.drivetrain = true</script>{shown}")
    browser.open(tmp_path / "frame.html")
    inside = "document.querySelector('iframe').contentWindow.drivetrain"
    browser.wait(f"{inside} && !{inside}.app.busy && {inside}.app.level >= 256")
    plain = atlases("two").explore().text.replace("worker-src blob:", "worker-src 'none'")
    (tmp_path / "plain.html").write_text(plain)
    browser.open(tmp_path / "plain.html")
    browser.wait(SETTLED)
    assert cells(browser)[0][1] > 10_000
