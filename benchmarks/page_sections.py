"""Tables of docs/benchmarks.md other than work-precision: atlas, scaling, outputs, peers, sources."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.results_files import ResultFile, count, markdown, not_measured, small, times, whole

Files = Mapping[str, ResultFile | None]
_DAMPING = (
    "At (beta, Omega) = (1, 0.1), one core. At strong damping `direct` changes to an implicit scheme (Radau IIA); its cost "
    "is independent of damping. An explicit scheme, such as a Taylor series, needs steps as short as the fastest decay. "
    "The last column compares the two spectral radii."
)
_SCALING = {
    "batches": (
        "### Batch width, number of points, cores, states",
        "`width` and `planets`: one kernel on one core. `points` and `cores`: a run from its start to the file.",
    ),
    "outputs": (
        "### What each output costs",
        "A kernel computes only the requested outputs. Times are relative to the first set of outputs of each system, on "
        "one core.",
    ),
    "cold_start": ("### Cold start of a small scene", "In seconds. `compiled code`: state of the compilation cache."),
    "waiting": (
        "### CPU seconds of a command",
        "Processes with their start. `first`: without compiled code; the others find it and take new values.",
    ),
    "overhead": ("### Overhead of the engine over its kernels", ""),
}


def warnings(files: Files) -> list[str]:
    """A line if the files are of several commits, and one if other programs used the machine."""
    known = {name: file.facts for name, file in files.items() if file}
    commits: dict[str, list[str]] = {}
    for name, facts in known.items():
        commits.setdefault(facts.get("commit", "unknown"), []).append(name)
    loaded = [f"{name} ({load:g})" for name, facts in known.items() if (load := _other_cores(facts)) > _OTHERS]
    told = []
    if len(commits) > 1:
        each = (
            f"{commit} ({', '.join(names) if len(names) < 4 else 'most files'})" for commit, names in commits.items()
        )
        told.append(f"**Several commits**: {', '.join(each)}.")
    if loaded:
        told.append(f"**Other programs used more than {_OTHERS} cores** during: {', '.join(loaded)}.")
    return told


# Mean number of cores used by other programs from which a measurement counts as disturbed.
_OTHERS = 0.5


def _other_cores(facts: Mapping[str, str]) -> float:
    number, _, rest = facts.get("load", "").partition(" cores")
    return float(number) if rest else 0.0


def random_sentence(file: ResultFile | None) -> str:
    """Coverage of the bounds at random points."""
    if file is None:
        return ""
    rows = [row for row in file.rows if row["over_bound"] != "nan"]
    broken = [row["analysis"] for row in rows if float(row["over_bound"]) > 1]
    largest = max(rows, key=lambda row: float(row["over_bound"]))
    total = sum(int(row["compared"]) for row in rows)
    held = f"**broken** in {', '.join(broken)}" if broken else f"no bound is broken at {total:,} compared random points"
    most = f"{times(float(largest['over_bound']))} of its bound ({largest['analysis']})"
    return f"Bounds: {held}; the largest error is {most}."


def random_points(file: ResultFile | None) -> str:
    """Errors, bounds and times at random points."""
    heads = {
        "analysis": "analysis", "points": "points", "us_median": "us a point, median", "us_99": "99 %",
        "compared": "compared", "error_median": "error, median", "error_99": "99 %", "error_max": "largest",
        "over_bound": "largest error over bound", "not_success": "not success", "outcomes": "outcomes",
    }  # fmt: skip
    errors = dict.fromkeys(("error_median", "error_99", "error_max"), small)
    text = (
        "Each parameter is drawn on its own over several decades (`benchmarks/random_points.py`). Times are on one core. "
        "`tolerance_not_met`: the bound is larger than the tolerance, and the result is kept."
    )
    return "\n\n".join([text, whole(file, "random_points", heads, errors)])


def atlas(file: ResultFile | None) -> str:
    """Cost and error of an atlas compared with heyoka and SciPy."""
    heads = {
        "chart": "cells", "method": "method", "cells_computed": "computed", "cells_per_s": "cells/s",
        "times_heyoka": "times heyoka", "max_error": "largest error", "median_bound": "median bound", "peak_MB": "peak MB",
    }  # fmt: skip
    return whole(file, "atlas", heads, {"cells_per_s": count, "chart": count, "cells_computed": count})


def scaling(files: Files) -> list[str]:
    """Batches, outputs, cold start and the overhead of the engine."""
    found: list[str] = []
    for name, (title, words) in _SCALING.items():
        file = files[name]
        heads = {column: column.replace("_", " ") for column in file.rows[0]} if file else {}
        found += [title, *([words] if words and file else []), whole(file, name, heads, {})]
    return [*found, "Sweeps of 1e9 and 1e12 points: [scaling](scaling.md)."]


def peers(files: Files, images: str, told: Mapping[str, str]) -> list[str]:
    """Tables of the peers that work-precision does not cover; ``told`` are sentences by the name of the file."""
    shafts = {"method": "method", "shafts_per_s": "shafts/s", "ratio": "times", "max_difference": "largest difference"}
    gears = {"planets": "planets", "method": "method", "gears_per_s": "gears/s", "over_numpy_svd": "times NumPy svd",
             "error": "error", "rigid_Hz": "rigid mode / Hz"}  # fmt: skip
    periods = {
        "solver": "solver",
        "rtol": "rtol",
        "us_per_lane_period": "us a period",
        "error": "error",
        "failed": "failed",
    }
    chaos = {"case": "case", "method": "method", "setting": "setting", "error": "error", "per_s": "per s",
             "times_scipy": "times SciPy"}  # fmt: skip
    damping = {"zeta": "zeta", "method": "method", "us_per_point": "us a point", "difference": "largest difference"}
    heyoka = {"form": "form", "tolerance": "tolerance", "batch": "batch", "monodromies_per_s": "monodromies/s",
              "max_error": "largest error"}  # fmt: skip
    parts = [
        "### Critical speeds: SciPy and ROSS",
        told["critical_speeds"],
        whole(files["critical_speeds"], "critical_speeds", shafts, {"shafts_per_s": count}),
        "### Planetary gears: NumPy and SciPy",
        told["planetary_throughput"],
        whole(files["planetary_throughput"], "planetary_throughput", gears, {"gears_per_s": count}),
        "### Gear rattle: diffrax and SciPy with events",
        told["rattle_throughput"],
        figure(files, "rattle_throughput", images, "Error against time per period of gear rattle"),
        whole(files["rattle_throughput"], "rattle_throughput", periods, {}),
        "### Lyapunov spectra: heyoka, SciPy, pynamicalsys",
        told["chaos"],
        figure(files, "chaos_precision", images, "Error against rate of Lyapunov spectra"),
        whole(files["chaos"], "chaos", chaos, {"per_s": count}),
        "### heyoka's own forms, batch sizes and tolerances, one core",
        whole(files["heyoka"], "heyoka", heyoka, {"monodromies_per_s": count}),
        "### `direct` and heyoka against damping",
        _DAMPING if files["damping"] else "",
        whole(files["damping"], "damping", damping, {"difference": small}),
        "### Not measured",
        _NOT_MEASURED,
    ]
    return [part for part in parts if part]


_NOT_MEASURED = (
    "NLDESA (Mathieu charts in JAX) needs NumPy below 1.25 and SciPy below 1.11, with which this package does not run. CAPD "
    "(validated integration in C++) is not available as a Python package."
)


def figure(files: Files, name: str, images: str, words: str) -> str:
    """The link to a figure, or "Not measured" without its CSV file."""
    return f"![{words}]({images}{name}.png)" if files[name] else not_measured(name)


def sources(files: Files) -> str:
    """Date, machine, load and versions of every file."""
    rows = []
    for name, file in files.items():
        if file is None:
            rows.append([f"{name}.csv", "not measured", "", "", "", ""])
        else:
            facts = {key: file.facts.get(key, "unknown") for key in ("date", "commit", "machine", "load", "versions")}
            rows.append([f"{name}.csv", *facts.values()])
    return markdown(["file", "date", "commit", "machine", "load", "versions"], rows)
