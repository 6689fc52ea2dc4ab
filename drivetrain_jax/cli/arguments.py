"""The command-line parser: commands, arguments and the text of ``--help``."""

from __future__ import annotations

import argparse
import errno
import os
import re
import sys
from pathlib import Path
from typing import Any, NoReturn

from drivetrain_jax import __version__, _units
from drivetrain_jax._wording import clipped, did_you_mean, nearest
from drivetrain_jax.cli import commands
from drivetrain_jax.cli.replies import WRONG_INPUT, one_line


class _Parser(argparse.ArgumentParser):
    """A parser whose usage errors are one line, with the exit code for wrong input."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        self._words: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse, and keep the words for messages."""
        self._words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(args, namespace)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse; values may follow options, and the command itself reports an unknown argument."""
        options, unknown = self.parse_known_args(args, namespace)
        if "given" in options:
            values = [word for word in unknown if "=" in word and not word.startswith("-")]
            options.given = [*options.given, *values]
            unknown = [word for word in unknown if word not in values]
        if unknown:
            first = next((word for word in unknown if word.startswith("-")), unknown[0])
            known = re.findall(r"--[a-z]+", options.parser.format_help())
            options.parser.error(f"{first}: not an argument of this command{_meant(first, known)}")
        return options

    def error(self, message: str) -> NoReturn:
        reworded = _reworded(message)
        if message.startswith("the following arguments are required: "):
            known = re.findall(r"--[a-z]+", self.format_help())
            typed = [word.partition("=")[0] for word in self._words if re.match("-+[a-zA-Z]", word)]
            # A misspelt option is why another one is missing.
            strange = next((word for word in typed if word not in known and _meant(word, known)), None)
            if strange:
                reworded = f"{strange}: not an argument of this command{_meant(strange, known)}"
        self.exit(WRONG_INPUT, one_line(f"{reworded}; see {self.prog} --help"))


def _meant(word: str, known: list[str]) -> str:
    """The option that an unknown ``word`` is like; for ``name=value`` the option that changes a scene."""
    if "--set" in known and (value := re.fullmatch(r"-*((?:fixed|axes|options)\.)?([\w\[\].]+=.+)", word)):
        return f" (did you mean --set {value.group(1) or 'fixed.'}{value.group(2)}?)"
    if re.fullmatch("-[a-zA-Z]", word):
        alike = [option for option in known if option.startswith(f"-{word.lower()}")]
        return f" (did you mean {alike[0]}?)" if alike else ""
    return did_you_mean(word, known) if word.startswith("-") else ""


def _reworded(message: str) -> str:
    """A message of argparse, reworded like all other messages."""
    if choice := re.fullmatch(r"argument ([\w-]+): invalid choice: '(.*)' \(choose from (.*)\)", message):
        field, given, allowed = choice.group(1), choice.group(2), choice.group(3).replace("'", "").split(", ")
        return f"{field} = {given!r}: unknown{nearest(given, allowed)}"
    if kind := re.fullmatch(r"argument ([\w-]+): invalid (int|float|_part) value: (.*)", message):
        return f"{kind.group(1)} = {kind.group(3)}: allowed is {'an integer' if kind.group(2) == 'int' else 'a number'}"
    if empty := re.fullmatch(r"argument ([\w-]+): expected one argument", message):
        return f"{empty.group(1)}: its value is missing; a value that begins with - is written {empty.group(1)}=VALUE"
    if place := re.fullmatch(r"argument ([\w.-]+): (.*: .*; allowed is a path .*)", message, re.DOTALL):
        return f"{place.group(1)} = {place.group(2)}"
    if missing := re.fullmatch(r"the following arguments are required: (.*)", message):
        first, *others = missing.group(1).split(", ")
        return f"{first}: missing" + (f" (missing too: {', '.join(others)})" if others else "")
    return message


def _part(text: str) -> float:
    """A part of a whole, such as 0.02 or 2%."""
    try:
        return float(text)
    except ValueError:
        return _units.number(text, "1")


def _path(text: str) -> Path:
    """A path of valid length; the command checks if the file exists."""
    try:
        os.stat(text)
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            reason = f"{clipped(text)!r}: {error.strerror}; allowed is a path that the system can open"
            raise argparse.ArgumentTypeError(reason) from None
    # The shell leaves the ~ of --out=~/r.nc alone.
    return Path(text).expanduser()


def parser() -> argparse.ArgumentParser:
    """The parser of all commands; the result has the function of the command as ``command``."""
    whole = _Parser(
        prog="drivetrain",
        description="Compute stability and vibration of drivetrains, and draw the results.",
        epilog="Start with `drivetrain list`. `drivetrain COMMAND --help` describes a command.",
    )
    whole.add_argument("--version", action="version", version=__version__)
    subparsers = whole.add_subparsers(metavar="COMMAND", required=True)

    for add in _COMMANDS:
        add(subparsers)
    return whole


def _add_list(subparsers: Any) -> None:
    command = _command(subparsers, "list", commands.list_systems, "list systems, analyses, parameters and scenes")
    command.add_argument("system", nargs="?", metavar="SYSTEM", help="describe this system")


def _add_run(subparsers: Any) -> None:
    command = _command(subparsers, "run", commands.run, "compute a scene, or resume an interrupted run")
    _add_scene(command)
    command.add_argument(
        "--fresh", action="store_true", help="compute all points again; replace result and unfinished work"
    )
    command.add_argument("--threads", type=int, metavar="N", help="number of threads (default: usable cores)")
    command.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="N Dask workers instead of threads, as --dask local:N; a worker may crash",
    )
    command.add_argument(
        "--dask", metavar="ADDRESS", help="Dask cluster instead of threads: tcp://HOST:PORT or local:N"
    )
    command.add_argument(
        "--reuse",
        action="append",
        default=[],
        metavar="FILE.nc",
        type=_path,
        help="reuse the common points of this result; a smaller result at --out is always reused",
    )
    command.add_argument(
        "--store", choices=("hdf5", "zarr"), help="zarr: workers write a Zarr store (default if so named)"
    )
    command.add_argument("--quiet", action="store_true", help="print only the last line")


def _add_status(subparsers: Any) -> None:
    command = _command(subparsers, "status", commands.status, "show how much of a scene is computed")
    _add_scene(command)
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_verify(subparsers: Any) -> None:
    command = _command(
        subparsers, "verify", commands.verify, "compare all checksums of a result, and apply the rules of its analysis"
    )
    command.add_argument("file", metavar="FILE.nc", type=_path, help="result, finished or not")
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_export(subparsers: Any) -> None:
    command = _command(subparsers, "export", commands.export, "write a Zarr store as one HDF5 file, or a result as CSV")
    command.add_argument("store", metavar="RESULT", type=_path, help="a Zarr store, or with --csv any result on a grid")
    command.add_argument("file", metavar="FILE.nc", nargs="?", type=_path, help="HDF5 file to write")
    command.add_argument(
        "--csv",
        nargs="?",
        const="",
        metavar="TABLE.csv",
        help="write a table (default: RESULT.csv): one row a point, units in the header, codes as words",
    )


def _add_plot(subparsers: Any) -> None:
    command = _command(subparsers, "plot", commands.plot, "draw the figure of a result")
    command.add_argument(
        "files",
        metavar="FILE.nc",
        type=_path,
        nargs="+",
        help="results; overlaid: methods of one analysis, or a chart and its atlas",
    )
    command.add_argument(
        "--out",
        required=True,
        metavar="FIGURE",
        type=_path,
        help="figure (.png, .pdf, .svg) or table of constants (.txt, .csv)",
    )
    command.add_argument(
        "--part", nargs="+", default=[], metavar="name=LOW:HIGH", help="part of an atlas: ranges, or name=value"
    )
    command.add_argument("--cells", type=int, metavar="N", help="cells per axis for an atlas (default: 800)")
    command.add_argument("--units", metavar="rpm,deg", help="units of the axes (default: those of the scene)")


def _add_report(subparsers: Any) -> None:
    command = _command(
        subparsers, "report", commands.report, "write a report on results: one HTML file that prints well"
    )
    command.add_argument("files", metavar="FILE.nc", type=_path, nargs="+", help="results, one section each")
    command.add_argument("--out", required=True, metavar="REPORT.html", type=_path, help="page to write")
    command.add_argument("--title", metavar="TEXT", help="heading (default: the title of the scene)")
    command.add_argument("--units", metavar="rpm,deg", help="units of the report (default: those of the scenes)")
    _add_amplitude(command)


def _add_point(subparsers: Any) -> None:
    command = _command(subparsers, "point", commands.point, "compute one point")
    command.add_argument("system", metavar="SYSTEM", help="name from `drivetrain list`")
    command.add_argument("analysis", metavar="ANALYSIS", help="name from `drivetrain list SYSTEM`")
    _add_given(command, "parameters in the units of `drivetrain list SYSTEM`, options, and outputs=NAME,NAME")
    _add_data(command)
    _add_amplitude(command)
    command.add_argument(
        "--sensitivities", action="store_true", help="add those of the spectral radius, largest effect of 1 %% first"
    )
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_query(subparsers: Any) -> None:
    command = _command(subparsers, "query", commands.query, "evaluate a stored atlas at one point")
    command.add_argument("file", metavar="FILE.nc", type=_path, help='result of a scene with analysis = "atlas"')
    _add_given(command, "parameters, or physical data")
    _add_amplitude(command)
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_design(subparsers: Any) -> None:
    command = _command(subparsers, "design", commands.design, "answer a design question from a stored atlas")
    questions = ("least-damping", "widest-angle", "speed-windows")
    command.add_argument("question", choices=questions, metavar="QUESTION", help=", ".join(questions))
    command.add_argument("file", metavar="FILE.nc", type=_path, help='result of a scene with analysis = "atlas"')
    _add_given(command, "parameters; a range is name=LOW:HIGH")
    _add_amplitude(command)
    command.add_argument(
        "--margin", type=_part, metavar="PART", help="speed-windows: relative distance in speed from every boundary"
    )
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_explore(subparsers: Any) -> None:
    command = _command(
        subparsers, "explore", commands.explore, "write a page that evaluates a stored atlas in a browser"
    )
    command.add_argument("file", metavar="ATLAS.nc", type=_path, help='result of a scene with analysis = "atlas"')
    command.add_argument("--out", required=True, metavar="PAGE.html", type=_path, help="page to write (.html)")


def _add_bench(subparsers: Any) -> None:
    command = _command(
        subparsers, "bench", commands.bench, "measure error and run time, compared with peers (source checkout only)"
    )
    command.add_argument("systems", nargs="*", default=[], metavar="SYSTEM", help="only the studies of these systems")
    command.add_argument(
        "--quick", action="store_true", help="small versions (minutes); do not change the stored results"
    )
    command.add_argument("--out", metavar="FOLDER", type=_path, help="output folder")
    command.add_argument("--peers", metavar="PYTHON", help="Python of an environment with ROSS and pynamicalsys")


_COMMANDS = (
    _add_list,
    _add_run,
    _add_status,
    _add_verify,
    _add_export,
    _add_plot,
    _add_report,
    _add_point,
    _add_query,
    _add_design,
    _add_explore,
    _add_bench,
)


def _command(subparsers: Any, name: str, function: Any, text: str) -> argparse.ArgumentParser:
    command = subparsers.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.set_defaults(command=function, parser=command)
    return command


def _add_amplitude(command: argparse.ArgumentParser) -> None:
    text = 'limit of the forced amplitude, such as "2 deg": the answer compares the forced motion with it'
    command.add_argument("--amplitude", metavar="LIMIT", help=text)


def _add_given(command: argparse.ArgumentParser, text: str) -> None:
    # The default keeps argparse from reporting it as required.
    command.add_argument("given", nargs="*", default=[], metavar="name=value", help=text)


def _add_scene(command: argparse.ArgumentParser) -> None:
    command.add_argument("scene", metavar="SCENE.toml", type=_path, help="scene file, or a name of `drivetrain list`")
    command.add_argument("--out", required=True, metavar="FILE.nc", type=_path, help="result file")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace an entry of the scene: fixed.zeta=0.002",
    )
    _add_data(command)


def _add_data(command: argparse.ArgumentParser) -> None:
    text = "table of parameters (.csv, .xlsx), a column each: length [mm]; the command line overrides it"
    command.add_argument("--data", metavar="TABLE", type=_path, help=text)
