"""``make versions``: the wheel with the lowest and the newest versions of its dependencies, on every Python.

For each of them an empty environment gets the wheel, and its commands do a short work, which ends with the result that the
first environment has written. Writes the table of docs/reliability.md.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "faults"))

from page import PAGE, write

from drivetrain_jax._machine import machine
from drivetrain_jax.store.files import now

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = ("distributed", "report", "tables", "zarr")
NEEDED = [*PROJECT["dependencies"], *(each for extra in EXTRAS for each in PROJECT["optional-dependencies"][extra])]
PYTHONS = [each.rpartition(" ")[2] for each in PROJECT["classifiers"] if re.search(r":: 3\.\d", each)]
RESOLUTIONS = {"lowest": "lowest-direct", "newest": "highest"}
FEW = ("--set", "axes.beta.num=3", "--set", "axes.Omega.num=4", "--quiet")
MOTION = ("element=input", "excitation_frequency=3000", "beta=0.157", "zeta=0.0037", "chi_n=0.01")
MORE = (*FEW[:3], "axes.Omega.num=5", "--quiet")
ATLAS = """
system = "cardan"
analysis = "atlas"
axes.beta = { start = 0.1, stop = 0.5 }
fixed = { zeta = 0.001, alpha = 1.0, mu = 1.0, Omega = 1.3, gamma = 100.0 }
"""
POINT = ("mu=1", "Omega=1.3", "zeta=0.001", "alpha=1", "beta=17.2 deg", "gamma=100", "--json")
# What the commands read, and what they have written.
TABLE = """
import openpyxl
book = openpyxl.Workbook()
for row in (["mu"], [1.0]):
    book.active.append(row)
book.save("data.xlsx")
"""
OPENED = """
import sys, numpy, xarray
one, other = xarray.load_dataset("q.nc", engine="h5netcdf"), xarray.open_zarr("q.zarr", consolidated=False).load()
assert one.sizes["beta"] == 3 and one.sizes["Omega"] == 5 and numpy.isfinite(one.spectral_radius).all()
assert all((one[name] == other[name]).all() for name in one)
assert xarray.load_dataset("e.nc", engine="h5netcdf").spectral_radius.equals(one.spectral_radius)
old = xarray.load_dataset("old.nc", engine="h5netcdf")
assert abs(old.spectral_radius - one.spectral_radius).max() < 1e-9
lazy = xarray.open_dataset("a.nc", engine="drivetrain", grid={"beta": 4})
assert numpy.isfinite(lazy.spectral_radius.load()).all()
"""
# Arguments of the command, and what must appear in its output.
WORK = (
    (("run", "quickstart", "--out", "q.nc", *FEW), "computed=12 reused=0"),
    (("run", "quickstart", "--out", "q.nc", *FEW), "computed=0 reused=12"),
    (("run", "quickstart", "--out", "q.nc", *MORE, "--fresh"), "computed=15"),
    (("verify", "q.nc"), ""),
    (("plot", "q.nc", "--out", "q.png"), ""),
    (("report", "q.nc", "--out", "q.html"), ""),
    (("point", "cardan", "floquet", *POINT), "spectral_radius"),
    (("point", "cardan", "floquet", "--data", "data.xlsx", *POINT[1:]), "spectral_radius"),
    (("point", "tripod", "lyapunov", *MOTION), "Periodic."),
    (("run", "atlas.toml", "--out", "a.nc", "--quiet"), ""),
    (("query", "a.nc", "beta=0.3", "--json"), "spectral_radius"),
    (("explore", "a.nc", "--out", "a.html"), ""),
    (("run", "quickstart", "--out", "q.zarr", "--store", "zarr", *MORE), "computed=15"),
    (("export", "q.zarr", "e.nc"), ""),
    (("run", "quickstart", "--out", "w.nc", "--workers", "2", *FEW), "computed=12"),
    (("run", "quickstart", "--out", "d.nc", "--dask", "local:2", *FEW), "computed=12"),
    (("verify", "old.nc"), ""),
)


def call(*command: object, cwd: Path) -> str:
    """Output of a command; a failure is an error that shows it."""
    done = subprocess.run([*map(str, command)], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))} ended with {done.returncode}\n{done.stdout[-3000:]}")
    return done.stdout


def interpreter(version: str) -> str:
    """A Python of this version, on the path or of pyenv; empty without one."""
    names = [shutil.which(f"python{version}"), *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python3"))]
    for name in filter(None, names):
        done = subprocess.run([name, "-c", "import sys; print(sys.version)"], capture_output=True, text=True)
        if done.stdout.startswith(f"{version}."):
            return name
    return ""


def environment(uv: Path, folder: Path, python: str, resolution: str, wheel: Path) -> Path:
    """An environment with the wheel; returns its folder of programs."""
    programs = folder / "environment" / "bin"
    call(uv, "venv", "--quiet", "--clear", "--python", python, programs.parent, cwd=folder)
    install = [uv, "pip", "install", "--quiet", "--only-binary", ":all:", "--python", programs / "python"]
    call(*install, "--resolution", RESOLUTIONS[resolution], f"drivetrain_jax @ {wheel.as_uri()}", *NEEDED, cwd=folder)
    return programs


def short_work(programs: Path, folder: Path, old: Path) -> None:
    """Commands from a run to an export; a wrong one raises ``RuntimeError``. The first result is kept as ``old``."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "atlas.toml").write_text(ATLAS)
    call(programs / "python", "-c", TABLE, cwd=folder)
    for words, wanted in WORK:
        if "old.nc" in words:
            shutil.copy(old if old.exists() else folder / "q.nc", folder / "old.nc")
        said = call(programs / "drivetrain", *words, cwd=folder)
        if wanted not in said or "Warning" in said:
            raise RuntimeError(f"{' '.join(words)}: no {wanted!r}, or a warning, in {said!r}")
    call(programs / "python", "-c", OPENED, cwd=folder)
    shutil.copy(folder / "old.nc", old)


def versions(programs: Path) -> str:
    """Versions of the direct dependencies."""
    names = [re.split(r"[<>=\[ ]", each)[0] for each in NEEDED]
    code = "import json, sys, importlib.metadata as m; print(json.dumps([m.version(n) for n in sys.argv[1:]]))"
    found = json.loads(call(programs / "python", "-c", code, *names, cwd=programs))
    return ", ".join(f"{name} {version}" for name, version in zip(names, found, strict=True))


def row(uv: Path, folder: Path, version: str, resolution: str, wheel: Path) -> tuple[bool, str]:
    """True if everything works, and the row of the table."""
    place, installed, begin = folder / f"{version}-{resolution}", "", time.monotonic()
    place.mkdir(parents=True)
    try:
        programs = environment(uv, place, interpreter(version), resolution, wheel)
        installed = versions(programs)
        short_work(programs, place / "work", folder / "old.nc")
        good = True
    except RuntimeError as error:
        sys.stderr.write(f"{error}\n")
        good = False
    text = f"{'passes' if good else 'fails'} | {time.monotonic() - begin:.0f} s"
    sys.stderr.write(f"Python {version}, {resolution}: {text}; {installed}\n")
    shutil.rmtree(place)
    return good, f"| {version} | {resolution} | {installed} | {text} |"


def main() -> int:
    """Check all of them; the exit code is 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "pythons", nargs="*", default=PYTHONS, help="versions of Python; default: all of pyproject.toml"
    )
    parser.add_argument("--only", choices=RESOLUTIONS, help="the page stays as it is then")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    found, lines = (
        [],
        [f"{machine()}, {now()[:10]}. {len(WORK)} commands each: run, resume, verify, plot, report, point,"],
    )
    lines[0] += (
        " tables, atlas, query, explorer, Zarr, export, processes, Dask, and the result that the first row has written."
    )
    lines += ["", "| Python | versions | installed | result | time |", "| --- " * 5 + "|"]
    with tempfile.TemporaryDirectory(prefix="versions-") as name:
        folder = Path(name)
        call(sys.executable, "-m", "venv", folder / "tools", cwd=folder)
        call(folder / "tools" / "bin" / "python", "-m", "pip", "install", "--quiet", "uv", cwd=folder)
        uv = folder / "tools" / "bin" / "uv"
        call(uv, "build", "--quiet", "--wheel", "--out-dir", folder / "wheel", cwd=ROOT)
        (wheel,) = (folder / "wheel").glob("*.whl")
        for version in options.pythons:
            for resolution in [options.only] if options.only else RESOLUTIONS:
                if interpreter(version):
                    good, line = row(uv, folder, version, resolution, wheel)
                else:
                    good, line = False, f"| {version} | {resolution} | no interpreter | fails | |"
                found.append(good)
                lines.append(line)
                # What is known is kept if this is stopped.
                if not options.only:
                    write("versions", "\n".join(lines), options.page)
    return int(not all(found))


if __name__ == "__main__":
    sys.exit(main())
