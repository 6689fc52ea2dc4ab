"""A figure of panels with title, caption and one legend, laid out by matplotlib; scales of axes, and names beside curves."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

from drivetrain_jax.view.style import FRAME_GREY, caption

WIDTH = 7.0
_DPI, _NOTEBOOK_DPI = 200, 100
# Mean width of a letter of a label, and height of the horizontal axis with its label, in inches.
_LETTER, _FOOT = 0.068, 0.55
# Letters in a line of the title, and in a line below the panels.
_TITLE_LETTERS, LETTERS = 80, 100
# The place in a paper at either end of a title: it says nothing to a reader without the paper.
_PAPER = re.compile(r"[^:]*\b(?:Figs?\.?|Tables?|section) \d[^:]*: |, (?:Figs?\.?|Tables?) \d.*$")
# Height of a colour bar below a panel, with its numbers and label, in inches.
_BELOW = 0.6
# Distance of two names beside points and of two above points, and the largest shift of a name, in points.
_SPACING, _MOST_SHIFT = (9.5, 14.5), 24
# A number in matplotlib's language of formulas, and the characters of its exponent.
_NUMBER, _RAISED = re.compile(r"\$\\mathdefault\{(.*)\}\$"), str.maketrans("0123456789−", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
# Distance from its point below which a name needs no line to it, in points.
_NEAR = 5.0


class NotebookFigure(Figure):
    """A figure that a notebook shows as the result of a cell, without pyplot."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        image = io.BytesIO()
        self.savefig(image, format="png")
        width, height = self.get_size_inches()
        # As large as a figure of pyplot, with full resolution for dense screens.
        return image.getvalue(), {"width": round(width * _NOTEBOOK_DPI), "height": round(height * _NOTEBOOK_DPI)}


def plain_labels(format_ticks: Callable[[Any], list[str]], values: Any) -> list[str]:
    """The labels ``format_ticks(values)``; formulas of numbers become plain text, because parsing them takes long."""

    def plain(label: str) -> str:
        if not (number := _NUMBER.fullmatch(label)):
            return label
        text = number[1].replace(r"\times", "×").replace("-", "−")
        return re.sub(r"\^\{(.*)\}", lambda power: power[1].translate(_RAISED), text)

    return [plain(label) for label in format_ticks(values)]


class Sheet:
    """A figure of ``rows x columns`` panels ``axes[row, column]``, each about ``height`` inches high.

    Panels share the horizontal and the vertical axis unless ``options`` of :meth:`matplotlib.figure.Figure.subplots` say
    otherwise.
    """

    def __init__(self, rows: int = 1, columns: int = 1, *, height: float, **options: Any) -> None:
        self.figure = NotebookFigure(figsize=(WIDTH, rows * height), dpi=_DPI, layout="constrained")
        shared: dict[str, Any] = {"sharex": True, "sharey": True} | options
        self.axes = self.figure.subplots(rows, columns, squeeze=False, **shared)
        self._height = height
        self._entries: dict[str, Artist] = {}
        self._late: list[Callable[[], None]] = []
        self._more = 0.0

    def add(self, *entries: Artist) -> None:
        """Add entries to the legend; of entries with the same label the first counts."""
        for entry in entries:
            self._entries.setdefault(str(entry.get_label()), entry)

    def later(self, write: Callable[[], None]) -> None:
        """Call ``write`` when the figure has its height, because texts in points depend on it.

        Panels then have matplotlib's usual positions, a few percent from those of the layout, which takes longer.
        """
        self._late.append(write)

    def label(self, horizontal: str, *vertical: str) -> None:
        """Label the horizontal axes, and the vertical axes: one label for all rows, or one for each."""
        rows, columns = self.axes.shape
        for axes in self.axes[-1]:
            # Several narrow panels have their power of ten at the right end.
            axes.set_xlabel(_fill(horizontal, 0.85 * WIDTH / columns), loc="center" if columns == 1 else "left")
        if rows > len(vertical):
            self.figure.supylabel(_fill(" ".join(vertical), rows * self._height), size=8.5)
            return
        for axes, text in zip(self.axes[:, 0], vertical, strict=True):
            axes.set_ylabel(_fill(text, self._height))

    def colorbar(
        self, rows: Sequence[int], mapped: ScalarMappable, label: str, options: Mapping[str, Any], below: bool = False
    ) -> None:
        """Add a colour bar to rows of panels, at the right or ``below`` them: other rows then keep the whole width."""
        size = WIDTH if below else len(rows) * self._height
        place: dict[str, Any] = {"location": "bottom" if below else "right", "aspect": 6 * size, "pad": 0.015}
        bar = self.figure.colorbar(mapped, ax=self.axes[list(rows)].ravel().tolist(), **place, **options)
        bar.set_label(_fill(label, size))
        if isinstance(mapped.norm, LogNorm):
            plain_decades(bar.ax, "x" if below else "y")
        bar.ax.tick_params(labelsize=7.5)
        self._more += _BELOW * below

    def finish(self, dataset: xr.Dataset, note: str = "") -> Figure:
        """The figure with the scene's title above it, and the fixed parameters (and ``note``) and the legend below."""
        figure, entries = self.figure, list(self._entries.values())
        text = textwrap.fill(shown_title(dataset), _TITLE_LETTERS, break_on_hyphens=False)
        title = figure.suptitle(text, x=0.01, ha="left", weight="bold", parse_math=False)
        # Lines end between parameters, not within one.
        about = re.sub(r"(?<![,;]) | (?=[^\[]*\])", "\u00a0", "; ".join(filter(None, (caption(dataset), note))))
        about = "; ".join(filter(None, (about, dataset.attrs.get("proof"))))
        about = textwrap.fill(about, LETTERS, break_long_words=False, break_on_hyphens=False)
        look: dict[str, Any] = {"loc": "outside lower left", "alignment": "left", "borderpad": 0, "columnspacing": 1.4}
        for columns in range(len(entries) or 1, 0, -1):
            legend = figure.legend(handles=entries, ncols=columns, title=about, **look)
            # At other resolutions letters are a few percent wider.
            if columns == 1 or legend.get_window_extent().width <= 0.94 * figure.bbox.width:
                break
            legend.remove()
        legend.get_title().set_color(FRAME_GREY)
        around = sum(artist.get_window_extent().height for artist in (title, legend)) / figure.dpi
        figure.set_figheight(len(self.axes) * self._height + self._more + around + _FOOT)
        figure.align_ylabels()
        for formatter in (axis.get_major_formatter() for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
            if not isinstance(formatter.format_ticks, partial):
                formatter.format_ticks = partial(plain_labels, formatter.format_ticks)
        for write in self._late:
            write()
        return figure


def shown_title(dataset: xr.Dataset) -> str:
    """The scene's title without the number of a figure or table of a paper."""
    title = _PAPER.sub("", str(dataset.attrs.get("title", "")))
    return title[:1].upper() + title[1:]


def _fill(text: str, inches: float) -> str:
    """``text`` in lines of about this length; no line begins or ends with a minus sign."""
    letters = max(int(inches / _LETTER), 24)
    text = text.replace(" - ", "\u00a0-\u00a0")
    return textwrap.fill(text, letters, break_long_words=False, break_on_hyphens=False)


def is_logarithmic(values: np.ndarray) -> bool:
    """True if ``values`` are spaced by a constant factor rather than a constant step."""
    if len(values) < 3 or values[0] <= 0:
        return False
    steps, factors = np.diff(values), np.diff(np.log(values))
    return bool(np.ptp(factors) < 1e-6 * np.abs(factors).max() and np.ptp(steps) > 1e-6 * np.abs(steps).max())


def cell_edges(values: np.ndarray) -> np.ndarray:
    """The ``n + 1`` edges of cells around ``n`` rising values: midpoints of neighbours (of logarithms on a logarithmic
    axis); outer cells are symmetric about their value."""
    return np.exp(_midway(np.log(values))) if is_logarithmic(values) else _midway(values)


def _midway(values: np.ndarray) -> np.ndarray:
    if len(values) == 1:
        half = abs(values[0]) / 2 or 0.5
        return np.array([values[0] - half, values[0] + half])
    inner = (values[1:] + values[:-1]) / 2
    return np.concatenate([[2 * values[0] - inner[0]], inner, [2 * values[-1] - inner[-1]]])


def fit_axis(axes: Axes, which: str, values: np.ndarray) -> None:
    """Set scale and limits of one axis from the cells around ``values``; a logarithmic axis shows plain numbers."""
    edges = cell_edges(values)
    logarithmic = is_logarithmic(values)
    axes.set(**{f"{which}scale": "log" if logarithmic else "linear", f"{which}lim": (edges[0], edges[-1])})
    if logarithmic:
        plain_decades(axes, which)


def plain_decades(axes: Axes, which: str) -> None:
    """Set plain numbers at 1, 2, 5 (over many decades only at 1) along a logarithmic axis, or powers of ten if plain numbers
    are long."""
    low, high = getattr(axes, f"get_{which}lim")()
    side = getattr(axes, f"{which}axis")
    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    # %g writes a million as 1e+06.
    side.set_major_formatter(plain if low >= 1e-4 and high < 0.99e6 else LogFormatterMathtext())
    side.set_minor_formatter(NullFormatter())


def write_names(
    axes: Axes,
    points: Any,
    names: Sequence[str],
    *,
    above: bool = False,
    inside: bool = False,
    offset: float = 3.0,
    **look: Any,
) -> None:
    """Write ``names`` to the right of ``points`` (or ``above``), ``offset`` points away, with a line to a name that moved.

    Names that would leave ``axes`` on the right stand at the left, if all are to be ``inside``. Names keep the order of
    their points. Where there is no space for all, the first stay. ``look`` goes to
    :meth:`matplotlib.axes.Axes.annotate`, but for ``colours``: one for all names, or one for each.
    """
    colours = look.pop("colours", FRAME_GREY)
    colours = [colours] * len(names) if isinstance(colours, str) else list(colours)
    scale, spacing, axis = 72 / axes.figure.dpi, _SPACING[above], 0 if above else 1
    places = np.array([axes.transData.transform(point)[axis] for point in points]) * scale
    span = axes.bbox.get_points()[:, axis] * scale + (-spacing, spacing)
    kept: list[int] = []
    shifts = np.empty(0)
    for k in range(len(names)):
        trial = sorted([*kept, k], key=lambda i: places[i])
        moved = _apart(places[trial], spacing, *span) - places[trial]
        if (np.abs(moved) <= _MOST_SHIFT).all():
            kept, shifts = trial, moved
    for k, shift in zip(kept, shifts, strict=True):
        line = {"arrowstyle": "-", "linewidth": 0.5, "color": colours[k], "shrinkA": 1, "shrinkB": 0}
        style: dict[str, Any] = {"ha": "center", "va": "bottom"} if above else {"ha": "left", "va": "center"}
        beyond = max(offset, _NEAR + 4) if abs(shift) > 1 else offset
        right = axes.transData.transform(points[k])[0] * scale + beyond + 72 * _LETTER * len(names[k])
        if inside and right > axes.bbox.x1 * scale:
            style["ha"], beyond = "right", -beyond
        if offset > _NEAR or abs(shift) > 1:
            style["arrowprops"] = line | {"relpos": (0.5, 0.0) if above else (float(beyond < 0), 0.5)}
        style |= {"size": 7.5, "color": colours[k], "annotation_clip": False, "textcoords": "offset points"} | look
        axes.annotate(names[k], points[k], (shift, beyond) if above else (beyond, shift), **style)


def _apart(wanted: np.ndarray, spacing: float, low: float, high: float) -> np.ndarray:
    """The nearest places to the rising ``wanted`` ones that are ``spacing`` apart: the largest shift is least."""
    offsets = spacing * np.arange(len(wanted))
    free = wanted - offsets
    middle = (np.maximum.accumulate(free) + np.minimum.accumulate(free[::-1])[::-1]) / 2
    return np.clip(middle, low, high - offsets[-1]) + offsets


def widen(axes: Axes, which: str, share: float, least: float = 0.0) -> None:
    """Widen the limits to this share of the values at least, so that tiny differences do not fill the panel."""
    low, high = getattr(axes, f"get_{which}lim")()
    missing = max(share * max(abs(low), abs(high)), least) - (high - low)
    if missing > 0:
        axes.set(**{f"{which}lim": (low - missing / 2, high + missing / 2)})
