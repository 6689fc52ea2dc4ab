"""The page for engineers: its files are written, its commands run, and their answers are those of the page."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path

import pytest

from drivetrain_jax.cli import main

pytestmark = pytest.mark.docs

PAGE = Path(__file__).parents[2] / "docs" / "engineering.md"
NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?(?![\w.])")


def agree(answer: str, shown: str) -> bool:
    """True if the words are equal, and the numbers up to the rounding of another processor."""
    words = [" ".join(NUMBER.sub("#", text).split()) for text in (answer, shown)]
    pairs = zip(*(map(float, NUMBER.findall(text)) for text in (answer, shown)), strict=False)
    return words[0] == words[1] and all(math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-8) for a, b in pairs)


def commands(text: str) -> list[tuple[str, str]]:
    """The commands of the page in order, each with the answer that it shows."""
    sessions = re.findall(r"^```console\n(.*?)^```", text, re.M | re.S)
    return [
        (line, answer)
        for session in sessions
        for line, answer in re.findall(r"^\$ (.*)\n((?:[^$].*\n)*)", session, re.M)
    ]


def test_every_command_gives_the_answer_of_the_page(tmp_path, monkeypatch, capsys):
    text = PAGE.read_text()
    for name, content in re.findall(r"^```\w+\n# (\w+\.\w+)\n(.*?)^```", text, re.M | re.S):
        (tmp_path / name).write_text(f"# {name}\n{content}")
    monkeypatch.chdir(tmp_path)
    found = commands(text)
    assert len(found) >= 11
    for line, answer in found:
        words = shlex.split(line)
        if words[0] == "head":
            shown = "".join(Path(words[2]).read_text().splitlines(keepends=True)[: -int(words[1])])
        else:
            assert words[0] == "drivetrain" and main(words[1:]) == 0, line
            shown = capsys.readouterr().out
        if answer or words[0] == "head":
            assert agree(answer, shown), f"{line}\n{shown}"
    page = Path("report.html").read_text()
    # The three narrow ranges cover 41 of 3800 rpm.
    assert "Stability of the equilibrium at the points computed: stable 98.9" in page
    for answer in (
        "Stable from speed = 1429.11 rpm to speed = 2270.73 rpm",
        "by a factor 1.01",
        "within the limit of 2 deg.",
    ):
        assert answer in page


@pytest.mark.parametrize("number", ["1421.84 to 1429.11 rpm", "2.534", "3646.5 rpm"])
def test_the_answers_of_the_issue_are_on_the_page(number):
    """Values of an independent computation; the test above compares the page with the program."""
    assert number in PAGE.read_text()
