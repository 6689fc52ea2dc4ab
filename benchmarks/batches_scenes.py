"""The scenes that benchmarks.batches runs: one per system and width, set of outputs, number of points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tests.oracles.cardan_reference import BASE_CASE

Scene = dict[str, Any]
_SHAFT = {"length": [0.07, 0.59, 0.25], "EI": [64427.0, 22157.0, 8350.0], "rhoA": [15.3, 2.81, 5.51]}
_RATTLE = {"B0": 0.05, "B1": 0.03, "b": math.pi / 18, "c": 0.05, "alpha": 0.25, "k": 1.0, "I": 1.0}
_TRIPOD = {"element": "input", "beta": math.radians(9), "chi_n": 0.0026, "excitation_frequency": 3066.5}
# Enough points that the plan makes full chunks.
_MANY = 8192


def _scene(
    system: str, analysis: str, outputs: list[str], axes: Mapping[str, Any], fixed: Any, **options: Any
) -> Scene:
    ranges = {name: {"start": a, "stop": b, "num": n} for name, (a, b, n) in axes.items()}
    return {"system": system, "analysis": analysis, "outputs": outputs, "axes": ranges, "fixed": dict(fixed),
            "options": options}  # fmt: skip


def cells(count: int, outputs: tuple[str, ...] = ("spectral_radius", "verdict")) -> Scene:
    """The chart of the cardan shaft with about this many cells, every one solved directly at rtol 1e-9."""
    rows = max(2, round((0.75 * count) ** 0.5))
    axes = {"beta": (0.0, 1.4, rows), "Omega": (0.1, 2.0, max(2, round(count / rows)))}
    return _scene("cardan", "floquet", list(outputs), axes, BASE_CASE, method="direct", rtol=1e-9)


def gears(planets: int, count: int = _MANY, outputs: tuple[str, ...] = ("natural_frequency",)) -> Scene:
    """A planetary gear over the stiffness of its meshes."""
    angles = (2 * math.pi * np.arange(planets) / planets).tolist()
    return _scene("planetary", "modes", list(outputs), {"k_sp": (1e8, 1e9, count)}, {"planet_angle": angles})


def shafts(count: int = _MANY, outputs: tuple[str, ...] = ("natural_frequency",)) -> Scene:
    """The paper's stepped shaft over the stiffness of a support."""
    return _scene("bicardan", "critical_speeds", list(outputs), {"k_A": (1e6, 1e9, count)}, _SHAFT | {"k_D": 2e7})


def rattle(outputs: tuple[str, ...], count: int = 1024) -> Scene:
    """Gear rattle over the frequency."""
    return _scene("rattle", "steady_state", list(outputs), {"omega": (0.3, 1.5, count)}, _RATTLE)


def motion(analysis: str, outputs: tuple[str, ...], count: int = 128, **options: Any) -> Scene:
    """The double tripod over its damping."""
    return _scene("tripod", analysis, list(outputs), {"zeta": (0.01, 0.02, count)}, _TRIPOD, **options)


# Number of planets of the gear in the measurements by width.
FOUR = 4
WIDTHS = {"cardan": cells(_MANY), "planetary": gears(FOUR), "bicardan": shafts()}


def _varied() -> Scene:
    """The points of ``cells`` with the four constants as columns."""
    chart = cells(_MANY)
    grid = np.meshgrid(*(np.linspace(a["start"], a["stop"], a["num"]) for a in chart["axes"].values()), indexing="ij")
    columns = {name: values.ravel().tolist() for name, values in zip(chart["axes"], grid, strict=True)}
    columns |= {name: [value] * grid[0].size for name, value in BASE_CASE.items()}
    return {key: chart[key] for key in ("system", "analysis", "outputs", "options")} | {"points": columns}


# Sets of outputs by system and by the set that the others are compared with.
OUTPUTS: dict[tuple[str, str], dict[str, Scene]] = {
    ("cardan", "spectral_radius"): {
        "spectral_radius": cells(_MANY, ("spectral_radius",)),
        "and verdict, error": cells(_MANY, ("spectral_radius", "spectral_radius_error", "verdict")),
        "and multipliers": cells(_MANY, ("spectral_radius", "floquet_multiplier")),
        "spectral_radius, parameters varied": _varied() | {"outputs": ["spectral_radius"]},
    },
    ("planetary", "natural_frequency"): {
        "natural_frequency": gears(FOUR),
        "and mode_type, mode_shape": gears(FOUR, outputs=("natural_frequency", "mode_type", "mode_shape")),
    },
    ("bicardan", "natural_frequency"): {
        "natural_frequency": shafts(),
        "and mode_shape": shafts(outputs=("natural_frequency", "mode_shape")),
    },
    ("rattle", "u_max, u_min"): {
        "u_max, u_min": rattle(("u_max", "u_min")),
        "and u_history": rattle(("u_max", "u_min", "u_history")),
    },
    ("tripod", "section, no tangent vectors"): {
        "section, no tangent vectors": motion("poincare", ("section",), strobes=512, discard=0, steps=24),
        "lyapunov_spectrum, with them": motion("lyapunov", ("lyapunov_spectrum",), max_time=512 / 3066.5, steps=24),
    },
}  # fmt: skip
COLD = cells(1550)
