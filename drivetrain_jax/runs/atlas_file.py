"""Atlas files: panels as a labelled result, and the object that evaluates them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from drivetrain_jax import _programs
from drivetrain_jax._errors import InputError, counted, did_you_mean, shown
from drivetrain_jax._quantities import Parameter
from drivetrain_jax._units import behind, factor
from drivetrain_jax.analysis import OUTCOME, Request, get_analysis
from drivetrain_jax.analysis._base import make_request
from drivetrain_jax.analysis.atlas import ANALYSIS
from drivetrain_jax.atlas import StabilityAtlas, from_arrays, proof, stability_atlas, to_arrays
from drivetrain_jax.atlas.balls import contradictions
from drivetrain_jax.atlas.floquet import floquet_domain, smoothness
from drivetrain_jax.runs.assemble import ResultBuffer, labelled, result_attrs
from drivetrain_jax.runs.axes import Axis, in_unit
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.physical import GivenData, in_parameters
from drivetrain_jax.runs.reuse import ReusedPoints
from drivetrain_jax.runs.scene import Scene, atlas_ranges, restore_scene
from drivetrain_jax.runs.through_atlas import build_atlas, evaluate
from drivetrain_jax.runs.work import DIRECT, Progress, Route, Threads, Work
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import Entry, Labelled, open_result, read_plain, write_result
from drivetrain_jax.store.files import ATLAS_PREFACE

if TYPE_CHECKING:
    import xarray as xr

    from drivetrain_jax.explore import Page

# The quantity that is shown for a parameter, and the way to its values.
View = tuple[Parameter, Callable[[Any], Any]]
# Relative tolerance within which a value equals a fixed parameter of an atlas.
SAME_FIXED = 5e-4
# Relative tolerance within which a value equals an end of a range: values converted from other units, or copied from a
# message, are rounded.
_SAME_END = 1e-9


def moved_within(value: Any, ends: tuple[float, float]) -> Any:
    """``value`` (or both ends of a range), moved to an end of the atlas if it is that close."""
    if isinstance(value, tuple):
        return tuple(moved_within(number, ends) for number in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    return next((end for end in ends if math.isclose(value, end, rel_tol=_SAME_END)), value)


def check_same(name: str, value: Any, fixed: float, source: str = "", units: str = "1") -> None:
    """Raise :class:`InputError` unless ``value`` is the ``fixed`` one of the atlas, which may be typed with four digits.

    ``source`` names the physical data from which it follows.
    """
    if isinstance(value, tuple) or not np.allclose(value, fixed, rtol=SAME_FIXED, atol=0):
        written = f"{name} = {as_given(value)}{behind(units)}" + (f" (from {source})" if source else "")
        raise InputError(f"{written}: the atlas is made for {name} = {fixed:.6g}{behind(units)}; expected that value")


def as_given(value: Any) -> str:
    """A number or a range as text: ``1.3:1.5``."""
    ends = value if isinstance(value, tuple) else (value,)
    return ":".join(f"{end:.10g}" if isinstance(end, (int, float)) else shown(end) for end in ends)


def broadcast(values: Mapping[str, Any]) -> tuple[xr.DataArray, ...]:
    """Arrays of one shape: unlabelled ones are broadcast by position, then all by dimension names."""
    import xarray as xr

    plain = {name: np.asarray(v, float) for name, v in values.items() if not isinstance(v, xr.DataArray)}
    try:
        plain = dict(zip(plain, np.broadcast_arrays(*plain.values()), strict=True))
        labelled: dict[str, Any] = {
            n: xr.DataArray(v, dims=("point",) if v.ndim == 1 else None) for n, v in plain.items()
        }
        arrays = [labelled.get(name, value) for name, value in values.items()]
        # The default of `broadcast` is the union of labels, with NaN for missing ones.
        return xr.broadcast(*xr.align(*arrays, join="exact", copy=False))
    except ValueError:
        shapes = ", ".join(f"{name} {np.shape(value)}" for name, value in values.items())
        allowed = "arrays that broadcast against each other, of the same labels along a dimension that they share"
        raise InputError(f"shapes {shapes}: expected {allowed}") from None


# Values along each axis of the stored chart.
_CELLS = 256
# Most cells of a chart whose proofs are counted: a cell takes two microseconds.
_TESTED = 1 << 16
# Random points compared with ball arithmetic.
_BALLS = 100
# Relative error of forced amplitudes, which are compared with a limit.
_AMPLITUDE = 1e-6
# Variables of the file: name, dimensions, meaning. Boxes are in the coordinates named by the attribute.
_VARIABLES = {
    "lower": (("parameter",), "lower end of the domain, in the parameter's unit"),
    "upper": (("parameter",), "upper end of the domain, in the parameter's unit"),
    "panel_lower": (("panel", "parameter"), "lower corner of a panel, in coordinates"),
    "panel_upper": (("panel", "parameter"), "upper corner of a panel, in coordinates"),
    "panel_degrees": (("panel", "parameter"), "number of Chebyshev polynomials of a panel"),
    "value_error": (("panel",), "bound of the error of the propagator (Frobenius norm)"),
    "proved_error": (("panel",), "proved bound of the same, see the attribute theorem; inf without one"),
    "coefficients": (("coefficient", "entry"), "Chebyshev coefficients that are not 0, panel after panel in C order"),
    "kept": (("byte",), "bits that say which coefficients are not 0, of all panels together (most significant first)"),
    "gap_lower": (("gap", "parameter"), "lower corner of a box without a panel, in coordinates"),
    "gap_upper": (("gap", "parameter"), "upper corner of a box without a panel, in coordinates"),
}
PROVED = {"units": "1", "long_name": "the verdict is proved"}
# Every atlas has a domain, and panels, gaps or both.
_DOMAIN, _GAPS = ("lower", "upper"), ("gap_lower", "gap_upper", "gap_reason")
_PANELS = tuple(name for name in _VARIABLES if name not in (*_DOMAIN, *_GAPS, "proved_error"))
_ATTRIBUTES = ("scene", "coordinates_of_panels", "tolerance", "solves")


def to_labelled(stability: StabilityAtlas, scene: Scene) -> Labelled:
    """The result of a scene of an atlas: its panels, and a chart that readers without this package show."""
    stored = StoredAtlas(scene, replace(stability, keep=partial(_programs.kept, scene.system))).viewed({})
    atlas, chart = stability.atlas, _chart(stored)
    arrays = to_arrays(atlas)
    data = {
        name: Entry(dims, arrays[name], {"units": "1", "long_name": meaning})
        for name, (dims, meaning) in _VARIABLES.items()
        if arrays[name].size
    }
    names = {"units": "1", "long_name": "name of the parameter"}
    coords = {"parameter": Entry(("parameter",), np.array(atlas.parameters), names)}
    if atlas.gaps:
        reason = {"units": "1", "long_name": "reason for the missing panel"}
        coords["gap_reason"] = Entry(("gap",), arrays["gap_reason"].astype(str), reason)
    attrs = result_attrs(scene) | {
        "coordinates_of_panels": json.dumps([c.name for c in atlas.coordinates]),
        "tolerance": atlas.tolerance,
        "solves": atlas.solves,
    }
    attrs |= {"theorem": proof.THEOREM} if atlas.panels and proof.is_proved(atlas) else {}
    return Labelled({**coords, **chart.coords}, {**data, **chart.data}, attrs)


def _chart(atlas: StoredAtlas) -> Labelled:
    """The results on ``_CELLS`` values of each of the first two parameters, with the others in the middle of their ranges.

    Cells in gaps have no value.
    """
    shown = atlas.parameters[:2]
    middle = {name: sum(ends) / 2 for name, ends in atlas.ranges.items() if name not in shown}
    axes = {name: np.linspace(*atlas.ranges[name], _CELLS) for name in shown}
    part = atlas.slice(middle)
    whole = labelled(part.scene_on(axes), part.arrays(axes, solve=False), {})
    fixed = {n: Entry(*entry) for name, x in middle.items() for n, entry in atlas.coordinates(name, x).items()}
    # An outcome counts points of a run, and an atlas has none.
    return Labelled({**whole.coords, **fixed}, {n: e for n, e in whole.data.items() if n != OUTCOME.name}, {})


def open_atlas(source: str | Path | xr.Dataset) -> StoredAtlas:
    """The :class:`StoredAtlas` of a scene with ``analysis = "atlas"``, from its file or its dataset.

    Raises :class:`InputError` if ``source`` is not an atlas or is damaged, or if its system is not installed or has other
    coordinates now.

    >>> import drivetrain_jax as dt
    >>> base = {"beta": 0.3, "zeta": 0.01, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    >>> axes = {"Omega": {"start": 1.0, "stop": 1.2}}
    >>> atlas = dt.open_atlas(dt.run({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": base}))
    >>> print(atlas(Omega=1.1).verdict.item())
    0
    """
    _programs.enable(short=True)
    label = f"file = {str(source)!r}" if isinstance(source, (str, Path)) else "dataset"
    arrays, attrs = _content(source, label)
    if missing := _missing(arrays, attrs):
        raise InputError(f"{label}: lacks {missing[0]}; expected the whole result of a scene of an atlas")
    scene = restore_scene(attrs["scene"])
    names, ends = tuple(map(str, arrays["parameter"])), zip(arrays["lower"], arrays["upper"], strict=True)
    ranges = dict(zip(names, ends, strict=True))
    domain = floquet_domain(scene.system, ranges, scene.fixed)
    if [c.name for c in domain.coordinates] != json.loads(attrs["coordinates_of_panels"]):
        raise InputError(f"{label}: made by another version of {scene.system.name}; run its scene again")
    blank = {name: np.empty((0, len(names))) for name in ("panel_lower", "panel_upper", "gap_lower", "gap_upper")}
    blank |= {"panel_degrees": np.empty((0, len(names)), int), "gap_reason": np.empty(0), "kept": np.empty(0, np.uint8)}
    arrays = blank | {"coefficients": np.empty((0, 0))} | arrays
    used = {name: scene.fixed[name] for name in scene.system.models["atlas"].parameters if name in scene.fixed}
    atlas = from_arrays(arrays, names, domain.coordinates, used, attrs["tolerance"], attrs["solves"])
    stability = stability_atlas(atlas, scene.system, scene.request.options["rtol"])
    return StoredAtlas(scene, replace(stability, keep=partial(_programs.kept, scene.system))).viewed({})


def _content(source: str | Path | xr.Dataset, label: str) -> tuple[dict[str, np.ndarray], Mapping[str, Any]]:
    """Variables and attributes of an atlas; :class:`InputError` for another result, or for a damaged file."""
    path = Path(os.path.expanduser(source)) if isinstance(source, (str, Path)) else None
    changed = checksums.damaged(path) if path and path.exists() else None
    if path and changed == []:
        arrays, attrs = read_plain(path)
    else:
        dataset: xr.Dataset = open_result(path) if path else source  # pyright: ignore[reportAssignmentType]
        attrs = dataset.attrs
        arrays = {n: dataset[n].values for n in (*_VARIABLES, "parameter", "gap_reason") if n in dataset}
    if attrs.get("analysis") != ANALYSIS.name:
        raise InputError(f"{label}: holds the analysis {attrs.get('analysis')!r}; expected an atlas")
    # Every file of a run has checksums and a digest.
    if changed or (path and changed is None and "digest" in attrs):
        what = checksums.named(changed) if changed else "its checksums are gone"
        raise InputError(f"{label}: damaged ({what}); restore it or run it again")
    return arrays, attrs


def _missing(arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any]) -> list[str]:
    """Names of the variables and attributes of :func:`to_labelled` that are missing."""
    gaps = any(name in arrays for name in _GAPS)
    panels = not gaps or any(name in arrays for name in _PANELS)
    needed = ("parameter", *_DOMAIN, *(_PANELS if panels else ()), *(_GAPS if gaps else ()))
    missing = [name for name in needed if name not in arrays]
    missing += [name for name in _ATTRIBUTES if name not in attrs]
    if missing or not panels:
        return missing
    bits = np.unpackbits(np.asarray(arrays["kept"], np.uint8))
    missing += ["some of kept"] if bits.size < arrays["panel_degrees"].prod(axis=-1).sum() else []
    missing += ["some of coefficients"] if len(arrays["coefficients"]) != bits.sum() else []
    return missing


def _meshed(axes: Mapping[str, np.ndarray], fixed: Mapping[str, float]) -> dict[str, Any]:
    return {**fixed, **dict(zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True))}


@dataclass(frozen=True)
class StoredAtlas:
    """A stability atlas as a function: ``atlas(beta=0.31, Omega=1.2)``.

    ``scene`` is the scene that computed it; ``stability`` evaluates its panels. Points in gaps are solved directly.
    ``views`` are the quantities that results and messages show for parameters.
    """

    scene: Scene
    stability: StabilityAtlas
    views: Mapping[str, View] = field(default_factory=dict)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that may vary."""
        return self.stability.atlas.parameters

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Least and largest value of each parameter."""
        atlas = self.stability.atlas
        ends = zip(atlas.lower.tolist(), atlas.upper.tolist(), strict=True)
        return dict(zip(atlas.parameters, ends, strict=True))

    @property
    def fixed(self) -> Mapping[str, Any]:
        """Values of the fixed parameters."""
        return self.stability.atlas.fixed

    @property
    def shaft(self) -> GivenData | None:
        """The physical data of the scene, None without any."""
        return in_parameters(self.scene.system, {}, self.scene.data)[0]

    def allowed(self, name: str) -> str:
        """The range of a parameter as text: ``0 <= beta <= 1.5, in rad``."""
        shown, low, high = self.viewed_as(name, *self.ranges[name])
        return f"{low:.10g} <= {shown.name} <= {high:.10g}" + ("" if shown.units == "1" else f", in {shown.units}")

    def viewed_as(self, name: str, *values: Any) -> tuple[Any, ...]:
        """The quantity that is shown for a parameter, or the parameter itself, and ``values`` of it."""
        quantity, convert = self.views.get(name) or (self.scene.system.parameter(name), lambda value: value)
        return quantity, *map(convert, values)

    def viewed(self, given: Mapping[str, Any], named: Container[str] = ()) -> StoredAtlas:
        """The atlas with physical data in place of parameters that its scene or ``given`` has as such, or that are named.

        Numbers in ``given`` have the quantity's own unit, everything else that of the scene.
        """
        data = in_parameters(self.scene.system, given, self.scene.data)[0]
        units = {axis.name: axis.shown.parameter.units for axis in self.scene.axes if axis.given}
        views: dict[str, View] = {}
        for name in self.parameters:
            back = data.back(name) if data and name not in given and name not in named else None
            if back and (name in units or back[0].name in given or back[0].name in named):
                quantity, convert = back
                written = np.asarray(given.get(quantity.name, "")).dtype.kind == "U"
                unit = units.get(name, quantity.units) if written else quantity.units
                views[name] = in_unit(quantity, unit), partial(_scaled, convert, 1 / factor(unit, quantity.units))
        return replace(self, views=views)

    def labels(self, name: str) -> dict[str, str]:
        """Unit and meaning of a parameter, as attributes."""
        parameter = self.scene.system.parameter(name)
        return {"units": parameter.units, "long_name": parameter.long_name}

    def check_within(self, name: str, numbers: np.ndarray) -> np.ndarray:
        """Values of a parameter, those that are an end of its range up to rounding moved to it; :class:`InputError` for
        values outside."""
        low, high = self.ranges[name]
        outside = ~((numbers >= low) & (numbers <= high))
        if outside.any():
            ends = np.where(numbers < low, low, high)
            same = outside & np.isclose(numbers, ends, rtol=_SAME_END, atol=0)
            numbers, outside = np.where(same, ends, numbers), outside & ~same
        if outside.any():
            shown, value = self.viewed_as(name, numbers[outside].flat[0])
            raise InputError(f"{shown.name} = {value:.10g}: expected {self.allowed(name)}")
        return numbers

    def refuse(self, name: str, value: Any, *others: str) -> NoReturn:
        """Raise :class:`InputError` for a name that is neither a parameter nor one of ``others``."""
        if name in self.fixed:
            made = f"the atlas is made for {name} = {as_given(self.fixed[name])}"
            raise InputError(f"{name} = {as_given(value)}: {made}; leave it out")
        guess = did_you_mean(name, (*self.parameters, *(shown.name for shown, _ in self.views.values()), *others))
        allowed = "; ".join(map(self.allowed, self.parameters))
        raise InputError(f"{name} = {as_given(value)}: not a parameter of the atlas{guess}; expected {allowed}")

    def __repr__(self) -> str:
        ends = [self.viewed_as(name, *ends) for name, ends in self.ranges.items()]
        ranges = ", ".join(f"{q.name} {a:g} to {b:g}{behind(q.units)}" for q, a, b in ends)
        atlas = self.stability.atlas
        fixed = ", ".join(f"{name} = {value:g}" for name, value in self.fixed.items())
        parts = f"{counted(len(atlas.panels), 'panel', 'panels')}, {counted(len(atlas.gaps), 'gap', 'gaps')}"
        return f"{self.scene.system.name} atlas: {ranges}; {fixed}; {parts}"

    def __call__(self, *, proved: bool = True, **values: Any) -> xr.Dataset:
        """Results at points: every parameter is a number or an array; they are broadcast against each other.

        Arrays of xarray keep their dimensions and labels; others have the dimension ``point`` (or ``dim_0``, ``dim_1``,
        ...). The flags ``proved`` take four fifths of the time. Raises :class:`InputError` for a missing or unknown name, a
        value outside the atlas, or shapes or labels that do not match; :class:`ChunkError` if a direct solve in a gap fails.
        """
        import xarray as xr

        self, values = self.viewed(values), self.in_parameters(values)
        checked = {name: self._checked(name, values) for name in self._names(values)}
        columns = dict(zip(checked, broadcast(checked), strict=True))
        whole = columns[self.parameters[0]]
        shape, dims = whole.shape, whole.dims
        flat = {name: np.asarray(column.values, float).reshape(-1) for name, column in columns.items()}
        dataset = labelled(self.scene_on(flat, zipped=True), self.arrays(flat, zipped=True), {}).to_dataset()
        inner = {name: v.dims[1:] for name, v in dataset.data_vars.items()}
        data = {
            name: ((*dims, *inner[name]), v.values.reshape((*shape, *v.shape[1:])), v.attrs)
            for name, v in dataset.data_vars.items()
        }
        if proved and "verdict" in dataset:
            verdict = np.asarray(dataset["verdict"].values)
            data["proved"] = (dims, self.proved(flat, verdict).reshape(shape), PROVED)
        labels = {dim: whole.coords[dim] for dim in dims if dim in whole.coords}
        for name, value in checked.items():
            column = value if isinstance(value, xr.DataArray) else columns[name]
            labels |= self.coordinates(name, column.values, column.dims)
        return xr.Dataset(data, labels, dataset.attrs)

    def grid(self, *, proved: bool = False, **given: Any) -> xr.Dataset:
        """Results on the outer product of arrays, as of a scene with these axes; a number fixes its parameter.

        The dimensions have the order in which the arrays are given; a number is a coordinate without a dimension.
        ``proved`` adds the flags of a call, which take ten times as long as the results. Raises the errors of a call.
        """
        self, values = self.viewed(given), self.in_parameters(given)
        self._names(values)
        order = {name: k for k, name in enumerate(given)}
        names = sorted(values, key=lambda name: order.get(self.viewed_as(name)[0].name, len(order)))
        columns = {name: np.asarray(self._checked(name, values), float) for name in names}
        axes = {name: column for name, column in columns.items() if column.ndim}
        for name, column in axes.items():
            if column.ndim > 1 or not column.size:
                shown = self.viewed_as(name)[0].name
                raise InputError(f"{shown}: an array of shape {column.shape}; expected a number or a row of numbers")
        if not axes:
            return self(proved=proved, **given)
        fixed = {name: float(column) for name, column in columns.items() if not column.ndim}
        part = self.slice(fixed)
        dataset = labelled(part.scene_on(axes), part.arrays(axes), {}).to_dataset()
        if proved and "verdict" in dataset:
            flags = self.proved(_meshed(axes, fixed), np.asarray(dataset["verdict"].values))
            dataset["proved"] = (dataset["verdict"].dims, flags, PROVED)
        return self.with_fixed(dataset, fixed)

    def proof(self, axes: Mapping[str, np.ndarray], fixed: Mapping[str, float], verdict: np.ndarray) -> str:
        """The number of proved verdicts of a chart, as a part of a sentence; of a large chart some cells are tested."""
        step = math.ceil((verdict.size / _TESTED) ** (1 / verdict.ndim))
        mesh = _meshed({name: axis[::step] for name, axis in axes.items()}, fixed)
        flags = self.proved(mesh, verdict[(slice(None, None, step),) * verdict.ndim])
        return proof.summary(flags, "cells tested" if step > 1 else "cells")

    def with_fixed(self, dataset: xr.Dataset, fixed: Mapping[str, float]) -> xr.Dataset:
        """``dataset`` with ``fixed`` parameters as coordinates."""
        for name, value in fixed.items():
            dataset = dataset.assign_coords(self.coordinates(name, value))
        return dataset

    def coordinates(self, name: str, values: Any, dims: tuple[Any, ...] = ()) -> dict[str, Any]:
        """A parameter as a coordinate, behind the quantity that is shown for it."""
        values = np.asarray(values, float)
        shown, quantity = self.viewed_as(name, values)
        about = {"units": shown.units, "long_name": shown.long_name}
        return {shown.name: (dims, quantity, about), name: (dims, values, self.labels(name))}

    def explore(self) -> Page:
        """The explorer: an HTML page that evaluates the atlas in the browser, which a notebook shows.

        Returns: the page; ``text`` is its HTML, one file that loads nothing.

        Raises: InputError for a system whose coordinates the page cannot compute.
        """
        from drivetrain_jax.explore import explore

        return explore(self)

    def slice(self, values: Mapping[str, float]) -> StoredAtlas:
        """The atlas of the remaining parameters, with those in ``values`` fixed at values within their ranges."""
        return replace(self, stability=self.stability.slice(values)) if values else self

    def arrays(
        self, columns: Mapping[str, np.ndarray], *, zipped: bool = False, solve: bool = True
    ) -> Mapping[str, np.ndarray]:
        """Results by name on the outer product of ``columns``, or at one point for each entry of them if ``zipped``.

        Without ``solve`` a point in a gap has no value and the outcome ``LOST``.
        """
        job = Job(self.scene_on(columns, zipped=zipped), DIRECT)
        buffer = ResultBuffer(job.scene, job.grid)
        evaluate(job, buffer, self.stability, Work(Threads()), Progress(job.total), solve=solve)
        return buffer.lay_out()

    def scene_on(self, columns: Mapping[str, np.ndarray], *, zipped: bool = False) -> Scene:
        """The ``floquet`` scene with the results of :meth:`arrays`."""
        return self._scene(columns, "floquet", self.request, zipped)

    @property
    def request(self) -> Request:
        """The request of the ``floquet`` analysis: its outputs and options."""
        return Request(self.scene.request.outputs, "atlas", self.scene.request.options)

    def proved(self, columns: Mapping[str, Any], verdict: np.ndarray) -> np.ndarray:
        """Flags, in the shape of ``verdict``, of the verdicts that are proved; ``columns`` are broadcast to this shape."""
        full = [np.broadcast_to(np.asarray(columns[name], float), np.shape(verdict)) for name in self.parameters]
        codes = proof.verdicts(
            self.stability.atlas, self.scene.system, np.stack([column.reshape(-1) for column in full], axis=-1)
        )
        codes = codes.reshape(np.shape(verdict))
        return (codes != proof.UNDECIDED) & (codes == verdict)

    def direct(self, columns: Mapping[str, np.ndarray], result: str = "spectral_radius") -> np.ndarray:
        """Values ``(N,)`` of a result by direct solves, without the panels; ``columns`` holds all parameters.

        Raises :class:`ChunkError` if a solve fails.
        """
        return self._solved(columns, "floquet", Request((result,), "direct", self.scene.request.options))

    def amplitude(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Amplitudes ``(N, displacements)`` of the forced motion by direct solves; ``columns`` holds all parameters."""
        forced = get_analysis("forced").for_system(self.scene.system)
        return self._solved(
            columns, "forced", make_request(self.scene.system, forced, ["amplitude"], {"rtol": _AMPLITUDE})
        )

    def _solved(self, columns: Mapping[str, np.ndarray], analysis: str, request: Request) -> np.ndarray:
        axes = {name: column for name, column in columns.items() if name in self.parameters}
        job = Job(self._scene(axes, analysis, request, zipped=True), DIRECT)
        buffer = ResultBuffer(job.scene, job.grid)
        Work(Threads()).do(job, buffer.fill, Progress(job.total))
        return buffer.lay_out()[request.outputs[0]]

    def in_parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """``values`` with parameters of the atlas for physical data, and numbers for texts; fixed ones must agree."""
        _, parameters = in_parameters(self.scene.system, values, self.scene.data)
        for name in self.fixed.keys() & parameters.keys():
            if not np.issubdtype(np.asarray(parameters[name]).dtype, np.number):
                self.refuse(name, parameters[name])
            check_same(name, parameters[name], self.fixed[name])
        return {name: value for name, value in parameters.items() if name not in self.fixed}

    def _names(self, values: Mapping[str, Any]) -> tuple[str, ...]:
        for name in values:
            if name not in self.parameters:
                self.refuse(name, values[name])
        for name in self.parameters:
            if name not in values:
                raise InputError(f"{self.viewed_as(name)[0].name}: missing; expected {self.allowed(name)}")
        return self.parameters

    def _checked(self, name: str, values: Mapping[str, Any]) -> Any:
        try:
            numbers = np.asarray(values[name])
        except (TypeError, ValueError):
            # Numbers that jax traces, or rows of different lengths.
            numbers = np.empty(0, object)
        if numbers.dtype.kind not in "iuf":
            raise InputError(f"{name} = {shown(values[name])}: expected numbers")
        moved = self.check_within(name, numbers)
        if np.array_equal(moved, numbers):
            return values[name]
        return values[name].copy(data=moved) if hasattr(values[name], "dims") else moved

    def _axis(self, name: str, values: np.ndarray) -> Axis:
        shown, quantity = self.viewed_as(name, values)
        quantities = (Axis(shown.name, shown, None, quantity),) if name in self.views else ()
        return Axis(name, self.scene.system.parameter(name), None, values, quantities)

    def _scene(self, axes: Mapping[str, np.ndarray], name: str, request: Request, zipped: bool) -> Scene:
        scene, analysis = self.scene, get_analysis(name).for_system(self.scene.system)
        columns = tuple(self._axis(name, np.asarray(v, float)) for name, v in axes.items())
        fixed = {**scene.fixed, **self.fixed}
        return Scene(scene.system, analysis, request, columns, zipped, fixed, scene.title, scene.text, scene.data)


def _scaled(convert: Callable[[Any], Any], size: float, values: Any) -> Any:
    return convert(values) * size


def verify_proof(path: Path) -> tuple[str, str]:
    """The result of computing the proved bounds of an atlas file again, in one line, and the problem, empty without one.

    Raises :class:`InputError` as :func:`open_atlas`.
    """
    stored = open_atlas(path)
    atlas, system = stored.stability.atlas, stored.scene.system
    proved = [panel for panel in atlas.panels if np.isfinite(panel.proved_error)]
    if not proved:
        reason = proof.with_proofs(atlas, system)[1] or "run its scene again"
        return "proof: none in this file", f"holds no proof; {reason}"
    errors = [(proof.proved_error(atlas, panel, system)[0], panel.proved_error) for panel in proved]
    computed, claimed = max(errors, key=lambda pair: pair[0] / pair[1])
    lines = f"proof: errors of {len(proved)} of {len(atlas.panels)} panels at most {computed:.2e}, stored {claimed:.2e}"
    wrong = f"proved_error = {claimed:.2e}: the proof gives {computed:.2e}; compute the file again"
    columns = [np.linspace(*ends, _CELLS) for ends in stored.ranges.values()]
    points = np.stack([x.reshape(-1) for x in np.meshgrid(*columns, indexing="ij")], axis=-1)
    codes, stated = proof.verdicts(atlas, system, points), stored.stability.at(points)["verdict"]
    both = (codes != proof.UNDECIDED) & (stated != proof.UNDECIDED)
    agree = int((both & (codes == stated)).sum())
    line = f"{lines}; {agree} of {codes.size} verdicts of a chart proved"
    other = int(both.sum()) - agree
    problem = wrong if computed > claimed else f"{other} verdicts contradict the proof; expected none" if other else ""
    if find_spec("flint"):
        low, high = np.array(list(stored.ranges.values())).T
        points = low + (high - low) * np.random.default_rng().random((_BALLS, len(low)))
        other = contradictions(
            replace(atlas, panels=tuple(proved)), system, points, stored.stability.at(points)["verdict"]
        )
        line += f"; {_BALLS - other} of {_BALLS} random points agree with ball arithmetic"
        problem = problem or (f"{other} points contradict ball arithmetic; expected none" if other else "")
    return line, problem


class AtlasRoute(Route):
    """Builds an atlas; progress counts its solves, which are not points of a grid."""

    name = "an atlas"
    is_pointwise = False

    def in_memory(self, job: Job, work: Work, progress: Progress) -> Labelled:
        """The atlas; ``progress`` counts the solves."""
        stability, _ = build_atlas(job.scene, atlas_ranges(job.scene), work, progress)
        atlas, reason = proof.with_proofs(stability.atlas, job.scene.system)
        stability = replace(stability, atlas=atlas)
        if reason and smoothness(job.scene.system).enclosure:
            progress.note = "; ".join(filter(None, (progress.note, f"verdicts are estimates: {reason}")))
        return to_labelled(stability, job.scene).with_attrs(**job.attrs)

    def into_file(
        self, job: Job, out: Path, temporary: Path, work: Work, progress: Progress, reused: ReusedPoints
    ) -> None:
        """Write the atlas from stored and newly computed solves."""
        result = self.in_memory(job, work, progress).with_attrs(wall_time_s=work.elapsed)
        write_result(result, out, temporary, ATLAS_PREFACE)
