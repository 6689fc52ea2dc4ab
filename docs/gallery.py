"""Compute (or resume) and draw every scene of sweeps/, and list all figures on one page; `make gallery`.

Skips complete scenes, and figures that are newer than their results and the drawing code. The constants of a single point
are a table, on the page and as CSV.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any

import xarray as xr

import drivetrain_jax
from drivetrain_jax import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.datasets.accessor import write_csv
from drivetrain_jax.runs.atlas_chart import chart
from drivetrain_jax.runs.output import status
from drivetrain_jax.runs.run import Incomplete, ProgressLine, run_to_file
from drivetrain_jax.store.consolidate import open_result
from drivetrain_jax.systems import get_system, system_names

SCENES = Path(__file__).parents[1] / "sweeps"
PACKAGE = Path(drivetrain_jax.__file__).parent
CELLS = 600
# Charts of an atlas over more than two parameters: title -> fixed parameters, as for `drivetrain plot --part`.
PARTS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "cardan_atlas_4d": {
        "Angle over speed, equal shafts, four-parameter atlas": {"mu": 1.0, "alpha": 1.0},
        "Angle over speed, strongly damped driven shaft, four-parameter atlas": {"mu": 1.0, "alpha": 20.0},
        "Damping of the driven shaft over speed, four-parameter atlas": {"beta": 0.5235987755982988, "mu": 1.0},
        "Angle over speed, stiff driven shaft, four-parameter atlas": {"mu": 20.0, "alpha": 1.0},
        "Stiffness of the driven shaft over speed, four-parameter atlas": {"beta": 0.5235987755982988, "alpha": 1.0},
    }
}
# Charts in the range of an atlas, whose boundaries and tips are drawn over their cells: scene of the chart -> of the atlas.
TRACED = {"quickstart": "cardan_atlas", "cardan_fig2b": "cardan_fig3_atlas", "cardan_fig3": "cardan_fig3_atlas"}


@dataclass(frozen=True)
class Item:
    """One figure: its scenes (methods of one analysis with one title, or a chart and its atlas), and the fixed parameters if
    it shows an atlas."""

    title: str
    system: str
    scenes: tuple[Path, ...]
    part: Mapping[str, float] = field(default_factory=dict)
    number: int = 0

    @property
    def name(self) -> str:
        """Name of the figure without its ending."""
        return self.scenes[0].stem + (f"_{self.number}" if self.number else "")


def items(folder: Path) -> list[Item]:
    """The figures, by system, in the order of the scenes' names."""
    scenes = {path: tomllib.loads(path.read_text()) for path in sorted(folder.glob("*.toml"))}
    order = {name: place for place, name in enumerate(system_names())}
    shared: dict[tuple[str, str, str], list[Path]] = {}
    for path, scene in scenes.items():
        shared.setdefault((scene["system"], scene["analysis"], scene["title"]), []).append(path)
    found = []
    for (system, _, title), paths in sorted(shared.items(), key=lambda pair: order[pair[0][0]]):
        parts = PARTS.get(paths[0].stem, {title: {}})
        several = len(parts) > 1
        paths += [folder / f"{TRACED[path.stem]}.toml" for path in paths if path.stem in TRACED]
        found += [
            Item(name, system, tuple(paths), part, number if several else 0)
            for number, (name, part) in enumerate(parts.items(), 1)
        ]
    return found


def compute(scene: Path, folder: Path) -> Path:
    """Compute or resume a scene and return the path of its result; a stale result is replaced."""
    out = folder / f"{scene.stem}.nc"
    with ProgressLine() as show:
        run_to_file(scene, out, fresh=status(scene, out).state == "stale", report=show)
    return out


def draw(item: Item, results: Sequence[Path], figure: Path) -> None:
    """Write the figure unless it is newer than its results and the drawing code."""
    code = [*PACKAGE.glob("view/*.py"), Path(__file__)]
    if any(tomllib.loads(scene.read_text())["analysis"] == "atlas" for scene in item.scenes):
        code += [*PACKAGE.glob("atlas/*.py"), PACKAGE / "runs" / "atlas_chart.py"]
    newest = max(path.stat().st_mtime for path in (*results, *code))
    if figure.exists() and figure.stat().st_mtime > newest:
        return
    datasets = [open_result(path) for path in results]
    if datasets[0].attrs["analysis"] == "parameters" and datasets[0]["outcome"].size == 1:
        write_csv(results[0], figure.with_suffix(".csv"))
        return
    if datasets[0].attrs["analysis"] == "atlas":
        datasets = [chart(ds, item.part, CELLS).assign_attrs(title=item.title) for ds in datasets]
    drivetrain_jax.plot(*datasets).savefig(figure)


def shown(item: Item, folder: Path) -> str:
    """The figure of an item, or its table of constants, as Markdown."""
    values = folder / f"{item.name}.csv"
    if not values.exists():
        return f"![{item.title}]({item.name}.png)\n"
    columns = zip(*csv.reader(values.read_text().splitlines()), strict=True)
    lines = [["name", "value", "units"], ["---"] * 3]
    for header, value in columns:
        name, _, units = header.removesuffix("]").partition(" [")
        lines += [[name, f"{float(value):.6g}", units]] if name != "outcome" else []
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + f"\n\n[The table as CSV]({values.name})\n"


def explore(item: Item, results: Sequence[Path], folder: Path) -> None:
    """Write the page of an atlas beside its first figure, if there is none yet or the result or its code is newer."""
    if item.number > 1 or tomllib.loads(item.scenes[0].read_text())["analysis"] != "atlas":
        return
    page = folder / f"{item.scenes[0].stem}.html"
    newest = max(path.stat().st_mtime for path in (results[0], *PACKAGE.glob("explore/*"), *PACKAGE.glob("atlas/*.py")))
    if not page.exists() or page.stat().st_mtime < newest:
        page.write_text(drivetrain_jax.open_atlas(results[0]).explore().text)


def answered(title: str) -> str:
    """The figures, tables and sections of the source that a title names."""
    return ", ".join(re.findall(r"(?:Figs?\.?|Tables?|section) \d+\w?(?:(?:,| and| to) \d+)*", title))


def remarks(scene: Path) -> str:
    """The comments at the head of a scene as paragraphs; indented lines are code."""
    head = [line.removeprefix("#") for line in takewhile(lambda x: x.startswith("#"), scene.read_text().splitlines())]
    blocks = [(code, list(lines)) for code, lines in groupby(head, lambda line: line.startswith("     "))]
    texts = [
        "\n".join(["```text", *map(str.strip, x), "```"]) if code else " ".join(map(str.strip, x)) for code, x in blocks
    ]
    return "\n\n".join(texts)


def counts(dataset: xr.Dataset) -> str:
    """Points and time, and how many points are undecided or without a value."""
    if "outcome" not in dataset:
        return f"{int(dataset.attrs['solves']):,} direct solves, {dataset.attrs['wall_time_s']:.1f} s"
    outcome = dataset["outcome"].values
    parts = [f"{outcome.size:,} points", f"{dataset.attrs['wall_time_s']:.1f} s"]
    if "undecided" in dataset.get("verdict", xr.DataArray()).attrs.get("flag_meanings", "").split():
        code = dataset["verdict"].attrs["flag_meanings"].split().index("undecided")
        parts.append(f"undecided {int((dataset['verdict'] == code).sum()):,}")
    failed = {o.name.lower(): int((outcome == o).sum()) for o in Outcome if o is not Outcome.SUCCESS}
    return ", ".join([*parts, *(f"{name} {count:,}" for name, count in failed.items() if count)])


def entry(item: Item, results: Sequence[Path], problem: str, remarked: bool) -> Iterator[str]:
    """The page's text for one figure; scenes that are ``remarked`` on above need no remarks."""
    source = get_system(item.system).source.partition(";")[0]
    answer = answered(item.title)
    yield f"### {item.title}\n"
    yield (f"Answers: {answer} of {source}." if answer else "Beyond the source.") + "\n"
    if not remarked:
        yield "\n\n".join(filter(None, map(remarks, item.scenes))) + "\n"
    yield f"{problem}\n" if problem else shown(item, results[0].parent)
    page = f"{item.scenes[0].stem}.html"
    if results and (results[0].parent / page).exists():
        yield f"[The atlas as a page]({page}), by `drivetrain explore`.\n"
    runs = [f"$ drivetrain run sweeps/{path.name} --out {path.stem}.nc" for path in item.scenes]
    files = " ".join(f"{path.stem}.nc" for path in item.scenes)
    part = "".join(f" {name}={value:.10g}" for name, value in item.part.items())
    if results and (results[0].parent / f"{item.name}.csv").exists():
        runs.append(f"$ drivetrain export {files} --csv {item.name}.csv")
    else:
        runs.append(f"$ drivetrain plot {files} --out {item.name}.png" + (f" --part{part}" if part else ""))
    yield "\n".join(["```console", *runs, "```\n"])
    yield "; ".join(counts(open_result(path)) for path in results if path.exists()) + ".\n"


def render(item: Item, folder: Path) -> tuple[list[Path], str]:
    """Compute and draw one item; returns the paths of its results and an error message, empty without an error."""
    results: list[Path] = []
    try:
        results = [compute(scene, folder) for scene in item.scenes]
    except Incomplete as error:
        return results, f"Not finished: {error}."
    try:
        draw(item, results, folder / f"{item.name}.png")
        explore(item, results, folder)
    except InputError as error:
        return results, f"No figure: {error}."
    return results, ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, draw, write `index.md`; 1 if a scene could not be finished."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="where results, figures and index.md go")
    parser.add_argument("--scenes", type=Path, default=SCENES, help="folder of the scenes")
    parser.add_argument("names", nargs="*", help="only scenes of these names (without .toml)")
    given: Any = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    chosen = [i for i in items(given.scenes) if not given.names or {s.stem for s in i.scenes} & set(given.names)]
    text: list[str] = []
    unfinished = 0
    for number, item in enumerate(chosen, 1):
        sys.stderr.write(f"[{number}/{len(chosen)}] {item.title}\n")
        if number == 1 or item.system != chosen[number - 2].system:
            text.append(f"## {get_system(item.system).title}\n")
        results, problem = render(item, given.folder)
        unfinished += problem.startswith("Not finished")
        remarked = number > 1 and item.scenes == chosen[number - 2].scenes
        text += entry(item, results, problem, remarked)
    if not given.names:
        (given.folder / "index.md").write_text("\n".join(text))
    return 1 if unfinished else 0


if __name__ == "__main__":
    sys.exit(main())
