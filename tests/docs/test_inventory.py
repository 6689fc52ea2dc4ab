"""Every equation, figure, table and conclusion of a paper is named on its validation page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]
TITLE = "## Every equation, figure, table and conclusion"
# Equations without those with a letter, figures, tables; conclusions and whatever else the paper states.
PAPERS = {
    "cardan": (26, 7, 2, ("Conclusion ", 7), ("Section 6", 2)),
    "tripod": (39, 30, 4, ("Conclusion ", 8), ("Appendix ", 2)),
    "bicardan": (31, 4, 0, ("Conclusion ", 5), ("Section 4", 3)),
    "planetary": (40, 12, 7, ("Conclusion: ", 7)),
    "rattle": (63, 3, 1, ("Conclusion ", 3), ("Statement: ", 5)),
}


def rows(system: str) -> list[list[str]]:
    text = (ROOT / "docs" / "validation" / f"{system}.md").read_text().partition(TITLE)[2].partition("\n## ")[0]
    table = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table[2:]]


def numbers(places: list[str]) -> list[int]:
    """Numbers of the equations, ranges expanded: (30a) is 30, (8)-(10) are 8, 9, 10."""
    found = []
    for place in places:
        ends = [int(x) for x in re.findall(r"\((\d+)[a-z]?\)", place)]
        found += range(ends[0], ends[-1] + 1)
    return found


@pytest.mark.parametrize("system", PAPERS)
def test_nothing_is_unnamed(system):
    equations, figures, tables, *statements = PAPERS[system]
    places = [row[0] for row in rows(system)]
    assert len(places) == len(set(places))
    assert sorted(set(numbers([p for p in places if p.startswith("(")]))) == list(range(1, equations + 1))
    for name, count in (("Fig. ", figures), ("Table ", tables)):
        assert [p for p in places if p.startswith(name)] == [f"{name}{i}" for i in range(1, count + 1)]
    for begin, count in statements:
        assert sum(p.startswith(begin) for p in places) == count


@pytest.mark.parametrize("system", PAPERS)
def test_every_row_says_where_and_whether_it_agrees(system):
    for row in rows(system):
        assert len(row) == 5 and all(row), row
        place = row[1].strip("`")
        assert any((ROOT / folder / place).is_file() for folder in (".", "drivetrain_jax")), row


@pytest.mark.parametrize("system", PAPERS)
def test_the_page_has_the_lines_of_its_list(system):
    lines = (ROOT / "benchmarks" / "validation" / "inventory" / f"{system}.txt").read_text().splitlines()
    found = rows(system)
    assert len(lines) == len(found)
    for line, row in zip(lines, found, strict=True):
        pattern = r".*?".join(re.escape(part) for part in re.split(r"\{\w+\}", line.strip()))
        assert re.fullmatch(pattern, " | ".join(row)), row
