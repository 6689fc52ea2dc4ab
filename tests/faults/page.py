"""The parts of docs/reliability.md that programs write."""

from __future__ import annotations

from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"


def write(name: str, content: str, page: Path = PAGE) -> None:
    """Replace what `make NAME` wrote there before."""
    begin, end = f"<!-- {name}: written by `make {name}` -->", f"<!-- end of {name} -->"
    before, found, rest = page.read_text().partition(begin)
    after = rest.partition(end)[2]
    assert found, f"{page}: no mark {begin}"
    page.write_text(f"{before}{begin}\n\n{content}\n\n{end}{after}")
