"""The functions of the commands. Heavy imports are local, so a command loads only its own modules."""

from __future__ import annotations

import argparse
import io
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import drivetrain_jax
from drivetrain_jax import _units
from drivetrain_jax._errors import InputError
from drivetrain_jax.cli.replies import INCOMPLETE, INTERRUPTED, OK, one_line, say

_FIGURES = (".png", ".pdf", ".svg")
# Tables of constants, and their separators.
_TABLES = {".txt": "", ".csv": ","}
_PAGES = (".html", ".htm")
# Time [s] after a signal during which further signals are ignored.
_GRACE = 2.0


@contextmanager
def _stop_on_signals() -> Iterator[Callable[[], None]]:
    """Raise ``KeyboardInterrupt`` on Ctrl-C and SIGTERM inside the context.

    Yields a function that raises it again after a signal, because a destructor or a C callback may swallow the first one;
    nothing is printed then. Further signals are ignored for two seconds, so that finished chunks are written.
    """
    caught: list[float] = []
    report_unraisable = sys.unraisablehook

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    def stop(*_: object) -> None:
        caught.append(time.monotonic())
        if len(caught) == 1 or caught[-1] - caught[0] > _GRACE:
            raise KeyboardInterrupt

    def report(swallowed: Any) -> None:
        if swallowed.exc_type is not KeyboardInterrupt:
            report_unraisable(swallowed)

    handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    sys.unraisablehook = report
    try:
        yield check
    finally:
        sys.unraisablehook = report_unraisable
        for number, handler in handlers.items():
            # A handler that Python did not set cannot be restored.
            signal.signal(number, handler or signal.SIG_DFL)


def list_systems(options: argparse.Namespace) -> int:
    """Print all systems, or one system in detail."""
    from drivetrain_jax.runs.catalogue import describe, overview

    say(describe(options.system) if options.system else overview())
    return OK


def _answer(reply: Any, options: argparse.Namespace) -> int:
    say((reply.to_json() if options.json else str(reply)) + "\n")
    return OK


def run(options: argparse.Namespace) -> int:
    """Compute or resume a scene. Ctrl-C and SIGTERM stop it; finished blocks are kept."""
    with _stop_on_signals() as check:
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


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Entries of the scene that the command line replaces."""
    return {f"fixed.{name}": value for name, value in _tabulated(options).items()} | assignments(options.set, "--set")


def _tabulated(options: argparse.Namespace) -> dict[str, Any]:
    """The values of the table ``--data``."""
    if options.data is None:
        return {}
    from drivetrain_jax.runs.physical import read_table

    return read_table(options.data)


def _compute(options: argparse.Namespace, check: Callable[[], None]) -> tuple[Any, int, str]:
    """Counts, exit code, and the message for the user."""
    from drivetrain_jax.runs.run import Incomplete, run_to_file
    from drivetrain_jax.runs.work import make_executor

    overrides = _overrides(options)
    with _progress_line(options.quiet) as show:

        def report(progress: Any) -> None:
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
    return progress, OK, "" if options.quiet else _remarks(progress, options.out)


def _remarks(progress: Any, out: Path) -> str:
    """The note of a finished run, and its values that miss the tolerance."""
    remarks = [progress.note] if progress.note else []
    if progress.inaccurate:
        from drivetrain_jax.runs.output import missed

        remarks.append(missed(out, progress.inaccurate, progress.total))
    return "; ".join(remarks)


def _progress_line(quiet: bool) -> Any:
    if quiet:
        return nullcontext()
    from drivetrain_jax.cli.progress import progress_line

    return progress_line()


def status(options: argparse.Namespace) -> int:
    """Print how much of a scene is computed."""
    from drivetrain_jax.runs.output import status

    return _answer(status(options.scene, options.out, _overrides(options)), options)


def verify(options: argparse.Namespace) -> int:
    """Verify the checksums and rules of a result; a damaged result is wrong input."""
    from drivetrain_jax.invariants.verify import verify

    report = verify(options.file)
    _answer(report, options)
    if report.problem:
        raise InputError(f"file = {str(options.file)!r}: {report.problem}")
    return OK if report.complete else INCOMPLETE


def export(options: argparse.Namespace) -> int:
    """Write a Zarr store as one HDF5 file, or a result as a table."""
    if options.csv is not None:
        from drivetrain_jax.datasets.table import write_csv

        if options.file:
            raise InputError(f"FILE.nc = {str(options.file)!r}: not used with --csv; allowed is --csv TABLE.csv")
        out = Path(options.csv or options.store.with_suffix(".csv"))
        _check_place(out, (".csv",))
        sys.stderr.write(f"points: {write_csv(options.store, out)} exported\n")
        return OK
    if options.file is None:
        raise InputError("FILE.nc: missing; allowed is a new file, or --csv for a table")
    from drivetrain_jax.runs.stores import export

    sys.stderr.write(f"points: {export(options.store, options.file)} exported\n")
    return OK


def plot(options: argparse.Namespace) -> int:
    """Draw the figure of one result or of several results together, or write a table of constants."""
    from drivetrain_jax.datasets.figure import plot
    from drivetrain_jax.store.checksums import refuse_damaged

    _check_place(options.out, (*_FIGURES, *_TABLES))
    ending = options.out.suffix.lower()
    if ending in _TABLES:
        from drivetrain_jax.datasets.figure import table

        if len(options.files) > 1 or options.part or options.cells is not None:
            raise InputError(f"out = {str(options.out)!r}: a table shows one whole result; allowed are figures")
        with _reading(options.files[0]):
            text = table(options.files[0], options.units, _TABLES[ending])
        _write(options.out, text.encode())
        return OK
    part = ranges(options.part, "--part") or None
    image = io.BytesIO()
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
        figure.savefig(image, format=options.out.suffix[1:].lower())
    _write(options.out, image.getbuffer())
    return OK


def report(options: argparse.Namespace) -> int:
    """Write one HTML file about results."""
    _check_place(options.out, _PAGES)
    from drivetrain_jax.report import report

    with _reading(*options.files):
        page = report(options.files, options.title, options.units, options.amplitude)
    _write(options.out, page.encode())
    return OK


def explore(options: argparse.Namespace) -> int:
    """Write the explorer's page of an atlas."""
    from drivetrain_jax.runs.atlas_file import open_atlas

    _check_place(options.out, _PAGES)
    with _reading(options.file):
        page = open_atlas(options.file).explore().text
    _write(options.out, page.encode())
    return OK


def _reading(*files: Path) -> ExitStack:
    """A context that shows on a terminal that the command works on these files."""
    stack = ExitStack()
    if sys.stderr.isatty():
        from drivetrain_jax.cli.progress import working_on

        first, *more = [file.name for file in files]
        stack.enter_context(working_on(f"{first} and {len(more)} more" if more else first))
    return stack


def _check_place(out: Path, endings: tuple[str, ...]) -> None:
    """Raise :class:`InputError` for a file that could not be written, before anything is computed."""
    if not out.parent.is_dir():
        raise InputError(f"out = {str(out)!r}: the folder does not exist; allowed is a file in an existing folder")
    if out.exists() and not out.is_file():
        what = "is a folder" if out.is_dir() else "not a regular file"
        raise InputError(f"out = {str(out)!r}: {what}; allowed is a new file, or one to replace")
    if out.suffix.lower() not in endings:
        raise InputError(f"out = {str(out)!r}: allowed is a name that ends in {', '.join(endings)}")


def _write(out: Path, data: bytes | memoryview) -> None:
    from drivetrain_jax.store.files import write_atomic

    try:
        write_atomic(out, data, out.with_name(f"{out.name}.tmp"))
    except OSError as error:
        raise InputError(f"out = {str(out)!r}: {error.strerror}; allowed is a file that can be written") from None


def point(options: argparse.Namespace) -> int:
    """Print the results of one point."""
    from drivetrain_jax.runs.point import point

    given = _tabulated(options) | assignments(options.given, "point")
    for name in ("system", "analysis"):
        if name in given:
            raise InputError(f"{name} = {given[name]!r}: given twice; allowed is once, in front of the values")
    for name in ("amplitude", "sensitivities"):
        if name in given:
            raise InputError(f"{name} = {given[name]!r}: not a parameter; did you mean the option --{name}?")
    outputs = given.pop("outputs", None)
    if isinstance(outputs, str):
        outputs = outputs.split(",")
    asked = {"amplitude": options.amplitude, "sensitivities": options.sensitivities}
    found = point(options.system, options.analysis, outputs=outputs, **asked, **given)
    return _answer(found, options)


def query(options: argparse.Namespace) -> int:
    """Print the values of an atlas at one point."""
    from drivetrain_jax.runs.atlas_answers import query
    from drivetrain_jax.runs.atlas_file import open_atlas

    given = ranges(options.given, "query")
    with _reading(options.file):
        reply = query(open_atlas(options.file), given, options.amplitude)
    return _answer(reply, options)


def design(options: argparse.Namespace) -> int:
    """Print the answer of an atlas to a design question."""
    from drivetrain_jax.runs import atlas_answers
    from drivetrain_jax.runs.atlas_file import open_atlas

    extra = {} if options.margin is None else {"margin": options.margin}
    if extra and options.question != "speed-windows":
        raise InputError(f"--margin = {options.margin}: not used by {options.question}; allowed for speed-windows")
    given = ranges(options.given, "design")
    question = getattr(atlas_answers, options.question.replace("-", "_"))
    with _reading(options.file):
        reply = question(open_atlas(options.file), given, amplitude=options.amplitude, **extra)
    return _answer(reply, options)


def bench(options: argparse.Namespace) -> int:
    """Run the benchmarks of a checkout in a separate process."""
    import subprocess

    package = Path(drivetrain_jax.__file__).resolve().parent
    checkout = package.parent
    if not (checkout / "benchmarks" / "__main__.py").is_file():
        raise InputError(f"bench: no folder benchmarks/ next to {str(package)!r}; allowed is a checkout")
    words = [*options.systems, *(["--quick"] if options.quick else [])]
    words += ["--out", str(options.out.absolute())] if options.out else []
    return subprocess.run([sys.executable, "-m", "benchmarks", *words], cwd=checkout, check=False).returncode


def assignments(texts: Sequence[str], field: str) -> dict[str, Any]:
    """A mapping from ``name=value`` words; values are TOML or plain text."""
    from drivetrain_jax.runs.toml import parse_value

    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise InputError(f"{field} = {text!r}: allowed is name=value")
        if name in pairs:
            raise InputError(f"{field} = {text!r}: {name} is given twice; allowed is once")
        pairs[name] = parse_value(value)
    for name in pairs:
        if table := next((other for other in pairs if name.startswith(f"{other}.")), None):
            raise InputError(f"{field} = {name!r}: it is part of {table!r}, which is given too; allowed is one of them")
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
            # 0:18deg is a range in degrees.
            numbers = [_written(number, unit or known[-1][1]) for number, unit in known]
            return numbers[0] if len(numbers) == 1 else tuple(numbers)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    raise InputError(f"{name} = {value!r}: allowed is a number or LOW:HIGH, with or without units (200:4000rpm)")


def _written(number: float, unit: str) -> float | str:
    return f"{number!r} {unit}" if unit else number
