"""Tables of docs/benchmarks.md other than work-precision: atlas, scaling, outputs, peers, sources."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.results_files import ResultFile, against, count, markdown, not_measured, small, whole

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
    "overhead": ("### Overhead of the engine over its kernels", ""),
}


def damping_sentence(file: ResultFile | None) -> str:
    """A sentence that compares the speeds of `direct` and heyoka at each damping."""
    told: list[str] = []
    rates: dict[str, dict[str, float]] = {}
    for row in file.rows if file else ():
        rates.setdefault(row["zeta"], {})[row["method"].partition(",")[0]] = float(row["us_per_point"])
    for zeta, spent in rates.items():
        told.append(f"{against(spent['heyoka batch'] / spent['package'], 'heyoka batch')} at zeta = {float(zeta):g}")
    words = "At strong damping `direct` changes to an implicit scheme, whose cost is independent of damping"
    return f"At Omega = 0.1, `direct` is {', '.join(told)}. {words}." if told else ""


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


def peers(files: Files, images: str) -> list[str]:
    """Tables of the peers that work-precision does not cover."""
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
    return [
        "### Critical speeds: SciPy and ROSS",
        whole(files["critical_speeds"], "critical_speeds", shafts, {"shafts_per_s": count}),
        "### Planetary gears: NumPy and SciPy",
        whole(files["planetary_throughput"], "planetary_throughput", gears, {"gears_per_s": count}),
        "### Gear rattle: diffrax and SciPy with events",
        figure(files, "rattle_throughput", images, "Error against time per period of gear rattle"),
        whole(files["rattle_throughput"], "rattle_throughput", periods, {}),
        "### Lyapunov spectra: heyoka, SciPy, pynamicalsys",
        figure(files, "chaos_precision", images, "Error against rate of Lyapunov spectra"),
        whole(files["chaos"], "chaos", chaos, {"per_s": count}),
        "### heyoka's own forms, batch sizes and tolerances, one core",
        whole(files["heyoka"], "heyoka", heyoka, {"monodromies_per_s": count}),
        "### `direct` and heyoka against damping",
        *([_DAMPING] if files["damping"] else []),
        whole(files["damping"], "damping", damping, {"difference": small}),
    ]


def figure(files: Files, name: str, images: str, words: str) -> str:
    """The link to a figure, or "Not measured" without its CSV file."""
    return f"![{words}]({images}{name}.png)" if files[name] else not_measured(name)


def sources(files: Files) -> str:
    """Date, machine, load and versions of every file."""
    rows = []
    for name, file in files.items():
        if file is None:
            rows.append([f"{name}.csv", "not measured", "", "", ""])
        else:
            load_text = file.facts.get("load", "").partition(" (")[0]
            rows.append([f"{name}.csv", file.facts["date"], file.facts["machine"], load_text, file.facts["versions"]])
    return markdown(["file", "date", "machine", "load 1, 5, 15 min", "versions"], rows)
