"""The gallery on two scenes that cost nothing, and what it makes of the scenes of the package."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import gallery  # noqa: E402

pytestmark = pytest.mark.docs

SCENE = """# A remark.
title = "{title}"
system = "tripod"
analysis = "parameters"
outputs = ["natural_angular_frequency"]
[axes]
beta = {{ start = 0.0, stop = 0.1, num = {num} }}
[fixed]
element = "input"
"""


@pytest.fixture
def folders(tmp_path):
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    (scenes / "a.toml").write_text(SCENE.format(title="Figs 9 and 10: frequencies", num=3))
    (scenes / "b.toml").write_text(SCENE.format(title="One cell for each", num=5))
    return scenes, tmp_path / "out"


def state(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir() if path.suffix != ".md"}


def test_only_changed_figures_are_made_again(folders, monkeypatch):
    scenes, out = folders
    monkeypatch.setenv("DRIVETRAIN_JAX_CACHE", "0")
    arguments = ["--scenes", str(scenes), str(out)]
    assert gallery.main(arguments) == 0
    first = state(out)
    assert set(first) == {"a.nc", "a.png", "b.nc", "b.png"}
    page = (out / "index.md").read_text()
    assert "Answers: Figs 9 and 10 of Bugaru" in page and "Beyond the source." in page and "A remark." in page
    assert "$ drivetrain plot a.nc --out a.png" in page and "3 points" in page
    assert gallery.main(arguments) == 0
    assert state(out) == first
    (scenes / "b.toml").write_text(SCENE.format(title="One cell for each", num=4))
    assert gallery.main(arguments) == 0
    second = state(out)
    assert {name for name in first if first[name] != second[name]} == {"b.nc", "b.png"}


def test_constants_of_one_point_are_a_table(folders, monkeypatch):
    scenes, out = folders
    monkeypatch.setenv("DRIVETRAIN_JAX_CACHE", "0")
    (scenes / "a.toml").write_text(
        re.sub(r"\[axes]\n.*\n\[fixed]", "[fixed]\nbeta = 0.1", SCENE.format(title="Constants", num=3))
    )
    (scenes / "b.toml").unlink()
    assert gallery.main(["--scenes", str(scenes), str(out)]) == 0
    assert set(state(out)) == {"a.nc", "a.csv"}
    value = float(gallery.open_result(out / "a.nc")["natural_angular_frequency"])
    page = (out / "index.md").read_text()
    assert f" | {value:.6g} | rad/s |" in page and "--csv a.csv" in page and "a.png" not in page


def test_every_scene_has_its_place():
    items = gallery.items(gallery.SCENES)
    assert {s.name for item in items for s in item.scenes} == {p.name for p in (ROOT / "sweeps").glob("*.toml")}
    assert len({item.name for item in items}) == len(items)
    of_a_paper = [item for item in items if any(mark in item.name for mark in ("_fig", "_table", "_section"))]
    assert len(of_a_paper) > 40 and all(gallery.answered(item.title) for item in of_a_paper)
