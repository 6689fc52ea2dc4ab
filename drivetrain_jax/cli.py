"""The command ``drivetrain``: its arguments and the functions of its commands.

Heavy imports are local, so ``--help`` is fast and each command loads only its own modules.
"""

from __future__ import annotations

import argparse
import errno
import gc
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from drivetrain_jax import __version__, _units
from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax._machine import StatusLine, stop_on_signals

if TYPE_CHECKING:
    from drivetrain_jax.runs.run import Progress

__all__ = ["main"]

OK, WRONG_INPUT, INCOMPLETE, INTERRUPTED = 0, 2, 3, 130
# Errors of standard output: a reader that has left, a full disk.
_OUTPUT = (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EIO)
_FIGURES = (".png", ".pdf", ".svg")
_PAGES = (".html", ".htm")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 2 wrong input, 3 incomplete and resumable, 130 interrupted."""
    if arguments is None:
        # Collect garbage rarely: the default takes a third of a second and frees little, as most objects live until the end.
        gc.set_threshold(50_000)
        # Figures are written to files, so a window system of the user's choice is not needed, and may be missing.
        os.environ["MPLBACKEND"] = "agg"
        # A warning of a value, without the line of code that found it.
        warnings.formatwarning = lambda message, *_, **__: one_line(f"warning: {message}")
        # Ctrl-C ends a command at once, also during a compilation; ``run`` has a handler of its own.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        quiet_hdf5()
    # A stream that the parent process has closed is None.
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr) if arguments is None else ():
        # The encoding of a terminal may lack characters of a title.
        stream.reconfigure(errors="backslashreplace")  # pyright: ignore[reportAttributeAccessIssue]
    options = parser().parse_args(arguments)
    if arguments is None and not (getattr(options, "dask", None) or getattr(options, "workers", None)):
        # xarray imports an installed dask to recognise its arrays, which takes 0.4 s; no command makes any.
        sys.modules["dask.array"] = None  # pyright: ignore[reportArgumentType]
    try:
        return options.command(options)
    except (InputError, ChunkError) as error:
        sys.stderr.write(one_line(str(error)))
        return INCOMPLETE if isinstance(error, ChunkError) else WRONG_INPUT
    except OSError as error:
        if error.filename is None and error.errno not in _OUTPUT:
            raise
        if error.filename is None:
            # Python would try to write buffered output again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            # The reader has closed standard output (``drivetrain list | head``): exit without a message.
            return OK
        sys.stderr.write(one_line(f"{error.filename or 'standard output'}: {error.strerror}"))
        return WRONG_INPUT
    except (RuntimeError, AssertionError) as error:
        # jax raises either, the second without a text, for a platform that this machine lacks.
        platforms = os.environ.get("JAX_PLATFORMS", "")
        if platforms in ("", "cpu") or "backend" not in (str(error) or "backend"):
            raise
        allowed = "jax cannot use it on this machine; set cpu, or unset the variable"
        sys.stderr.write(one_line(f"JAX_PLATFORMS = {platforms!r}: {allowed}"))
        return WRONG_INPUT
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if arguments is None:
            # Skip Python's garbage collection at exit, which takes a third of a second.
            gc.freeze()


def quiet_hdf5() -> None:
    """Leave out what h5py prints about objects that it frees after a failed write; the failure itself is raised."""

    def quiet(former: Callable[..., None], error_of: Callable[..., Any], *given: Any) -> None:
        if "decrement id ref count" not in str(error_of(*given)):
            former(*given)

    sys.excepthook = partial(quiet, sys.excepthook, lambda _, error, *__: error)
    sys.unraisablehook = partial(quiet, sys.unraisablehook, lambda unraisable: unraisable.exc_value)


def one_line(message: str) -> str:
    """``message`` on one line, with the name of the command in front."""
    return f"drivetrain: {' '.join(message.split())}\n"


# Arguments.


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
    return _units.number(text, "1") if text.endswith("%") else float(text)


def path(text: str) -> Path:
    """A path; the shell leaves the ~ of --out=~/r.nc alone."""
    return Path(os.path.expanduser(text))


def _argument(name: str, metavar: str, text: str, **options: Any) -> tuple[str, dict[str, Any]]:
    """An argument as :meth:`argparse.ArgumentParser.add_argument` takes it."""
    return name, {"metavar": metavar, "help": text, **options}


_file, _given = partial(_argument, type=path), partial(_argument, "given", "name=value", nargs="*", default=[])
_JSON = "--json", {"action": "store_true", "help": "as one JSON object"}
_ATLAS = _file("file", "FILE.nc", 'result of a scene with analysis = "atlas"')
_DATA = _file(
    "--data", "TABLE", "table of parameters (.csv, .xlsx, .toml), a column each: length [mm]; given values override it"
)
_AMPLITUDE = _argument(
    "--amplitude", "LIMIT", 'limit of the forced amplitude ("2 deg"), to compare the forced motion with'
)
_SCENE = (
    _file("scene", "SCENE.toml", "scene file, or a name of `drivetrain list`"),
    _file("--out", "FILE.nc", "result file", required=True),
    _argument("--set", "KEY=VALUE", "replace an entry of the scene: fixed.zeta=0.002", action="append", default=[]),
    _DATA,
)
_SEVERAL: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
_QUESTIONS = ("least-damping", "widest-angle", "speed-windows")

# The text of every command, and its arguments; the function has the name of the command.
_COMMANDS: dict[str, tuple[str, tuple[Any, ...]]] = {
    "list": ("list systems, analyses, parameters and scenes", (
        _argument("system", "SYSTEM", "describe this system", nargs="?"),
    )),
    "run": ("compute a scene, or resume an interrupted run", (
        *_SCENE,
        ("--fresh", {"action": "store_true", "help": "compute all points again; replace result and unfinished work"}),
        _argument("--threads", "N", "number of threads (default: usable cores)", type=int),
        _argument("--workers", "N", "N Dask workers, as --dask local:N; unlike threads, they survive a crash", type=int),
        _argument("--dask", "ADDRESS", "Dask cluster instead of threads: tcp://HOST:PORT or local:N"),
        _file("--reuse", "FILE.nc", "reuse common points of this result (repeatable); a smaller one at --out is always used",
              action="append", default=[]),
        ("--store", {"choices": ("hdf5", "zarr"), "help": "zarr: a Zarr store (default if --out ends in .zarr)"}),
        ("--quiet", {"action": "store_true", "help": "print only the last line"}),
    )),
    "status": ("show how much of a scene is computed", (*_SCENE, _JSON)),
    "verify": ("compare all checksums of a result, and apply the rules of its analysis", (
        _file("file", "FILE.nc", "result, finished or not"), _JSON,
        ("--proof", {"action": "store_true", "help": "compute the proved bounds of an atlas again (seconds)"}),
    )),
    "export": ("write a Zarr store as one HDF5 file, or a result as CSV", (
        _file("store", "RESULT", "a Zarr store, or with --csv a result file on a grid"),
        _file("file", "FILE.nc", "HDF5 file to write", nargs="?"),
        _file("--csv", "TABLE.csv", nargs="?", const=False,
               text="write a table (default: RESULT.csv): one row a point, units in the header, codes as words"),
    )),
    "plot": ("draw the figure of a result", (
        _file("files", "FILE.nc", "results; overlaid: methods of one analysis, or a chart and its atlas", nargs="+"),
        _file("--out", "FIGURE", "figure (.png, .pdf, .svg)", required=True),
        _argument("--part", "name=LOW:HIGH", "part of an atlas: ranges, or name=value", **_SEVERAL),
        _argument("--cells", "N", "cells per axis for an atlas (default: 800)", type=int),
        _argument("--units", "rpm,deg", "units of the axes (default: those of the scene)"),
    )),
    "report": ("write a report on results: one HTML file that prints well", (
        _file("files", "FILE.nc", "results, one section each", nargs="+"),
        _file("--out", "REPORT.html", "page to write", required=True),
        _argument("--title", "TEXT", "heading (default: the title of the scene)"),
        _argument("--units", "rpm,deg", "units of the report (default: those of the scenes)"),
        _AMPLITUDE,
    )),
    "point": ("compute one point", (
        _argument("system", "SYSTEM", "name from `drivetrain list`"),
        _argument("analysis", "ANALYSIS", "name from `drivetrain list SYSTEM`"),
        _given("parameters in the units of `drivetrain list SYSTEM` (floquet: or LOW:HIGH), options, outputs=NAME,NAME"),
        _DATA, _AMPLITUDE,
        ("--sensitivities", {
            "action": "store_true", "help": "add the effect of 1 %% of each value on the results, largest first",
        }),
        _JSON,
    )),
    "query": ("evaluate a stored atlas at one point", (
        _ATLAS, _given("parameters, or physical data"), _AMPLITUDE, _JSON,
    )),
    "design": ("answer a design question from a stored atlas", (
        _argument("question", "QUESTION", ", ".join(_QUESTIONS), choices=_QUESTIONS),
        _ATLAS, _given("parameters; a range is name=LOW:HIGH"), _AMPLITUDE,
        _argument("--vary", "NAME", "parameter in place of the damping (its least value) or the angle (its largest value)"),
        _argument("--margin", "PART", "speed-windows: relative distance in speed from every boundary", type=number),
        _JSON,
    )),
    "explore": ("write a page that evaluates a stored atlas in a browser", (
        _ATLAS, _file("--out", "PAGE.html", "page to write (.html)", required=True),
    )),
    "bench": ("measure error and run time, compared with peers (source checkout only)", (
        _argument("systems", "SYSTEM", "only the studies of these systems", nargs="*", default=[]),
        ("--quick", {"action": "store_true", "help": "small versions (minutes); do not change the stored results"}),
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
        command.set_defaults(command=globals()["list_systems" if name == "list" else name], parser=command)
        for argument, options in arguments:
            command.add_argument(argument, **options)
    return whole


def assignments(texts: Sequence[str], field: str) -> dict[str, Any]:
    """A mapping from ``name=value`` words; values are TOML or plain text."""
    from drivetrain_jax.runs.toml import parse_value

    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{field} = {text!r}: expected name=value")
        if name in pairs:
            raise InputError(f"{field} = {text!r}: {name} is given twice; expected once")
        pairs[name] = parse_value(value)
    return pairs


def ranges(texts: Sequence[str], field: str) -> dict[str, Any]:
    """A mapping from ``name=value`` words; values are numbers or pairs ``LOW:HIGH``, texts if they have units."""
    return {name: _number_or_range(name, value) for name, value in assignments(texts, field).items()}


def _number_or_range(name: str, value: Any) -> Any:
    if isinstance(value, str):
        ends = [_units.split(end) for end in value.split(":")]
        known = [end for end in ends if end is not None]
        # 1000-2000 is no number, and its second half no unit.
        if len(known) == len(ends) <= 2 and not any(re.match(r"[-.,\d]", unit) for _, unit in known):
            # 0:18deg and 0deg:18 are ranges in degrees.
            either = next((unit for _, unit in reversed(known) if unit), "")
            units = [unit or either for _, unit in known]
            numbers = [f"{end!r} {unit}" if unit else end for (end, _), unit in zip(known, units, strict=True)]
            return numbers[0] if len(numbers) == 1 else tuple(numbers)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        # An integer may have too many digits for a number.
        with suppress(OverflowError):
            return float(value)
    raise InputError(f"{name} = {value!r}: expected a number or LOW:HIGH, with or without units (200:4000rpm)")


# Commands.


def list_systems(options: argparse.Namespace) -> int:
    """Print all systems, or one system in detail."""
    from drivetrain_jax.runs.catalogue import describe, overview

    print(describe(options.system) if options.system else overview(), end="", flush=True)
    return OK


def _answer(reply: Any, options: argparse.Namespace) -> int:
    print(reply.to_json() if options.json else reply, flush=True)
    return OK


def run(options: argparse.Namespace) -> int:
    """Compute or resume a scene. Ctrl-C and SIGTERM stop it; finished blocks are kept."""
    with stop_on_signals(signal.SIGINT, signal.SIGTERM) as check:
        try:
            progress, code, reason = _compute(options, check)
        except KeyboardInterrupt as stop:
            # Before the modules are loaded no point is counted.
            progress = getattr(stop, "progress", "points: total=0 computed=0 reused=0 failed=0")
            code, reason = INTERRUPTED, "interrupted; the same command resumes"
        if reason:
            sys.stderr.write(one_line(reason))
        sys.stderr.write(f"{progress}\n")
        if code == INTERRUPTED:
            # A normal exit would wait for running chunks, whose results are not needed.
            sys.stderr.flush()
            os._exit(code)
    return code


def _compute(options: argparse.Namespace, check: Callable[[], None]) -> tuple[Any, int, str]:
    """Counts, exit code, and the message for the user: a note, and the values that miss the tolerance."""
    from drivetrain_jax.runs.output import missed
    from drivetrain_jax.runs.run import Incomplete, ProgressLine, run_to_file
    from drivetrain_jax.runs.work import make_executor

    overrides = _overrides(options)
    with nullcontext() if options.quiet else ProgressLine() as show:

        def report(progress: Progress) -> None:
            check()
            if show:
                show(progress)

        try:
            progress = run_to_file(
                options.scene,
                options.out,
                overrides=overrides,
                fresh=options.fresh,
                executor=make_executor(options.threads, options.workers, options.dask),
                reuse=options.reuse,
                store=options.store,
                report=report,
            )
        except Incomplete as error:
            return error.progress, INCOMPLETE, str(error)
    if options.quiet:
        return progress, OK, ""
    lost = missed(options.out, progress.inaccurate, progress.total) if progress.inaccurate else ""
    return progress, OK, "; ".join(filter(None, (progress.note, lost)))


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    from drivetrain_jax.runs.physical import PARTS, read_table
    from drivetrain_jax.runs.toml import read

    table = {} if options.data is None else read_table(options.data)
    own = read(options.scene)[0].get("fixed") if table else None
    table = {n: value for n, value in table.items() if not (isinstance(own, dict) and n in own)}
    entries = {n if n == PARTS else f"fixed.{n}": value for n, value in table.items()}
    return entries | assignments(options.set, "--set")


def status(options: argparse.Namespace) -> int:
    """Print how much of a scene is computed."""
    from drivetrain_jax.runs.output import status

    return _answer(status(options.scene, options.out, _overrides(options)), options)


def verify(options: argparse.Namespace) -> int:
    """Verify the checksums and rules of a result; a damaged result is wrong input."""
    from drivetrain_jax.invariants import verify

    report = verify(options.file)
    if options.proof and not report.problem:
        from drivetrain_jax.runs.atlas_file import verify_proof

        line, problem = verify_proof(options.file)
        report = replace(report, lines=(*report.lines, line), problem=problem)
    _answer(report, options)
    if report.problem:
        raise InputError(f"file = {str(options.file)!r}: {report.problem}")
    return OK if report.complete else INCOMPLETE


def export(options: argparse.Namespace) -> int:
    """Write a Zarr store as one HDF5 file, or a result as a table."""
    if options.csv is not None:
        from drivetrain_jax.datasets.accessor import write_csv

        if options.file:
            raise InputError(f"FILE.nc = {str(options.file)!r}: not used with --csv; expected --csv TABLE.csv")
        out = options.csv or Path(f"{os.path.splitext(options.store)[0]}.csv")
        _check_place(out, (".csv",))
        count = write_csv(options.store, out)
    elif options.file is None:
        raise InputError("FILE.nc: missing; expected a new file, or --csv for a table")
    else:
        from drivetrain_jax.runs.assemble import export

        count = export(options.store, options.file)
    sys.stderr.write(f"points: {count} exported\n")
    return OK


def plot(options: argparse.Namespace) -> int:
    """Draw the figure of one result or of several results together."""
    from drivetrain_jax.datasets.figure import plot
    from drivetrain_jax.store.checksums import refuse_damaged

    _check_place(options.out, _FIGURES)
    image, part = io.BytesIO(), ranges(options.part, "--part") or None
    with _reading(*options.files):
        try:
            figure = plot(options.files, part=part, cells=options.cells, units=options.units)
        except InputError:
            raise
        except (LookupError, ValueError):
            # What another program has changed may be why the figure failed.
            for file in options.files:
                refuse_damaged(file, rewritten=True)
            raise
        figure.savefig(image, format=options.out.suffix.lower()[1:])
    return _write(options.out, image.getbuffer())


def report(options: argparse.Namespace) -> int:
    """Write one HTML file about results."""
    _check_place(options.out, _PAGES)
    from drivetrain_jax.report import report

    with _reading(*options.files):
        page = report(options.files, options.title, options.units, options.amplitude)
    return _write(options.out, page.encode())


def explore(options: argparse.Namespace) -> int:
    """Write the explorer's page of an atlas."""
    from drivetrain_jax.runs.atlas_file import open_atlas

    _check_place(options.out, _PAGES)
    with _reading(options.file):
        page = open_atlas(options.file).explore().text
    return _write(options.out, page.encode())


def _check_place(out: Path, endings: tuple[str, ...]) -> None:
    """Raise :class:`InputError` for a file that could not be written, before anything is computed."""
    if not out.parent.is_dir():
        raise InputError(f"out = {str(out)!r}: the folder does not exist; expected a file in an existing folder")
    if out.exists() and not out.is_file():
        what = "is a folder" if out.is_dir() else "not a regular file"
        raise InputError(f"out = {str(out)!r}: {what}; expected a new file, or one to replace")
    if out.suffix.lower() not in endings:
        hints = {
            ".pdf": "; a browser prints the page as PDF",
            ".csv": "; a table is written by `drivetrain export --csv`",
        }
        hint = hints.get(out.suffix.lower(), "")
        raise InputError(f"out = {str(out)!r}: expected a name that ends in {', '.join(endings)}{hint}")


def _write(out: Path, data: bytes | memoryview) -> int:
    from drivetrain_jax.store.files import behind_link, write_atomic

    out = behind_link(out)
    write_atomic(out, data, out.with_name(f"{out.name}.tmp"))
    return OK


def point(options: argparse.Namespace) -> int:
    """Print the results of one point."""
    from drivetrain_jax.runs.point import point

    values = assignments(options.given, "point")
    pairs = {n: _number_or_range(n, v) for n, v in values.items() if isinstance(v, str) and ":" in v}
    asked = {"amplitude": options.amplitude, "sensitivities": options.sensitivities, "data": options.data}
    for name in ("system", "analysis", *asked):
        if name in values:
            option = f"not a parameter; did you mean the option --{name}?"
            twice = "given twice; expected once, in front of the values"
            raise InputError(f"{name} = {values[name]!r}: {option if name in asked else twice}")
    outputs = values.pop("outputs", None)
    if isinstance(outputs, str):
        outputs = outputs.split(",")
    return _answer(point(options.system, options.analysis, outputs=outputs, **asked, **values | pairs), options)


def query(options: argparse.Namespace) -> int:
    """Print the values of an atlas at one point."""
    from drivetrain_jax.runs.atlas_answers import query
    from drivetrain_jax.runs.atlas_file import open_atlas

    values = ranges(options.given, "query")
    with _reading(options.file):
        reply = query(open_atlas(options.file), values, options.amplitude)
    return _answer(reply, options)


def design(options: argparse.Namespace) -> int:
    """Print the answer of an atlas to a design question."""
    from drivetrain_jax.runs import atlas_answers
    from drivetrain_jax.runs.atlas_file import open_atlas

    extra = {} if options.margin is None else {"margin": options.margin}
    if extra and options.question != "speed-windows":
        raise InputError(
            f"--margin = {options.margin}: not used by {options.question}; expected with speed-windows only"
        )
    if options.vary and options.question == "speed-windows":
        raise InputError(f"--vary = {options.vary!r}: not used by speed-windows; expected with the other questions")
    extra |= {"vary": options.vary} if options.vary else {}
    values = ranges(options.given, "design")
    question = getattr(atlas_answers, options.question.replace("-", "_"))
    with _reading(options.file):
        reply = question(open_atlas(options.file), values, amplitude=options.amplitude, **extra)
    return _answer(reply, options)


def bench(options: argparse.Namespace) -> int:
    """Run the benchmarks of a checkout in a separate process."""
    import subprocess

    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / "benchmarks" / "__main__.py").is_file():
        raise InputError(f"bench: no folder benchmarks/ in {str(checkout)!r}; expected a checkout")
    words = [*options.systems, *(["--quick"] if options.quick else [])]
    words += ["--out", str(options.out.absolute())] if options.out else []
    return subprocess.run([sys.executable, "-m", "benchmarks", *words], cwd=checkout, check=False).returncode


@contextmanager
def _reading(first: Path, *more: Path) -> Iterator[None]:
    """Show on a terminal that the command works on these files, and remove the line at the end."""
    line = StatusLine()
    line.write(f"{first.name}{f' and {len(more)} more' if more else ''} ...")
    try:
        yield
    finally:
        line.write("")


if __name__ == "__main__":
    sys.exit(main())
