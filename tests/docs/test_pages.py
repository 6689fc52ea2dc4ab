"""Commands and scenes that README and documentation show: the commands parse, the scenes are accepted."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from drivetrain_jax.cli import parser
from drivetrain_jax.runs.scene import load_scene

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "theory").glob("*.md"))]
COMMANDS = [
    (page.name, line)
    for page in PAGES
    for line in re.findall(r"^(?: {4}|\$ )(?:\.venv/bin/)?drivetrain (.*)$", page.read_text(), re.M)
]


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_commands_parse(page, line):
    # What stands after a gap or in brackets is an explanation.
    words = shlex.split(re.split(r"\s{3,}|\s\[", line)[0], comments=True)
    with pytest.raises(SystemExit) if "--help" in words else pytest.MonkeyPatch.context():
        parser().parse_args([word for word in words if word != "..."])
    scenes = [word for word in words if word.startswith("sweeps/")]
    assert all((ROOT / scene).exists() for scene in scenes)


def test_there_are_commands():
    assert len(COMMANDS) > 20


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda p: p.name)
def test_links_within_the_repository_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_the_scene_of_the_quickstart_is_accepted():
    (text,) = re.findall(r"^```toml\n(.*?)^```", (ROOT / "docs" / "quickstart.md").read_text(), re.M | re.S)
    assert load_scene(tomllib.loads(text)).title == "Joint angle and speed"
