"""The command ``drivetrain``. Thin: every command imports what it needs, so that ``--help`` is instant."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NoReturn

from drivetrain_jax import __version__
from drivetrain_jax._errors import InputError

OK, WRONG_INPUT, INCOMPLETE, INTERRUPTED = 0, 2, 3, 130


class _Parser(argparse.ArgumentParser):
    """Usage errors are one line and end with the code for wrong input."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_INPUT, _line(f"{message}; see {self.prog} --help"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (0 done, 2 wrong input, 3 incomplete and resumable, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    try:
        code = options.command(options)
        sys.stdout.flush()
        return code
    except InputError as error:
        sys.stderr.write(_line(str(error)))
        return WRONG_INPUT
    except BrokenPipeError:
        # The reader of our output has gone (``drivetrain list | head``): nobody is left to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if arguments is None:
            # The process ends now, and what it has done is done: a signal could only spoil its way out.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)


def _line(message: str) -> str:
    return f"drivetrain: {' '.join(message.split())}\n"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="drivetrain", description="Stability and vibration of drivetrains, from a scene file to a chart."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    for add in _COMMANDS:
        add(commands)
    return parser


def _add_list(commands: Any) -> None:
    command = _command(commands, "list", _list, "systems, analyses, parameters and scenes")
    command.add_argument("system", nargs="?", metavar="SYSTEM", help="describe this one")


def _add_run(commands: Any) -> None:
    command = _command(commands, "run", _run, "compute a scene, or resume it")
    _add_scene(command)
    command.add_argument("--fresh", action="store_true", help="replace a result of another scene or version")
    command.add_argument("--threads", type=int, metavar="N", help="chunks computed at a time (default: usable cores)")
    command.add_argument("--workers", type=int, metavar="N", help="N processes instead of threads: survive a crash")
    command.add_argument("--dask", metavar="ADDRESS", help="a Dask cluster instead: tcp://HOST:PORT or local:N")
    command.add_argument(
        "--reuse",
        action="append",
        default=[],
        metavar="FILE.nc",
        type=Path,
        help="take over the points that this result shares; a smaller result at --out is taken over without it",
    )
    command.add_argument(
        "--store", choices=("hdf5", "zarr"), default="hdf5", help="zarr: a store that the workers write themselves"
    )
    command.add_argument("--quiet", action="store_true", help="no progress, only the last line")


def _add_status(commands: Any) -> None:
    command = _command(commands, "status", _status, "how much of a scene is computed")
    _add_scene(command)
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_verify(commands: Any) -> None:
    command = _command(
        commands, "verify", _verify, "check every checksum of a result, and what must hold of its numbers"
    )
    command.add_argument("file", metavar="FILE.nc", type=Path)
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_export(commands: Any) -> None:
    command = _command(commands, "export", _export, "write a Zarr store as one HDF5 file")
    command.add_argument("store", metavar="STORE", type=Path)
    command.add_argument("file", metavar="FILE.nc", type=Path)


def _add_plot(commands: Any) -> None:
    command = _command(commands, "plot", _plot, "draw the figure that suits a result")
    command.add_argument(
        "files", metavar="FILE.nc", type=Path, nargs="+", help="several methods of one analysis overlay"
    )
    command.add_argument("--out", required=True, metavar="FIGURE", type=Path, help="figure to write (.png, .pdf, .svg)")
    command.add_argument(
        "--part", nargs="+", default=[], metavar="name=LOW:HIGH", help="of an atlas: ranges to zoom into, or name=value"
    )
    command.add_argument("--cells", type=int, default=800, metavar="N", help="of an atlas: cells each way (800)")


def _add_point(commands: Any) -> None:
    command = _command(commands, "point", _point, "compute one point")
    command.add_argument("system", metavar="SYSTEM")
    command.add_argument("analysis", metavar="ANALYSIS")
    command.add_argument("given", nargs="*", metavar="name=value", help="parameters, options, and outputs=NAME,NAME")
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_query(commands: Any) -> None:
    command = _command(commands, "query", _query, "ask a stored atlas about one point")
    command.add_argument("file", metavar="FILE.nc", type=Path)
    command.add_argument("given", nargs="*", metavar="name=value", help="parameters, or the data in physical units")
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_design(commands: Any) -> None:
    command = _command(commands, "design", _design, "ask a stored atlas what a design has to be")
    questions = ("least-damping", "widest-angle", "speed-windows")
    command.add_argument("question", choices=questions, metavar="QUESTION", help=", ".join(questions))
    command.add_argument("file", metavar="FILE.nc", type=Path)
    command.add_argument("given", nargs="*", metavar="name=value", help="parameters; a range is name=LOW:HIGH")
    command.add_argument("--margin", type=float, default=0.0, help="part of the speed kept clear of every boundary")
    command.add_argument("--json", action="store_true", help="as one JSON object")


def _add_bench(commands: Any) -> None:
    command = _command(commands, "bench", _bench, "measure error and run time against the peers (source checkout only)")
    command.add_argument("systems", nargs="*", metavar="SYSTEM", help="only the studies of these")
    command.add_argument(
        "--quick", action="store_true", help="small forms, minutes; the stored results stay as they are"
    )
    command.add_argument("--out", metavar="FOLDER", type=Path, help="where files and page go")
    command.add_argument("--peers", metavar="PYTHON", help="interpreter of an environment with ROSS and pynamicalsys")


_COMMANDS = (
    _add_list,
    _add_run,
    _add_status,
    _add_verify,
    _add_export,
    _add_plot,
    _add_point,
    _add_query,
    _add_design,
    _add_bench,
)


def _command(commands: Any, name: str, function: Any, text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.set_defaults(command=function)
    return command


def _add_scene(command: argparse.ArgumentParser) -> None:
    command.add_argument("scene", metavar="SCENE.toml", type=Path)
    command.add_argument("--out", required=True, metavar="FILE.nc", type=Path, help="result file")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace an entry of the scene: fixed.zeta=0.002",
    )


def _assignments(texts: Sequence[str], field: str) -> dict[str, Any]:
    """``name=value`` pairs, values in TOML or plain text."""
    from drivetrain_jax.sweep.toml import parse_value

    pairs: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise InputError(f"{field} = {text!r}: allowed is name=value")
        if name in pairs:
            raise InputError(f"{field} = {text!r}: {name} is given twice; allowed is once")
        pairs[name] = parse_value(value)
    return pairs


def _list(options: argparse.Namespace) -> int:
    from drivetrain_jax.sweep.catalogue import describe, overview

    sys.stdout.write(describe(options.system) if options.system else overview())
    return OK


def _run(options: argparse.Namespace) -> int:
    with _stop_on_signals() as check:
        return _compute(options, check)


def _compute(options: argparse.Namespace, check: Callable[[], None]) -> int:
    from drivetrain_jax.sweep.executor import Where
    from drivetrain_jax.sweep.run import Incomplete, Interrupted, run_to_file

    overrides = _assignments(options.set, "--set")
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
                where=Where(options.threads, options.workers, options.dask),
                reuse=options.reuse,
                store=options.store,
                report=report,
            )
            code = OK
        except Incomplete as error:
            progress, code, reason = error.progress, INCOMPLETE, str(error)
        except Interrupted as error:
            progress, code, reason = error.progress, INTERRUPTED, "interrupted; the same command resumes"
    if code != OK:
        sys.stderr.write(_line(reason))
    sys.stderr.write(f"{progress}\n")
    if code == INTERRUPTED and options.workers is None:
        # Chunks that are still being computed would hold up a normal exit; their results are not wanted any more.
        # Processes have been killed by now, and what they shared with this one is given back by a normal exit only.
        sys.stderr.flush()
        os._exit(code)
    return code


@contextmanager
def _stop_on_signals() -> Iterator[Callable[[], None]]:
    """Ctrl-C and a scheduler's SIGTERM raise ``KeyboardInterrupt``, and the function that it gives does so again.

    The second time is for an exception that a destructor or a C callback has swallowed. What these say of it, and of what
    it left half made, is not shown.
    """
    caught: list[int] = []
    before = sys.unraisablehook

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    def stop(number: int, frame: object) -> None:
        del frame
        caught.append(number)
        check()

    def hook(unraisable: Any) -> None:
        if not caught:
            before(unraisable)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    sys.unraisablehook = hook
    try:
        yield check
    finally:
        # After a signal the process is about to end, and what was left half made ends with it.
        if not caught:
            sys.unraisablehook = before


def _progress_line(quiet: bool) -> Any:
    if quiet:
        return nullcontext()
    from drivetrain_jax._progress import progress_line

    return progress_line()


def _status(options: argparse.Namespace) -> int:
    import json

    from drivetrain_jax.sweep.status import status

    found = status(options.scene, options.out, _assignments(options.set, "--set"))
    if options.json:
        sys.stdout.write(json.dumps(found.to_json()) + "\n")
    else:
        sys.stdout.write(f"{found}\n")
    return OK


def _verify(options: argparse.Namespace) -> int:
    import json

    from drivetrain_jax.invariants.verify import verify

    report = verify(options.file)
    if options.json:
        state = "damaged" if report.problem else "complete" if report.complete else "partial"
        sys.stdout.write(json.dumps({"state": state, "problem": report.problem, "checks": report.lines}) + "\n")
    else:
        sys.stdout.write("\n".join(report.lines) + "\n")
    if report.problem:
        raise InputError(f"file = {str(options.file)!r}: {report.problem}")
    return OK if report.complete else INCOMPLETE


def _export(options: argparse.Namespace) -> int:
    from drivetrain_jax.sweep.export import export

    sys.stderr.write(f"points: {export(options.store, options.file)} exported\n")
    return OK


def _plot(options: argparse.Namespace) -> int:
    from drivetrain_jax.store.consolidate import open_result
    from drivetrain_jax.view import plot

    out = options.out
    if not out.parent.is_dir():
        raise InputError(f"out = {str(out)!r}: the folder does not exist; allowed is a file in an existing folder")
    results = [open_result(file) if file.exists() else _open_unfinished(file) for file in options.files]
    if any(result.attrs.get("analysis") == "atlas" for result in results):
        from drivetrain_jax.sweep.atlas_chart import chart

        results = [chart(result, _ranges(options.part, "--part"), options.cells) for result in results]
    elif options.part:
        raise InputError(f"--part = {options.part[0]!r}: a result on a grid is drawn whole; allowed for an atlas")
    figure = plot(*results)
    kinds = figure.canvas.get_supported_filetypes()
    if out.suffix[1:].lower() not in kinds:
        raise InputError(f"out = {str(out)!r}: allowed is a name that ends in .{', .'.join(kinds)}")
    try:
        figure.savefig(out)
    except OSError as error:
        raise InputError(f"out = {str(out)!r}: {error.strerror}; allowed is a file that can be written") from None
    return OK


def _point(options: argparse.Namespace) -> int:
    from drivetrain_jax.sweep.point import point

    given = _assignments(options.given, "point")
    outputs = given.pop("outputs", None)
    if isinstance(outputs, str):
        outputs = outputs.split(",")
    result = point(options.system, options.analysis, outputs=outputs, **given)
    sys.stdout.write((result.to_json() if options.json else repr(result)) + "\n")
    return OK


def _open_unfinished(file: Path) -> Any:
    """What a run has done so far, if one is at work there."""
    from drivetrain_jax.store.chunks import PartsFolder
    from drivetrain_jax.store.consolidate import open_result

    if not PartsFolder(file).holds_work():
        return open_result(file)
    from drivetrain_jax.sweep import partial

    return partial.open_result(file)


def _query(options: argparse.Namespace) -> int:
    from drivetrain_jax.sweep.atlas_answers import query
    from drivetrain_jax.sweep.atlas_file import open_atlas

    reply = query(open_atlas(options.file), _ranges(options.given, "query"))
    sys.stdout.write((reply.to_json() if options.json else str(reply)) + "\n")
    return OK


def _design(options: argparse.Namespace) -> int:
    from drivetrain_jax.sweep import atlas_answers
    from drivetrain_jax.sweep.atlas_file import open_atlas

    atlas, given = open_atlas(options.file), _ranges(options.given, "design")
    question = getattr(atlas_answers, options.question.replace("-", "_"))
    extra = {"margin": options.margin} if options.question == "speed-windows" else {}
    reply = question(atlas, given, **extra)
    sys.stdout.write((reply.to_json() if options.json else str(reply)) + "\n")
    return OK


def _bench(options: argparse.Namespace) -> int:
    import subprocess

    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / "benchmarks" / "__main__.py").is_file():
        raise InputError(
            f"bench: no folder benchmarks/ beside {str(checkout / 'drivetrain_jax')!r}; allowed is a checkout"
        )
    words = [*options.systems, *(["--quick"] if options.quick else [])]
    words += ["--out", str(options.out.absolute())] if options.out else []
    words += ["--peers", options.peers] if options.peers else []
    return subprocess.run([sys.executable, "-m", "benchmarks", *words], cwd=checkout, check=False).returncode


def _ranges(texts: Sequence[str], field: str) -> dict[str, Any]:
    """``name=value`` pairs, values numbers or pairs of them, ``LOW:HIGH``."""
    return {name: _number_or_range(name, value) for name, value in _assignments(texts, field).items()}


def _number_or_range(name: str, value: Any) -> Any:
    try:
        if isinstance(value, str):
            low, high = (float(end) for end in value.split(":"))
            return low, high
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {value!r}: allowed is a number or LOW:HIGH") from None


if __name__ == "__main__":
    sys.exit(main())
