"""A validation page in Markdown, made of sections with tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measure import provenance

FOLDER = Path(__file__).parents[2] / "docs" / "validation"
Rows = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Page:
    """The validation page of one system: ``title``, ``introduction`` and ``sections`` in Markdown."""

    title: str
    introduction: str
    sections: Sequence[str]

    def write(self, system: str, full: bool) -> Path:
        """Write docs/validation/<system>.md with the machine and the versions at its end."""
        command = f"python -m benchmarks.validation {system}{' --full' if full else ''}"
        head = f"# {self.title}\n\n{self.introduction} Written by `{command}`; do not edit.\n"
        facts = provenance()
        path = FOLDER / f"{system}.md"
        FOLDER.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([head, *self.sections, f"{facts['machine']}; {facts['versions']}.\n"]))
        return path


def markdown(head: Sequence[str], rows: Rows) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def inventory(system: str, **found: str) -> str:
    """The section that names every equation, figure, table and conclusion of the paper, from inventory/<system>.txt.

    A line has five cells; ``{name}`` is replaced by a value of ``found``, which is computed for the page.
    """
    lines = (Path(__file__).parent / "inventory" / f"{system}.txt").read_text().splitlines()
    rows = [[cell.strip().format(**found) for cell in line.split(" | ")] for line in lines]
    head = ("place", "where it is computed", "the paper", "ours", "agreement, or the reason")
    text = "Files without a folder of their own stand in `drivetrain_jax/`.\n"
    return f"## Every equation, figure, table and conclusion\n\n{text}\n{markdown(head, rows)}"
