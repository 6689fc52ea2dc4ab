"""Compute one point by the code of a sweep, and print the answer."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, aligned, did_you_mean, meant, shown, written
from drivetrain_jax._quantities import NamedResults, Variable
from drivetrain_jax.analysis import OUTCOME, Outcome, Request, analyses_of, analysis_of, get_analysis
from drivetrain_jax.analysis.floquet.multipliers import VERDICTS
from drivetrain_jax.resonances import FREQUENCIES, Orders, in_hertz, operating_range, orders_of
from drivetrain_jax.runs import toml
from drivetrain_jax.runs.assemble import ResultBuffer
from drivetrain_jax.runs.axes import entry_of
from drivetrain_jax.runs.job import Job
from drivetrain_jax.runs.physical import PARTS, described, read_table
from drivetrain_jax.runs.reply import (
    EVEN,
    Limit,
    Reply,
    differentiable,
    effect_lines,
    growth_lines,
    growth_of,
    point_sensitivities,
    speed_in_rpm,
    verdict_words,
    with_unstable_ranges,
)
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import Scene, load_scene
from drivetrain_jax.systems import get_system
from drivetrain_jax.systems._base import RPM
from drivetrain_jax.view.style import entry_name, in_units, ranges_text, runs_text, units_of, unstable_text


@dataclass(frozen=True)
class PointResult(NamedResults):
    """Results of one point, by attribute or by name: ``result.spectral_radius`` or ``result["spectral_radius"]``.

    ``outcome`` is the outcome of the point (results are NaN unless ``outcome.has_value``), ``units`` the units by name,
    ``labels`` the entries of each dimension of the results, ``physical`` the given physical data and their units,
    ``growth`` what a spectral radius means: rate [1/s], factor per turn, time and turns to double or to halve,
    ``sentence`` the answer of an analysis that has one, ``unstable`` the name of a parameter that was given as a range, and
    its unstable ranges,
    ``sensitivities`` those of the results, largest effect of one percent first (None unless asked for).
    """

    _field: ClassVar[str] = "values"
    system: str
    analysis: str
    method: str
    parameters: Mapping[str, Any]
    values: Mapping[str, Any]
    outcome: Outcome
    variables: Mapping[str, Variable] = field(repr=False)
    parameter_units: Mapping[str, str] = field(repr=False)
    labels: Mapping[str, Sequence[Any]] = field(repr=False)
    physical: Mapping[str, tuple[Any, str]] = field(default_factory=dict, repr=False)
    remedy: str = field(default="", repr=False)
    advice: str = field(default="", repr=False)
    orders: OrderCrossings | None = field(default=None, repr=False)
    growth: Mapping[str, float] = field(default_factory=dict, repr=False)
    sentence: str = field(default="", repr=False)
    forced: tuple[str, Mapping[str, Any]] | None = field(default=None, repr=False)
    sensitivities: Sequence[Any] | None = field(default=None, repr=False)
    unstable: tuple[str, Sequence[Any]] | None = field(default=None, repr=False)

    @property
    def crossings(self) -> dict[str, np.ndarray]:
        """Speeds [rpm] at which orders of the excitation meet the modes, by order; empty if no order is known."""
        return self.orders.columns if self.orders else {}

    @property
    def units(self) -> dict[str, str]:
        """Units of the results."""
        return {name: self.variables[name].units for name in self.values}

    @property
    def _reply(self) -> Reply:
        def described(values: Mapping[str, Any], units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
            return {name: {"value": value, "units": units[name]} for name, value in values.items()}

        values = described(self.values, self.units)
        for name, value in self.values.items():
            if flags := self.variables[name].flags:
                values[name]["meaning"] = _meaning(flags, value)
        physical = {name: {"value": value, "units": units} for name, (value, units) in self.physical.items()}
        crossings = {"shaft": self.orders.orders.shaft, "units": "rpm", "values": self.crossings} if self.orders else {}
        effects = None if self.sensitivities is None else [effect._asdict() for effect in self.sensitivities]
        answer = {
            **{"system": self.system, "analysis": self.analysis, "method": self.method},
            **({"physical": physical} if physical else {}),
            "parameters": described(self.parameters, self.parameter_units),
            "outcome": self.outcome.name.lower(),
            "values": values,
            **({"growth": self.growth} if self.growth else {}),
            **({"forced": self.forced[1]} if self.forced else {}),
            **({} if effects is None else {"sensitivities": effects}),
            **({"unstable": dict([self.unstable])} if self.unstable else {}),
            **({"crossings": crossings} if crossings else {}),
        }
        return Reply(self._lines(), answer, self.sentence)

    def to_json(self) -> str:
        """The answer as one JSON object; numbers that are not finite are null."""
        reply = self._reply
        proved = {"proved": self.proved} if "verdict" in self.values else {}
        return replace(reply, data={**reply.data, **proved}).to_json()

    @property
    def proved(self) -> bool:
        """True if the verdict is proved (docs/theory/atlas.md): for the cardan shaft, where it is not strongly damped and no
        multiplier lies within rounding of the unit circle."""
        # Local import: most points need no proof.
        from drivetrain_jax.atlas.proof import UNDECIDED, verdict_at

        # Other analyses have verdicts of their own.
        code = self.values.get("verdict", UNDECIDED) if self.analysis == "floquet" else UNDECIDED
        return code != UNDECIDED and verdict_at(get_system(self.system), self.parameters) == code

    def __repr__(self) -> str:
        return self._reply.text

    def _lines(self) -> list[str]:
        # An empty list is the default "none".
        parameters = ", ".join(
            f"{n} = {written(v, _PROSE)}{_units.behind(self.parameter_units[n])}"
            for n, v in self.parameters.items()
            if v != ()
        )
        listed = [n for n, v in self.values.items() if np.ndim(v) == 1]
        matrices = [n for n, v in self.values.items() if np.ndim(v) == 2]
        plain = [name for name in self.values if name not in (*listed, *matrices)]
        width = max(map(len, (*plain, "outcome")))
        data = (f"{n} = {written(v, _PROSE)}{_units.behind(units)}" for n, (v, units) in self.physical.items())
        lines = [f"{self.system} {self.analysis} (method {self.method}), {', '.join(data) or parameters}"]
        lines += [f"  that is {parameters}"] if self.physical else []
        for name in plain:
            text = _text(self.variables[name], self.values[name])
            near = self.advice and self.outcome.has_value and text.startswith("undecided ")
            hint = f" ({self.advice})" if near else ""
            lines.append(f"  {name:{width}} = {text}{_units.behind(self.variables[name].units)}{hint}")
        lines += growth_lines(self.growth, width)
        hint = f" ({self.remedy})" if self.remedy and self.outcome == Outcome.NOT_CONVERGED else ""
        lines.append(f"  {'outcome':{width}} = {self.outcome.name.lower()}{hint}")
        for (dim,) in dict.fromkeys(self.variables[name].dims for name in listed):
            lines += self._table(dim, [name for name in listed if self.variables[name].dims == (dim,)])
        for name in matrices:
            lines += self._matrix(name)
        lines += self.orders.lines() if self.orders else []
        lines += [f"  forced amplitude: {self.forced[0]}"] if self.forced else []
        if self.sensitivities is not None:
            results = differentiable(self.variables[name] for name in self.values)
            lines += [f"  {line}" for line in effect_lines(self.sensitivities, results, self.labels)]
        return lines

    def _matrix(self, name: str) -> list[str]:
        """A result with two dimensions as text, the longer one downwards."""
        variable, values = self.variables[name], np.asarray(self.values[name])
        rows, columns = variable.dims
        if values.shape[0] < values.shape[1]:
            rows, columns, values = columns, rows, values.T
        head = [rows, *(f"{columns} {written(label)}" for label in self.labels[columns])]
        named = zip(self.labels[rows], values, strict=True)
        cells = [[written(label), *(_text(variable, value) for value in row)] for label, row in named]
        return [f"  {name}{_units.behind(variable.units)}", *aligned([head, *cells])]

    def _table(self, dim: str, names: Sequence[str]) -> list[str]:
        columns = [[dim, *map(str, self.labels[dim])]]
        for name in names:
            variable = self.variables[name]
            head = name if variable.units == "1" else f"{name} [{variable.units}]"
            columns.append([head, *(_text(variable, value) for value in self.values[name])])
        return aligned(list(zip(*columns, strict=True)))


def _meaning(flags: Sequence[str], value: Any) -> Any:
    """The words of codes, in the shape of ``value``."""
    return [_meaning(flags, code) for code in value] if np.ndim(value) else flags[int(value)]


def _text(variable: Variable, value: Any) -> str:
    if np.ndim(value):
        return np.array2string(value, precision=10, separator=", ", max_line_width=10_000)
    return variable.written(value)


def point(
    system: str,
    analysis: str,
    *,
    outputs: Sequence[str] | None = None,
    amplitude: Any = None,
    sensitivities: bool = False,
    data: str | PathLike[str] | None = None,
    **given: Any,
) -> PointResult:
    """The results of one point.

    Args:
        system, analysis: names, see ``drivetrain list``.
        outputs: results to compute; default: those of the analysis.
        amplitude: limit of the forced amplitude (``"2 deg"``), with which the answer compares the forced motion.
        sensitivities: adds the effect of one percent of each value on the results, by the given physical data or parameters.
        data: a table of parameters (``.csv``, ``.xlsx``, ``.toml``), a column each with its unit (``length [mm]``).
        given: parameters of the system (or its physical data), and options of the analysis (``method``, ``rtol``, ...);
            they override ``data``, also one entry of a list (``c[3]``). Of ``floquet`` one may be a range,
            ``speed=("1500 rpm", "6000 rpm")``: the answer begins with the unstable ranges in it, and the point is the one
            with the largest spectral radius.

    Raises: :class:`InputError` with one line that names the field, the value and what is allowed; :class:`ChunkError` if
    the computation fails.

    >>> import drivetrain_jax as dt
    >>> found = dt.point("cardan", "floquet", beta=0.3, Omega=1.416, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(f"{found.spectral_radius:.8f}", found.outcome.name)
    1.03193549 SUCCESS
    """
    if data is not None:
        given = read_table(Path(data)) | given
    given = _with_entries(given)
    if (name := _varied(system, analysis, given)) is not None:
        asked = {"outputs": outputs, "amplitude": amplitude, "sensitivities": sensitivities}
        return _least_stable(system, name, given, asked)
    tree = _tree(system, analysis, {name: toml.plain(value) for name, value in given.items()})
    if outputs is not None:
        outputs = [outputs] if isinstance(outputs, str) else outputs
        tree["outputs"] = list(outputs) if isinstance(outputs, Iterable) else outputs
    try:
        job = resolve(load_scene(tree))
    except InputError as error:
        # Messages name the fields without the tables of a scene.
        text = re.sub(r"^(points|fixed|options)\.", "", str(error))
        raise InputError(re.sub(r"^(\w+)\.values = \[(.*?)\]:", r"\1 = \2:", text)) from None
    scene = job.scene
    if sensitivities:
        analysed, asked = scene.analysis, scene.request.outputs
        if analysed.derivatives is None:
            known = (name for name in analyses_of(scene.system) if get_analysis(name).derivatives)
            raise InputError(f"sensitivities: {analysis} has no derivatives; expected {' or '.join(known) or 'none'}")
        if not differentiable(map(analysed.variable, asked)):
            names = ", ".join(v.name for v in differentiable(analysed.variables))
            raise InputError(f"outputs = {list(asked)}: without sensitivities; expected one of {names}")
        tree["outputs"] = [*dict.fromkeys((*asked, *analysed.derivative_outputs(asked)))]
        job = resolve(load_scene(tree))
    limit = None if amplitude is None else Limit.from_text(scene.system, amplitude)
    result = _result(job)
    if sensitivities:
        result = _with_sensitivities(result, scene, given)
    return result if limit is None else replace(result, forced=_forced(result, given, limit))


def _with_sensitivities(result: PointResult, scene: Scene, given: Iterable[str]) -> PointResult:
    """The ``result`` with the sensitivities of the results that ``scene`` requests, which its other values served."""
    effects, known = [], described(scene.system)
    if result.outcome.has_value:
        data = {
            n: x if isinstance(x, str) or units == known[n].units else x * _units.factor(units, known[n].units)
            for n, (x, units) in result.physical.items()
        }
        effects = point_sensitivities(scene, given, data, result.parameters, result.values)
    values = {name: x for name, x in result.values.items() if name in scene.request.outputs}
    return replace(result, values=values, sensitivities=effects)


def _with_entries(given: Mapping[str, Any]) -> dict[str, Any]:
    """``given`` with its single entries, such as ``c[3]``, in their lists."""
    placed = {name: value for name, value in given.items() if entry_of(name)[1] is None}
    for name in given.keys() - placed.keys():
        parameter, position = cast(tuple[str, int], entry_of(name))
        entries = list(placed[parameter]) if np.ndim(placed.get(parameter, 0)) else []
        if position >= len(entries):
            beside = f"the list {parameter} beside it"
            allowed = f"an entry of the list {parameter}, which has {len(entries)}" if entries else beside
            raise InputError(f"{name} = {shown(given[name])}: expected {allowed}")
        entries[position] = given[name]
        placed[parameter] = entries
    return placed


def _varied(system: str, analysis: str, given: Mapping[str, Any]) -> str | None:
    """The parameter that has a range, a pair, in a question about stability; None without one."""
    known = described(get_system(system))
    pairs = (name for name, value in given.items() if isinstance(value, tuple) and len(value) == 2)
    varied = next((name for name in pairs if name in known and known[name].is_number and not known[name].listed), None)
    if varied and analysis != "floquet":
        ends = ":".join(map(str, given[varied]))
        raise InputError(f"{varied} = {ends}: a range; expected a number (floquet searches a range, a scene has axes)")
    return varied


def _least_stable(system: str, name: str, given: Mapping[str, Any], asked: Mapping[str, Any]) -> PointResult:
    """The point of the largest spectral radius in the range of ``name``, and the unstable ranges as its sentence."""
    from drivetrain_jax.runs.run import run

    low, high = map(toml.plain, given[name])
    given = {n: value for n, value in given.items() if n != name}
    tree = _tree(system, "floquet", {n: toml.plain(value) for n, value in given.items()})
    fixed = tree["fixed"] | {n: value for n, (value,) in tree.pop("points").items()}
    axes = {name: {"start": low, "stop": high, "num": EVEN}}
    dataset = run(tree | {"fixed": fixed, "axes": axes, "outputs": ["spectral_radius", "verdict"]})
    unit = next((parts[1] for end in (low, high) if isinstance(end, str) and (parts := _units.split(end))), "")
    dataset, worst = with_unstable_ranges(dataset)
    units = units_of(dataset[name])
    there: dict[str, Any] = {**asked, **given, name: worst if units == "1" else f"{worst!r} {units}"}
    result = point(system, "floquet", **there)
    shown = in_units(dataset, [unit] if unit else [])
    span = runs_text(shown[name], [(float(shown[name].min()), float(shown[name].max()))])
    text, undecided = unstable_text(shown, name), dataset["verdict"].values == VERDICTS.index("undecided")
    rest = f"the rest of {span} is stable" if text else f"stable at {span}"
    rest = f"undecided at {ranges_text(shown[name], undecided)}" if undecided.any() else rest
    sentence = f"{text}; {rest}." if text else f"{rest}."
    ranges = dataset[f"unstable_{name}"].values.tolist()
    return replace(result, sentence=f"{sentence[:1].upper()}{sentence[1:]}", unstable=(name, ranges))


def _forced(result: PointResult, given: Mapping[str, Any], limit: Limit) -> tuple[str, dict[str, Any]]:
    """The comparison of the forced motion at the same point with a limit, as text and data."""
    parameters = described(get_system(result.system))
    parameters = {name: value for name, value in given.items() if name in parameters}
    known = dict(result.values)
    for analysis, name in (("forced", "amplitude"), ("floquet", "verdict")):
        # The results of another analysis may have the same name: the verdict of lyapunov is a kind of motion.
        if name not in known or result.analysis != analysis:
            known[name] = point(result.system, analysis, outputs=[name], **parameters)[name]
    return limit.at_point(known["amplitude"], int(known["verdict"]))


def _tree(system_name: str, analysis_name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """The scene of one point. Numbers are axes, so the next point needs no compilation; words and lists are fixed."""
    system = get_system(system_name)
    analysis = analysis_of(system, analysis_name)
    if analysis.continuous:
        others = ", ".join(name for name in analyses_of(system) if not get_analysis(name).continuous)
        raise InputError(f"analysis = {analysis_name!r}: needs ranges; expected at a point one of {others}")
    parameters = described(system)
    options = {o.name: given.get(o.name, o.default) for o in analysis.options}
    path = analysis.path_axis(system, Request((), given.get("method", next(iter(analysis.methods))), options))
    tree: dict[str, Any] = {"system": system_name, "analysis": analysis_name, "points": {}, "fixed": {}, "options": {}}
    names = (*parameters, "method", *(o.name for o in analysis.options))
    # A parameter that varies cannot be an output of the scene.
    numbers = {p.name for p in parameters.values() if p.is_number} - {path, *(v.name for v in analysis.variables)}
    if path is not None and system.physical:
        # What the path follows from is fixed like the path itself.
        numbers -= {name for rule in system.physical.conversions if rule.parameter == path for name in rule.needs}
    for name, value in given.items():
        if name == PARTS:
            tree[PARTS] = value
            continue
        if name not in names:
            guess = did_you_mean(name, (*names, "outputs", "amplitude")) or meant(name, parameters.values())
            raise InputError(f"{name} = {shown(value)}: unknown{guess}; expected {', '.join(names)}")
        if name not in parameters:
            tree["options"][name] = value
        elif name in numbers and not isinstance(value, (list, tuple)):
            tree["points"][name] = [value]
        else:
            tree["fixed"][name] = value
    return tree


def _result(job: Job) -> PointResult:
    scene, buffer = job.scene, ResultBuffer(job.scene, job.grid)
    for block in job.blocks():
        buffer.fill(job.points(block), job.compute_block(block))
    first = (0,) * len(job.grid.result_shape)
    values = {v.name: buffer.lay_out()[v.name][first] for v in buffer.variables}
    outcome = Outcome(int(values.pop(OUTCOME.name)))
    parameters = {p.parameter.name: p.values[0].item() for a in scene.axes for p in a.together} | dict(scene.fixed)
    ordered: dict[str, Any] = {p.name: parameters[p.name] for p in scene.system.parameters if p.name in parameters}
    known, physical = described(scene.system), {}
    for axis in scene.axes:
        physical |= {quantity.name: (quantity.values[0].item(), quantity.parameter.units) for quantity in axis.given}
    physical |= {name: (value, known[name].units) for name, value in scene.data.items()}
    shown = [v for v in buffer.variables if v.name in values]
    sizes = {dim: n for v in shown for dim, n in zip(v.dims, np.shape(values[v.name]), strict=True)}
    model = scene.analysis.model(scene.system)
    # The sentence needs all results.
    says = model.says if outcome.has_value and all(v.name in values for v in model.results) else None
    grows = growth_of(scene.system, ordered, values, speed_in_rpm(scene.system, physical))
    sentence = says(values, ordered) if says else ""
    if "verdict" in values and outcome.has_value:
        word = scene.analysis.variable("verdict").flags[int(values["verdict"])]
        sentence = f"{'; '.join(verdict_words(word, grows, scene.analysis.name == 'floquet'))}."
    labels = {d.name: d.labels(sizes[d.name]) for d in scene.dimensions if d.name in sizes}
    if scene.analysis.name == "forced" and outcome.has_value:
        sentence = _forced_sentence(values, {v.name: v for v in shown}, labels)
    orders = order_crossings(scene, ordered, values) if outcome.has_value else None
    return PointResult(
        system=scene.system.name,
        analysis=scene.analysis.name,
        method=scene.request.method,
        parameters=ordered,
        values=values,
        outcome=outcome,
        variables={v.name: v for v in buffer.variables},
        parameter_units={p.name: p.units for p in scene.system.parameters},
        labels=labels,
        physical=physical,
        remedy=scene.analysis.remedy(scene.request),
        advice=scene.analysis.advice(scene.request),
        growth=grows,
        orders=orders,
        sentence=sentence or (orders.sentence(values, ordered.get("speed", 0.0)) if orders else ""),
    )


def _forced_sentence(
    values: Mapping[str, Any], variables: Mapping[str, Variable], labels: Mapping[str, Sequence[Any]]
) -> str:
    """The largest amplitude and torque of the linear model and of the nonlinear orbit; empty without any."""
    sentences = []
    for prefix, motion in (("", "The forced motion of the linear model"), ("orbit_", "The nonlinear orbit")):
        reached = []
        for name in (f"{prefix}amplitude", f"{prefix}torque"):
            if name in values and np.isfinite(values[name]).all():
                (dim,), units, k = variables[name].dims, variables[name].units, int(np.argmax(values[name]))
                size = f"{np.degrees(values[name][k]):.4g} deg" if units == "rad" else f"{values[name][k]:.4g} {units}"
                reached.append(f"{size} ({entry_name(dim, labels[dim][k])})")
        sentences += [f"{motion} reaches {' and '.join(reached)}."] if reached else []
    return " ".join(sentences)


# Digits of given values in an answer.
_PROSE = 6
# Most modes in the sentence about an order, and speeds of one kind in that about whirl.
_FIRST, _FEW = 6, 3


@dataclass(frozen=True)
class OrderCrossings:
    """The ``orders`` with their ``speeds`` (modes, orders) [rpm], those of a ``turning`` shaft or of frequencies at rest,
    and the operating range [rpm] if one is given."""

    orders: Orders
    speeds: np.ndarray
    operating: tuple[float, float] | None
    turning: bool = False

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The speeds of all modes by the name of the order."""
        return dict(zip(self.orders.per_turn, self.speeds.T, strict=True))

    def lines(self) -> list[str]:
        """The speeds as a table."""
        head = ["mode", *(f"{name} [rpm]" for name in self.columns)]
        modes = [
            [str(k), *(f"{x:.6g}" if np.isfinite(x) else "-" for x in row)] for k, row in enumerate(self.speeds, 1)
        ]
        how = f"  speed of the {self.orders.shaft} at which an order meets the mode"
        how += ", with the gyroscopic effect" * (self.turning and self.orders.discs)
        return [how + ", counted over both planes" * (self.turning and self.orders.planes), *aligned([head, *modes])]

    def _whirl_sentence(self, values: Mapping[str, Any], speed: float) -> str:
        """Frequencies of whirl at the ``speed`` [rad/s] of the shaft, by their sense, and critical speeds."""
        codes, turns = values.get("whirl_direction"), values["whirl_frequency"] / RPM
        senses = {} if codes is None else {"backward at": codes == 0, "forward at": codes == 2, "planar at": codes == 1}
        said = [f"{sense} {_first(turns[which])}" for sense, which in senses.items() if np.any(which)]
        critical = [f"of {name}: {_first(column)}" for name, column in self.columns.items() if np.any(column > 0)]
        whirl = f"At {speed / RPM:.6g} rpm the shaft whirls {', '.join(said) or f'at {_first(turns)}'}"
        return f"{whirl}; critical speeds {'; '.join(critical)}." if critical else f"{whirl}."

    def sentence(self, values: Mapping[str, Any], speed: float) -> str:
        """Whirl at this ``speed``; or the speeds within the operating range and the modes of ``values`` too near to it, or
        the first speeds."""
        if "whirl_frequency" in values:
            return self._whirl_sentence(values, speed)
        if not self.operating:
            (name, column), *_ = self.columns.items()
            met = [f"mode {k + 1} at {column[k]:.6g} rpm" for k in np.flatnonzero(np.isfinite(column))]
            more = f" and {len(met) - _FIRST} more" if len(met) > _FIRST else ""
            return f"{name[:1].upper()}{name[1:]} meets {', '.join(met[:_FIRST])}{more}." if met else ""
        low, high = self.operating
        said = [f"From {low:g} to {high:g} rpm {'; '.join(self.orders.within(self.speeds, low, high))}"]
        if {"separation_margin", "required_margin"} <= values.keys():
            near = 1 + np.flatnonzero(values["separation_margin"] < values["required_margin"])
            modes = (
                f"mode{'s' * (len(near) > 1)} {', '.join(map(str, near))}{' of the first plane' * self.orders.planes}"
            )
            said += [f"{modes} lack{'s' * (len(near) == 1)} the required separation margin"] if len(near) else []
        return f"{'; '.join(said)}."


def order_crossings(scene: Scene, parameters: Mapping[str, Any], values: Mapping[str, Any]) -> OrderCrossings | None:
    """The crossings of the frequencies among the results ``values`` of one point; None without frequencies or orders."""
    name = next((name for name in (*FREQUENCIES, "whirl_frequency") if name in values), None)
    orders = orders_of(scene.system.name, {**parameters, **scene.data}, scene.request.options.get("orders", ()))
    if name is None or orders is None or scene.request.options.get("order"):
        return None
    operating = operating_range(scene.request.options)
    whirl = scene.analysis.name == "whirl"
    if orders.discs or whirl:
        orders = replace(orders, per_turn={**orders.per_turn, "order -1 (backward)": -1.0})
    if orders.discs or orders.planes or whirl:
        return OrderCrossings(orders, _turning_speeds(scene, parameters, orders), operating, turning=True)
    frequency = in_hertz(values[name], scene.analysis.variable(name).units)
    return OrderCrossings(orders, orders.speeds(frequency), operating)


def _turning_speeds(scene: Scene, parameters: Mapping[str, Any], orders: Orders) -> np.ndarray:
    """Critical speeds [rpm] of the ``orders`` of a turning shaft (modes of all planes, orders); NaN where none is."""
    # Local import: other points need no function of a pytree.
    from drivetrain_jax.analyses import analyse

    shaft, modes = scene.system.of(parameters), (1 + orders.planes) * scene.request.options["modes"]
    # The modes of whirl are those of both senses.
    modes = -(-modes // 2) if scene.analysis.name == "whirl" else modes
    asked = ({"order": int(n), "modes": modes} for n in orders.per_turn.values())
    columns = [analyse("critical_speeds", shaft, ["critical_speed"], options).critical_speed for options in asked]
    speeds = np.stack(columns, axis=-1)
    return np.where(np.isfinite(speeds) & (speeds > 0), speeds, np.nan)


def _first(speeds: np.ndarray) -> str:
    return f"{', '.join(f'{x:.6g}' for x in speeds[np.isfinite(speeds)][:_FEW])} rpm"
