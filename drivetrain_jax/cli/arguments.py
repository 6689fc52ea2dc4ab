"""The command-line parser: commands, arguments and the text of ``--help``."""

from __future__ import annotations

import argparse
import errno
import os
from pathlib import Path
from typing import Any, NoReturn

from drivetrain_jax import __version__, _units
from drivetrain_jax._wording import clipped
from drivetrain_jax.cli import commands
from drivetrain_jax.cli.replies import WRONG_INPUT, one_line


class _Parser(argparse.ArgumentParser):
    """A parser whose usage errors are one line, with the exit code for wrong input."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Parse; values ``name=value`` may follow options, which argparse itself does not allow."""
        options, unknown = self.parse_known_args(args, namespace)
        if "given" in options:
            options.given = [*options.given, *(word for word in unknown if "=" in word and not word.startswith("-"))]
            unknown = [word for word in unknown if word not in options.given]
        if unknown:
            options.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, one_line(f"{message}; see {self.prog} --help"))


def number(text: str) -> float:
    """A part of a whole, such as 0.02 or 2%."""
    try:
        return float(text)
    except ValueError:
        return _units.number(text, "1")


def path(text: str) -> Path:
    """A path of valid length; the command checks if the file exists."""
    try:
        os.lstat(text)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise argparse.ArgumentTypeError(f"{clipped(text)!r}: {error.strerror}") from None
    # The shell leaves the ~ of --out=~/r.nc alone.
    return Path(text).expanduser()


# An argument as :meth:`argparse.ArgumentParser.add_argument` takes it.
Argument = tuple[str, dict[str, Any]]


def _value(name: str, metavar: str, text: str, **options: Any) -> Argument:
    return name, {"metavar": metavar, "help": text, **options}


def _flag(name: str, text: str) -> Argument:
    return name, {"action": "store_true", "help": text}


def _file(name: str, metavar: str, text: str, **options: Any) -> Argument:
    return _value(name, metavar, text, type=path, **options)


def _given(text: str) -> Argument:
    # The default keeps argparse from reporting it as required.
    return _value("given", "name=value", text, nargs="*", default=[])


_JSON = _flag("--json", "as one JSON object")
_ATLAS = _file("file", "FILE.nc", 'result of a scene with analysis = "atlas"')
_RESULT = _file("file", "FILE.nc", "result, finished or not")
_DATA = _file(
    "--data", "TABLE", "table of parameters (.csv, .xlsx), a column each: length [mm]; given values override it"
)
_AMPLITUDE = _value(
    "--amplitude", "LIMIT", 'limit of the forced amplitude ("2 deg"), to compare the forced motion with'
)
_SCENE = (
    _file("scene", "SCENE.toml", "scene file, or a name of `drivetrain list`"),
    _file("--out", "FILE.nc", "result file", required=True),
    _value("--set", "KEY=VALUE", "replace an entry of the scene: fixed.zeta=0.002", action="append", default=[]),
    _DATA,
)
_QUESTIONS = ("least-damping", "widest-angle", "speed-windows")

# The text of every command, and its arguments; the function has the name of the command.
_COMMANDS: dict[str, tuple[str, tuple[Argument, ...]]] = {
    "list": ("list systems, analyses, parameters and scenes", (
        _value("system", "SYSTEM", "describe this system", nargs="?"),
    )),
    "run": ("compute a scene, or resume an interrupted run", (
        *_SCENE,
        _flag("--fresh", "compute all points again; replace result and unfinished work"),
        _value("--threads", "N", "number of threads (default: usable cores)", type=int),
        _value("--workers", "N", "N Dask workers instead of threads, as --dask local:N; a worker may crash", type=int),
        _value("--dask", "ADDRESS", "Dask cluster instead of threads: tcp://HOST:PORT or local:N"),
        _file("--reuse", "FILE.nc", "reuse the common points of this result; a smaller result at --out is always reused",
              action="append", default=[]),
        ("--store", {"choices": ("hdf5", "zarr"), "help": "zarr: workers write a Zarr store (default if so named)"}),
        _flag("--quiet", "print only the last line"),
    )),
    "status": ("show how much of a scene is computed", (*_SCENE, _JSON)),
    "verify": ("compare all checksums of a result, and apply the rules of its analysis", (_RESULT, _JSON)),
    "export": ("write a Zarr store as one HDF5 file, or a result as CSV", (
        _file("store", "RESULT", "a Zarr store, or with --csv any result on a grid"),
        _file("file", "FILE.nc", "HDF5 file to write", nargs="?"),
        _value("--csv", "TABLE.csv", nargs="?", const="",
               text="write a table (default: RESULT.csv): one row a point, units in the header, codes as words"),
    )),
    "plot": ("draw the figure of a result", (
        _file("files", "FILE.nc", "results; overlaid: methods of one analysis, or a chart and its atlas", nargs="+"),
        _file("--out", "FIGURE", "figure (.png, .pdf, .svg) or table of constants (.txt, .csv)", required=True),
        _value("--part", "name=LOW:HIGH", "part of an atlas: ranges, or name=value", nargs="+", default=[]),
        _value("--cells", "N", "cells per axis for an atlas (default: 800)", type=int),
        _value("--units", "rpm,deg", "units of the axes (default: those of the scene)"),
    )),
    "report": ("write a report on results: one HTML file that prints well", (
        _file("files", "FILE.nc", "results, one section each", nargs="+"),
        _file("--out", "REPORT.html", "page to write", required=True),
        _value("--title", "TEXT", "heading (default: the title of the scene)"),
        _value("--units", "rpm,deg", "units of the report (default: those of the scenes)"),
        _AMPLITUDE,
    )),
    "point": ("compute one point", (
        _value("system", "SYSTEM", "name from `drivetrain list`"),
        _value("analysis", "ANALYSIS", "name from `drivetrain list SYSTEM`"),
        _given("parameters in the units of `drivetrain list SYSTEM`, options, and outputs=NAME,NAME"),
        _DATA, _AMPLITUDE,
        _flag("--sensitivities", "add those of the spectral radius, largest effect of 1 %% first"),
        _JSON,
    )),
    "query": ("evaluate a stored atlas at one point", (
        _ATLAS, _given("parameters, or physical data"), _AMPLITUDE, _JSON,
    )),
    "design": ("answer a design question from a stored atlas", (
        _value("question", "QUESTION", ", ".join(_QUESTIONS), choices=_QUESTIONS),
        _ATLAS, _given("parameters; a range is name=LOW:HIGH"), _AMPLITUDE,
        _value("--margin", "PART", "speed-windows: relative distance in speed from every boundary", type=number),
        _JSON,
    )),
    "explore": ("write a page that evaluates a stored atlas in a browser", (
        _ATLAS, _file("--out", "PAGE.html", "page to write (.html)", required=True),
    )),
    "bench": ("measure error and run time, compared with peers (source checkout only)", (
        _value("systems", "SYSTEM", "only the studies of these systems", nargs="*", default=[]),
        _flag("--quick", "small versions (minutes); do not change the stored results"),
        _file("--out", "FOLDER", "output folder"),
    )),
}  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """The parser of all commands; the result has the function of the command as ``command``."""
    whole = _Parser(
        prog="drivetrain",
        description="Compute stability and vibration of drivetrains, and draw the results.",
        epilog="Start with `drivetrain list`. `drivetrain COMMAND --help` describes a command.",
        allow_abbrev=False,
    )
    whole.add_argument("--version", action="version", version=__version__)
    subparsers = whole.add_subparsers(metavar="COMMAND", required=True)
    for name, (text, arguments) in _COMMANDS.items():
        described = f"{text[0].upper()}{text[1:]}."
        command = subparsers.add_parser(name, help=text, description=described, allow_abbrev=False)
        command.set_defaults(command=getattr(commands, "list_systems" if name == "list" else name), parser=command)
        for argument, options in arguments:
            command.add_argument(argument, **options)
    return whole
