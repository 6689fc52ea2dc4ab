"""The explorer's page: one HTML file with the modules of this folder and the data of an atlas."""

from __future__ import annotations

import html
import json
import re
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING

from drivetrain_jax.explore.pack import pack

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_file import StoredAtlas

# Modules of the worker and of the page, in the order of their imports.
_EVALUATION = ("linear.js", "quartic.js", "evaluate.js", "grid.js", "worker.js")
_PAGE = ("chart.js", "marks.js", "text.js", "pane.js", "page.js")
_IMPORT = re.compile(r'^import [^;]*? from "\./[\w.]+";\n', re.MULTILINE)
# Height of the page in a notebook.
_HEIGHT = "820px"


@dataclass(frozen=True)
class Page:
    """A page as text; a notebook shows it in a frame."""

    text: str

    def __repr__(self) -> str:
        return f"explorer, {len(self.text) / 1e6:.2f} MB of HTML"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {_HEIGHT}; border: 0"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}" title="explorer"></iframe>'


def explore(stored: StoredAtlas) -> Page:
    """The page that evaluates ``stored`` in a browser.

    Raises: InputError for a system whose coordinates or reversal the page cannot compute.
    """
    data = pack(stored)
    # Inside a script element, `<` could begin its end, whatever a title holds.
    packed = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(data["title"] or data["system"]["title"]),
        "STYLE": _read("style.css"),
        "EVALUATION": _joined(_EVALUATION),
        "PAGE": _joined(_PAGE),
        "DATA": packed,
    }
    return Page(re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read("template.html")))


def _joined(names: tuple[str, ...]) -> str:
    """Modules as one classic script: names are shared, so imports and exports are left out."""
    return "\n".join(re.sub(r"^export ", "", _IMPORT.sub("", _read(name)), flags=re.MULTILINE) for name in names)


def _read(name: str) -> str:
    return files("drivetrain_jax.explore").joinpath(name).read_text("utf-8")
