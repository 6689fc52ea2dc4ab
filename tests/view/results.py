"""Small synthetic results in the layout of stored files, with a known number of cells in each state."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr
from matplotlib.collections import QuadMesh
from matplotlib.text import Text

LONG_NAMES = {"beta": "joint angle", "Omega": "speed", "mu": "stiffness ratio", "alpha": "damping ratio"}
UNITS = {"beta": "rad"}
FIXED = {"zeta": {"value": 0.001, "units": "1"}, "gamma": {"value": 100.0, "units": "1"}}
ROLES = json.dumps({"speed": "Omega"})
FAMILIES = {
    "H": {"name": "harmonic $H$", "line": "solid", "forced": True},
    "S": {"name": "subharmonic $S$", "line": "dashed"},
    "C": {"name": "sum combination $C^+$", "line": "dashdot"},
    "C-": {"name": "difference combination", "drawn": False},
}


def panels(figure) -> list:
    """Axes of ``figure`` without colour bars."""
    return [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]


def meshes(figure) -> list[QuadMesh]:
    return [artist for axes in panels(figure) for artist in axes.collections if isinstance(artist, QuadMesh)]


def texts(figure) -> list[str]:
    """All texts of ``figure`` on one line each."""
    return [text.get_text().strip().replace("\n", " ").replace("\u00a0", " ") for text in figure.findobj(Text)]


def legend(figure) -> list[str]:
    return [text.get_text() for box in figure.legends for text in box.get_texts()]


def unstable(beta: float | np.ndarray, omega: float | np.ndarray) -> np.ndarray:
    """True within a V-shaped tongue with its tip at (0.2, 1.0)."""
    return np.asarray(beta) > 0.2 + 2 * np.abs(np.asarray(omega) - 1.0)


def grid(values: np.ndarray, *names: str) -> xr.Dataset:
    """Verdicts ``values`` over the axes ``names``; 3 marks a failed cell."""
    code = np.asarray(values)
    radius = np.choose(code, [0.99, 1.25, 1.0, np.nan])
    verdict = np.where(code == 3, 2, code).astype("int8")
    data = {
        "spectral_radius": (names, radius, {"units": "1", "long_name": "spectral radius of the monodromy matrix"}),
        "spectral_radius_error": (names, np.full(code.shape, 1e-3), {"units": "1", "long_name": "bound of its error"}),
        "verdict": (
            names,
            verdict,
            {"units": "1", "long_name": "verdict", "flag_meanings": "stable unstable undecided"},
        ),
        "outcome": (names, np.where(code == 3, 2, 0).astype("int8"), {"units": "1", "long_name": "outcome"}),
    }
    attrs = {"analysis": "floquet", "title": "A tongue", "fixed_parameters": json.dumps(FIXED), "roles": ROLES}
    return xr.Dataset(data, attrs=attrs)


def with_axes(dataset: xr.Dataset, **axes: np.ndarray) -> xr.Dataset:
    described = {
        name: (name, values, {"units": UNITS.get(name, "1"), "long_name": LONG_NAMES.get(name, name)})
        for name, values in axes.items()
    }
    return dataset.assign_coords(described)


def with_resonances(dataset: xr.Dataset, **speeds: float | np.ndarray) -> xr.Dataset:
    """Predicted values of Omega by label (``Cplus1`` for ``C+1``); an array runs along ``mu``."""
    labels = [name.replace("plus", "+").replace("minus", "-") for name in speeds]
    values = np.stack([np.asarray(speed, float) for speed in speeds.values()], axis=-1)
    dims = ("mu", "resonance") if values.ndim == 2 else ("resonance",)
    dataset = dataset.assign_coords(resonance=("resonance", labels), resonance_Omega=(dims, values))
    return dataset.assign_attrs(resonance_families=json.dumps(FAMILIES))


def chart() -> xr.Dataset:
    """beta x Omega with one tongue, two undecided and one failed cell, and predictions."""
    beta, omega = np.linspace(0, 1, 21), np.linspace(0.5, 1.5, 41)
    code = unstable(beta[:, None], omega[None]).astype(int)
    code[0, :2], code[1, 0] = 2, 3
    dataset = with_axes(grid(code, "beta", "Omega"), beta=beta, Omega=omega)
    return with_resonances(dataset, H21=0.7, S21=1.0, Cplus1=1.02, Cminus1=0.9, S11=0.07)


def forced(**axes: np.ndarray) -> xr.Dataset:
    """Amplitudes of two shafts (second twice the first) and the orbit's spectral radius, 1.1 everywhere."""
    shape = tuple(len(values) for values in axes.values())
    amplitude = np.broadcast_to([0.1, 0.2], (*shape, 2)).copy()
    names = (*axes,)
    data = {
        "amplitude": ((*names, "shaft"), amplitude, {"units": "rad", "long_name": "amplitude"}),
        "orbit_spectral_radius": (
            names,
            np.full(shape, 1.1),
            {"units": "1", "long_name": "spectral radius of the orbit"},
        ),
        "outcome": (names, np.zeros(shape, "int8"), {"units": "1", "long_name": "outcome"}),
    }
    attrs = {"analysis": "forced", "title": "Response", "fixed_parameters": json.dumps(FIXED), "roles": ROLES}
    dataset = with_axes(xr.Dataset(data, attrs=attrs), **axes).assign_coords(shaft=("shaft", ["driving", "driven"]))
    return with_resonances(dataset, H21=0.7, S21=1.0)
