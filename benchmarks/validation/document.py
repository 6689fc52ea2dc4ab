"""A validation page in Markdown, made of sections with tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.measure import Line, markdown, provenance

FOLDER = Path(__file__).parents[2] / "docs" / "validation"


class Page(NamedTuple):
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
        path.write_text("\n".join([head, *self.sections, f"{facts['machine']}; {facts['versions']}.\n"]))
        return path


def section(title: str, text: str, head: Line, rows: Sequence[Line]) -> str:
    """A section with an optional text above its table."""
    return "\n\n".join(filter(None, (f"## {title}", text, table(head, rows))))


def table(head: Line, rows: Sequence[Line]) -> str:
    """A Markdown table that ends with a newline."""
    return markdown(head, rows) + "\n"


def inventory(system: str, **found: str) -> str:
    """The section that names every equation, figure, table and conclusion of the paper, from inventory/<system>.txt.

    A line has five cells; ``{name}`` is replaced by a value of ``found``, which is computed for the page.
    """
    lines = (Path(__file__).parent / "inventory" / f"{system}.txt").read_text().splitlines()
    head = "place | where it is computed | the paper | ours | agreement, or the reason"
    text = "Files without a folder of their own stand in `drivetrain_jax/`."
    rows = [line.strip().format(**found) for line in lines]
    return section("Every equation, figure, table and conclusion", text, head, rows)
