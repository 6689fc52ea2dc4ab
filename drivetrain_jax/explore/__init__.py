"""The explorer: an atlas as one HTML page that evaluates it in the browser.

``explore(atlas)`` returns the page. The modules in JavaScript use the algorithms of ``atlas/`` and ``analysis/floquet/``;
pages hold them one after the other.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._units import behind
from drivetrain_jax.atlas.interpolation import coefficients, evaluate, tensor_nodes
from drivetrain_jax.atlas.panels import Atlas, Panel, to_arrays
from drivetrain_jax.systems import Coordinate, FloquetModel, System

if TYPE_CHECKING:
    from drivetrain_jax.runs.atlas_file import StoredAtlas
    from drivetrain_jax.runs.physical import GivenData

__all__ = ["Page", "explore"]


# The data of a page are plain values, and arrays as base64 of little-endian float64.

# Coordinates that the page computes. They are recognised by their values, because a coordinate is a Python function.
_FORMS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "x": np.asarray,
    "1/x": lambda x: 1 / x,
    "1/sqrt(x)": lambda x: 1 / np.sqrt(x),
    "sqrt(x)": np.sqrt,
    "x^2": np.square,
    "ln(x)": np.log,
    "ln sec(x)": lambda x: -np.log1p(-2 * np.sin(x / 2) ** 2),
}
_EPS = np.finfo(float).eps
# Most polynomials per coordinate of a function that the page needs beside the panels, and its relative tolerance.
_MOST, _TOLERANCE = 64, 4 * _EPS
# Polynomials per coordinate of predicted resonances: lines of a figure.
_LINE_DEGREES = {0: 1, 1: 33, 2: 17}

Function = Callable[[np.ndarray], np.ndarray]


def pack(stored: StoredAtlas) -> dict[str, Any]:
    """The data of the page.

    Raises: InputError for a system whose coordinates or reversal the page cannot compute.
    """
    scene, stability = stored.scene, stored.stability
    atlas, system = stability.atlas, scene.system
    form, shaft = stability.form, stored.shaft
    if form.reversal is not None:
        raise InputError(f"system = {system.name!r}: reverses time by matrices; expected a constant reversor, or none")
    arrays = to_arrays(atlas)
    boxes = [{"lower": g.lower.tolist(), "upper": g.upper.tolist(), "reason": g.reason} for g in atlas.gaps]
    return {
        "title": scene.title,
        "system": {"name": system.name, "title": system.title},
        "parameters": [_parameter(stored, k) for k in range(len(atlas.parameters))],
        "fixed": {
            name: _fixed(system, shaft, name, value)
            for name, value in scene.fixed.items()
            if name not in atlas.parameters
        },
        "given": _given(stored),
        "units": _units(system, shaft),
        "rtol": stability.rtol,
        "proof": "verdicts hold by estimate; drivetrain query says which are proved"
        if any(np.isfinite(panel.proved_error) for panel in atlas.panels)
        else "verdicts hold by estimate, not by proof",
        "size": form.size,
        "halves": form.halves,
        "reversor": None if form.reversor is None else np.ravel(form.reversor).tolist(),
        "closed_form": stability.closed_form,
        "hamiltonian": _hamiltonian(atlas, stability.build),
        "symplectic": _model(atlas, stability.build, _inside(atlas, 1)).hamiltonian is not None,
        "time": _time(stability.build, atlas, system),
        "panels": [_panel(atlas, panel, stability.build) for panel in atlas.panels],
        "gaps": boxes,
        "coefficients": encoded(arrays["coefficients"]),
        "kept": base64.b64encode(arrays["kept"].tobytes()).decode(),
        "resonances": _resonances(atlas, system),
    }


def encoded(values: Any) -> str:
    """Base64 of the little-endian float64 of ``values`` in C order."""
    return base64.b64encode(np.ascontiguousarray(values, "<f8").tobytes()).decode()


def _parameter(stored: StoredAtlas, k: int) -> dict[str, Any]:
    atlas, system = stored.stability.atlas, stored.scene.system
    described = system.parameter(atlas.parameters[k])
    lower, upper = float(atlas.lower[k]), float(atlas.upper[k])
    return {
        "name": described.name,
        "symbol": described.symbol or described.name,
        "units": described.units,
        "long_name": described.long_name,
        "lower": lower,
        "upper": upper,
        "form": _form_of(atlas.coordinates[k], described.name, lower, upper),
        "even": atlas.coordinates[k].even,
        "role": next((role for role, name in system.roles.items() if name == described.name), ""),
        "view": _view(stored, described.name),
    }


def _view(stored: StoredAtlas, name: str) -> dict[str, Any] | None:
    """The physical quantity that readers see for a parameter, and its value where the parameter is 1; None without one.

    Angles have units of their own on the page.
    """
    known = stored.views.get(name) or (stored.shaft.back(name) if stored.shaft else None)
    if known is None or stored.scene.system.parameter(name).units == "rad":
        return None
    quantity, convert = known
    factor, ends = float(convert(1.0)), np.array(stored.ranges[name])
    if not np.allclose(convert(ends), factor * ends, rtol=1e-12):
        return None
    return {"symbol": quantity.name, "units": quantity.units, "long_name": quantity.long_name, "factor": factor}


def _form_of(coordinate: Coordinate, name: str, lower: float, upper: float) -> str:
    x = np.linspace(lower, upper, 65)
    wanted = np.asarray(coordinate.forward(x), float)
    with np.errstate(all="ignore"):
        for form, function in _FORMS.items():
            if np.allclose(function(x), wanted, rtol=4 * _EPS, atol=4 * _EPS * np.abs(wanted).max()):
                return form
    raise InputError(
        f"{name}: its coordinate {coordinate.name!r} is not one that the page computes ({', '.join(_FORMS)})"
    )


def _fixed(system: type[System], shaft: GivenData | None, name: str, value: Any) -> str:
    """A fixed value as readers see it: as physical data if these are known."""
    known = shaft.quantity(name, value) if shaft and isinstance(value, float) else None
    label, number, units = known or (name, value, system.parameter(name).units)
    shown = f"{number:.6g}" if isinstance(number, float) else json.dumps(value)
    return f"{label} = {shown}{behind(units)}"


def _given(stored: StoredAtlas) -> dict[str, str]:
    """The fixed values as a scene gives them: physical data, and parameters that do not follow from these."""
    scene, physical = stored.scene, stored.scene.system.physical
    follow = physical.converted(scene.data) if physical and scene.data else {}
    fixed = {n: x for n, x in scene.fixed.items() if n not in stored.parameters and n not in follow}
    # JSON has no infinity.
    return {n: str(x) if isinstance(x, float) else json.dumps(x) for n, x in {**scene.data, **fixed}.items()}


def _units(system: type[System], shaft: GivenData | None) -> dict[str, Any]:
    """The units in which the page begins: those of physical data where the file knows these."""
    speed, inertia, stiffness = system.roles.get("speed"), None, None
    for rule in shaft.physical.conversions if shaft else ():
        if shaft and rule.parameter == speed and len(rule.needs) == 3:
            inertia, stiffness = (shaft.data.get(name) for name in rule.needs[1:])
    known = bool(inertia and stiffness)
    return {"angle": "deg" if shaft else "rad", "speed": "rpm" if known else "1", "J": inertia, "k": stiffness}


def _model(atlas: Atlas, build: Callable[..., FloquetModel], points: np.ndarray) -> FloquetModel:
    return build({**atlas.fixed, **dict(zip(atlas.parameters, points.T, strict=True))})


def _inside(atlas: Atlas, count: int = 32) -> np.ndarray:
    """Points of the domain, in parameters, ``(N, d)``."""
    return np.random.default_rng(0).uniform(atlas.lower, atlas.upper, (count, len(atlas.parameters)))


def _hamiltonian(atlas: Atlas, build: Callable[..., FloquetModel]) -> bool | list[tuple[int, float]]:
    """True if the system is Hamiltonian everywhere, or the parameters and values that make it so."""

    def everywhere(points: np.ndarray) -> bool:
        return bool(np.all(_model(atlas, build, points).is_hamiltonian()))

    points = _inside(atlas)
    if everywhere(points):
        return True
    faces = []
    for k, ends in enumerate(zip(atlas.lower, atlas.upper, strict=True)):
        for value in {*ends, 0.0}:
            at = points.copy()
            at[:, k] = value
            if ends[0] <= value <= ends[1] and everywhere(at):
                faces.append((k, float(value)))
    return faces


def _time(build: Callable[..., FloquetModel], atlas: Atlas, system: type[System]) -> dict[str, Any] | None:
    """The period over which multipliers are taken and the unit of time, None where the period is not one number."""
    span = np.asarray(_model(atlas, build, _inside(atlas)).natural.span, float)
    if span.size != 1:
        return None
    return {"period": float(span.ravel()[0]), "units": system.time_units}


def _panel(atlas: Atlas, panel: Panel, build: Callable[..., FloquetModel]) -> dict[str, Any]:
    def log_determinant(x: np.ndarray) -> np.ndarray:
        model = _model(atlas, build, atlas.to_parameters(x))
        return np.broadcast_to(np.asarray(model.reduced.log_determinant()), (len(x),))[:, None]  # pyright: ignore[reportOptionalCall]

    known = _model(atlas, build, _inside(atlas, 1)).reduced.log_determinant is not None
    return {
        "lower": panel.lower.tolist(),
        "upper": panel.upper.tolist(),
        "degrees": list(panel.degrees),
        "value_error": panel.value_error,
        "log": _interpolated(log_determinant, panel.lower, panel.upper) if known else None,
    }


def _interpolated(function: Function, lower: np.ndarray, upper: np.ndarray) -> dict[str, Any]:
    """Chebyshev coefficients of ``function`` over a box, which maps ``(N, d)`` to ``(N, 1)``, to rounding if possible.

    ``error`` is four times the largest one at points between the nodes.
    """

    def in_box(t: np.ndarray) -> np.ndarray:
        return function((lower * (1 - t) + upper * (1 + t)) / 2)

    d = len(lower)
    degrees = [_degree(in_box, d, k) for k in range(d)]
    tensor = coefficients(in_box(tensor_nodes(degrees)), degrees)
    check = np.vstack([np.random.default_rng(1).uniform(-1, 1, (400, d)), list(product((-1.0, 1.0), repeat=d))])
    exact = in_box(check)
    error = 4 * np.max(np.abs(evaluate(tensor, check) - exact)) + 4 * _EPS * np.max(np.abs(exact))
    return {"degrees": degrees, "coefficients": encoded(tensor), "error": float(error)}


def _degree(at: Function, d: int, k: int) -> int:
    """Number of polynomials along the coordinate ``k`` after which coefficients are rounding, on lines in the box."""
    largest, needed = 0.0, 1
    for others in np.random.default_rng(2).uniform(-1, 1, (4, d)):
        line = np.tile(others, (_MOST, 1))
        line[:, k] = tensor_nodes([_MOST])[:, 0]
        size = np.abs(coefficients(at(line), [_MOST])[:, 0])
        largest = max(largest, float(size.max()))
        needed = max(needed, 1 + int(np.max(np.flatnonzero(size > _TOLERANCE * largest), initial=0)))
    return needed


def _resonances(atlas: Atlas, system: type[System]) -> dict[str, Any] | None:
    """Predicted resonances along their axis, as polynomials of the parameters of the atlas that they depend on."""
    predicted = system.resonances
    if predicted is None or predicted.axis not in atlas.parameters:
        return None
    ends = [c.forward(np.array([a, b])) for c, a, b in zip(atlas.coordinates, atlas.lower, atlas.upper, strict=True)]
    varied = [k for k, name in enumerate(atlas.parameters) if name in predicted.parameters]
    lower, upper = (np.array([pick(ends[k]) for k in varied]) for pick in (np.min, np.max))
    degrees = [_LINE_DEGREES.get(len(varied), 9)] * len(varied)
    t = tensor_nodes(degrees) if varied else np.empty((1, 0))
    x = (lower * (1 - t) + upper * (1 + t)) / 2
    values = dict(atlas.fixed) | {
        atlas.parameters[k]: np.asarray(atlas.coordinates[k].inverse(x[:, i])) for i, k in enumerate(varied)
    }
    speeds = np.broadcast_to(predicted.values(values), (len(t), len(predicted.labels)))
    tensor = coefficients(speeds, degrees) if varied else speeds
    kinds = [predicted.family(label) for label in predicted.labels]
    return {
        "axis": predicted.axis,
        "labels": list(predicted.labels),
        "lines": ["solid" if kind is None else kind.line if kind.drawn else "" for kind in kinds],
        "parameters": varied,
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "degrees": degrees,
        "coefficients": encoded(tensor),
    }


# Modules of the worker and of the page, in the order of their imports.
_EVALUATION = ("linear.js", "quartic.js", "evaluate.js", "grid.js", "worker.js")
_PAGE = ("chart.js", "marks.js", "text.js", "pane.js", "page.js")
_IMPORT = re.compile(r'^import [^;]*? from "\./[\w.]+";\n', re.MULTILINE)
# Height of the page in a notebook.
_HEIGHT = "820px"


@dataclass(frozen=True)
class Page:
    """A page as text; a notebook shows it in a frame."""

    text: str

    def __repr__(self) -> str:
        return f"explorer, {len(self.text) / 1e6:.2f} MB of HTML"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {_HEIGHT}; border: 0"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}" title="explorer"></iframe>'


def explore(stored: StoredAtlas) -> Page:
    """The page that evaluates ``stored`` in a browser.

    Raises: InputError for a system whose coordinates or reversal the page cannot compute.
    """
    data = pack(stored)
    # Inside a script element, `<` could begin its end, whatever a title holds.
    packed = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "TITLE": html.escape(data["title"] or data["system"]["title"]),
        "STYLE": _read("style.css"),
        "EVALUATION": _joined(_EVALUATION),
        "PAGE": _joined(_PAGE),
        "DATA": packed,
    }
    return Page(re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _read("template.html")))


def _joined(names: tuple[str, ...]) -> str:
    """Modules as one classic script: names are shared, so imports and exports are left out."""
    return "\n".join(re.sub(r"^export ", "", _IMPORT.sub("", _read(name)), flags=re.MULTILINE) for name in names)


def _read(name: str) -> str:
    return files("drivetrain_jax.explore").joinpath(name).read_text("utf-8")
