"""Figures with panels placed in inches, so that text has the same size for one panel as for nine."""

from __future__ import annotations

import io
import math
import re
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from drivetrain_jax.view.style import FRAME_GREY, STYLE, caption

WIDTH = 7.0
DPI = 200
_NOTEBOOK_DPI = 100
_LABEL_SIZE = 8.5
# Height of a line of a label in inches, with a margin.
_LABEL_LINE = 0.16
_INCHES_PER_LETTER = 0.068
_CLEAR = 0.07
# Space below the legend in inches.
_FOOT = 0.04
_INCHES_PER_ENTRY = 0.45
# The place in a paper at either end of a title: it says nothing to a reader without the paper.
_PAPER = re.compile(r"[^:]*\b(?:Figs?\.?|Tables?|section) \d[^:]*: |, (?:Figs?\.?|Tables?) \d.*$")
_TITLE_SIZE, _SMALLEST_TITLE, _ELLIPSIS = 10.5, 7.0, "\u2026"
_CAPTION_SIZE, _CAPTION_TOP, _CAPTION_LINE, _CAPTION_GAP = 8, 0.32, 0.14, 0.04


@dataclass(frozen=True)
class Margins:
    """Margins around and between the panels, and from the panels to the vertical label, in inches."""

    left: float = 0.75
    right: float = 0.95
    top: float = 0.85
    bottom: float = 0.90
    between_rows: float = 0.22
    between_columns: float = 0.20
    label: float = 0.44


class NotebookFigure(Figure):
    """A figure that a notebook shows as the result of a cell, without pyplot."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        image = io.BytesIO()
        self.savefig(image, format="png")
        width, height = self.get_size_inches()
        # As large as a figure of pyplot, with full resolution for dense screens.
        return image.getvalue(), {"width": round(width * _NOTEBOOK_DPI), "height": round(height * _NOTEBOOK_DPI)}


class Panels:
    """A figure of ``rows x columns`` equal panels with title, caption and legend.

    ``axes[row][column]`` share the horizontal axis, and with ``share_y`` the vertical axis.
    """

    def __init__(
        self, rows: int = 1, columns: int = 1, *, height: float, margins: Margins | None = None, share_y: bool = True
    ) -> None:
        self.margins = m = margins or Margins()
        width = (WIDTH - m.left - m.right - (columns - 1) * m.between_columns) / columns
        total = m.top + m.bottom + rows * height + (rows - 1) * m.between_rows
        self.figure = NotebookFigure(figsize=(WIDTH, total), dpi=DPI)
        self.axes: list[list[Axes]] = []
        first: Axes | None = None
        for row in range(rows):
            bottom = total - m.top - (row + 1) * height - row * m.between_rows
            self.axes.append([])
            for column in range(columns):
                box = self._box(m.left + column * (width + m.between_columns), bottom, width, height)
                axes = self.figure.add_axes(box, sharex=first, sharey=first if share_y else None)
                axes.tick_params(labelbottom=row == rows - 1, labelleft=column == 0)
                first = first or axes
                self.axes[-1].append(axes)

    def _box(self, left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
        total = self.figure.get_figheight()
        return left / WIDTH, bottom / total, width / WIDTH, height / total

    def colorbar(self, axes: Axes, mapped: ScalarMappable, label: str, **options: Any) -> None:
        """Add a colour bar in the right margin next to ``axes``."""
        box = axes.get_position()
        bar = self.figure.add_axes((box.x1 + 0.10 / WIDTH, box.y0, 0.14 / WIDTH, box.height), label="colour bar")
        self.figure.colorbar(mapped, cax=bar, label=_wrap(label, box.height * self.figure.get_figheight()), **options)
        bar.tick_params(labelsize=7.5)

    def label_axes(self, horizontal: str, vertical: str = "") -> None:
        """Add one label for all horizontal axes and one for all vertical axes, wrapped to the extent of the panels."""
        self._label_side([row[0] for row in self.axes], vertical)
        first, last = self.axes[0][0].get_position(), self.axes[-1][-1].get_position()
        x, y = (first.x0 + last.x1) / 2, last.y0 - 0.36 / self.figure.get_figheight()
        text = _wrap(horizontal, (last.x1 - first.x0) * WIDTH)
        self.figure.text(x, y, text, ha="center", va="center", size=_LABEL_SIZE)
        # All columns share a power of ten, which stands at the right end, clear of the label.
        for row in self.axes:
            for axes in row[:-1]:
                axes.xaxis.get_offset_text().set_visible(False)

    def label_row(self, axes: Axes, vertical: str) -> None:
        """Add a label for the vertical axis of one row."""
        self._label_side([axes], vertical)

    def _label_side(self, beside: Sequence[Axes], text: str) -> None:
        top, bottom = beside[0].get_position().y1, beside[-1].get_position().y0
        usual = self.axes[0][0].get_position().x0 - self.margins.label / WIDTH
        x = min(usual, *(_left_of_numbers(axes) for axes in beside))
        text = _wrap(text, (top - bottom) * self.figure.get_figheight())
        missing = (text.count("\n") + 1) * _LABEL_LINE / WIDTH - x
        if text and missing > 0:
            self._move_left_edge(missing)
            x += missing
        self.figure.text(
            x, (bottom + top) / 2, text, ha="right", va="center", multialignment="center", rotation=90, size=_LABEL_SIZE
        )

    def _move_left_edge(self, shift: float) -> None:
        """Make the panels narrower, so that wide numbers leave space for the label."""
        left, right = self.axes[0][0].get_position().x0, self.axes[0][-1].get_position().x1
        narrower = (right - left - shift) / (right - left)
        for axes in (axes for row in self.axes for axes in row):
            box = axes.get_position()
            x0, x1 = (right - (right - x) * narrower for x in (box.x0, box.x1))
            axes.set_position((x0, box.y0, x1 - x0, box.height))
        # Labels of other rows keep their distance from the numbers.
        for text in self.figure.texts:
            text.set_x(text.get_position()[0] + (shift if text.get_rotation() else 0.0))

    def titles(self, dataset: xr.Dataset, note: str = "") -> None:
        """Add the scene's title and, below it, the fixed parameters (and ``note``)."""
        left = self.margins.left / WIDTH
        text = "; ".join(part for part in (caption(dataset), note) if part)
        room = int((self.margins.top - _CAPTION_TOP) / _CAPTION_LINE)
        text = wrap_caption(text, WIDTH - self.margins.left - 0.1, max(room, 1))
        if text:
            self._clear_top(_CAPTION_TOP + _CAPTION_LINE * (text.count("\n") + 1) + _CAPTION_GAP)
        write_title(self.figure, dataset, self.margins.left)
        total = self.figure.get_figheight()
        self.figure.text(left, 1 - _CAPTION_TOP / total, text, va="top", size=_CAPTION_SIZE, color=FRAME_GREY)

    def _clear_top(self, inches: float) -> None:
        """Make the figure taller if labels above the panels reach into its upper ``inches``."""
        boxes = [box for axes in self.axes[0] if (box := axes.get_tightbbox()) is not None]
        total = self.figure.get_figheight()
        self._grow(inches - (total - max(box.y1 for box in boxes) / self.figure.dpi), 0.0)

    def _grow(self, missing: float, lift: float) -> None:
        """Make the figure taller by ``missing`` inches, if positive, and lift everything by ``lift`` inches."""
        if missing <= 0:
            return
        total = self.figure.get_figheight()
        self.figure.set_figheight(total + missing)
        ratio, rise = total / (total + missing), lift / (total + missing)
        for axes in self.figure.axes:
            box = axes.get_position()
            axes.set_position((box.x0, box.y0 * ratio + rise, box.width, box.height * ratio))
        for text in self.figure.texts:
            text.set_y(text.get_position()[1] * ratio + rise)

    def legend(self, handles: Sequence[Artist]) -> None:
        """Add one legend for the whole figure in the bottom margin, in as many rows as it needs; the figure grows if these
        reach into the labels above."""
        length = sum(_INCHES_PER_ENTRY + _INCHES_PER_LETTER * len(_plain(handle.get_label())) for handle in handles)
        rows = max(math.ceil(length / (WIDTH - self.margins.left)), 1)
        legend = self.figure.legend(
            handles=handles,
            loc="lower left",
            bbox_to_anchor=(self.margins.left / WIDTH, _FOOT / self.figure.get_figheight()),
            ncols=max(math.ceil(len(handles) / rows), 1),
            borderaxespad=0.2,
            borderpad=0.0,
            columnspacing=1.4,
            handlelength=2.0,
        )
        above = [box for axes in self.axes[-1] if (box := axes.get_tightbbox()) is not None]
        above += [text.get_window_extent() for text in self.figure.texts if not text.get_rotation()]
        missing = (legend.get_window_extent().y1 - min(box.y0 for box in above)) / self.figure.dpi + _CLEAR
        self._grow(missing, missing)
        legend.set_bbox_to_anchor((self.margins.left / WIDTH, _FOOT / self.figure.get_figheight()))


def _left_of_numbers(axes: Axes) -> float:
    """Right end of a label left of the numbers of the vertical axis, relative to the figure's width."""
    box = axes.yaxis.get_tightbbox()
    return box.x0 / axes.figure.bbox.width - _CLEAR / WIDTH if box else 1.0


def shown_title(dataset: xr.Dataset) -> str:
    """The scene's title without the number of a figure or table of a paper."""
    title = _PAPER.sub("", str(dataset.attrs.get("title", "")))
    return title[:1].upper() + title[1:]


def write_title(figure: Figure, dataset: xr.Dataset, left: float) -> None:
    """Write the scene's title from ``left`` (inches) on; a title that is too long is set smaller, then truncated."""
    title, room = shown_title(dataset), WIDTH - left - 0.1
    size = max(min(_TITLE_SIZE, _TITLE_SIZE * room / max(_title_length(title), 1e-9)), _SMALLEST_TITLE)
    limit = 1.001 * room * _TITLE_SIZE / size
    if _title_length(title) > limit:
        letters = bisect_right(range(1, len(title)), limit, key=lambda n: _title_length(title[:n] + _ELLIPSIS))
        title = title[:letters] + _ELLIPSIS
    figure.text(
        left / WIDTH, 1 - 0.10 / figure.get_figheight(), title, va="top", size=size, weight="bold", parse_math=False
    )


def _title_length(title: str) -> float:
    """Length in inches of a title at full size, with a margin for pixel rounding of letters."""
    # A title is free text, in which a dollar sign need not begin a formula.
    title = title.replace("$", r"\$")
    bold = FontProperties(family=STYLE["font.sans-serif"], weight="bold")
    length = TextPath((0, 0), title, size=_TITLE_SIZE, prop=bold).get_extents().width if title.strip() else 0.0
    return 1.05 * length / 72


def _wrap(text: str, inches: float) -> str:
    # Do not break next to a minus sign.
    words = text.replace(" - ", "\u00a0-\u00a0").split(" ")
    return "\n".join(
        _fill(words, max(inches, 20 * _INCHES_PER_LETTER), lambda line: len(_plain(line)) * _INCHES_PER_LETTER)
    )


def _fill(parts: Sequence[str], inches: float, length: Callable[[str], float]) -> list[str]:
    """``parts`` joined to lines of ``inches``, without a break within a part."""
    lines = [parts[0]]
    for part in parts[1:]:
        longer = f"{lines[-1]} {part}"
        if length(longer) <= inches:
            lines[-1] = longer
        else:
            lines.append(part)
    return lines


def wrap_caption(text: str, inches: float, lines: int) -> str:
    """``text`` in at most ``lines`` lines, broken between its parts and never within a formula; an ellipsis ends a text
    that is too long."""
    wrapped = _fill(re.split(r"(?<=[,;]) (?![^\[]*\])", text), inches, _caption_length)
    if len(wrapped) > lines:
        wrapped = [*wrapped[: lines - 1], f"{wrapped[lines - 1].rstrip(',;')}, {_ELLIPSIS}"]
    return "\n".join(wrapped)


def _caption_length(line: str) -> float:
    """Length of a line of the caption in inches."""
    return TextPath((0, 0), line, size=_CAPTION_SIZE).get_extents().width / 72 if line.strip() else 0.0


def _plain(label: object) -> str:
    """The letters of a label without formula marks."""
    return re.sub(r"[$^_{}]|\\(?:mathrm)?", "", str(label))
