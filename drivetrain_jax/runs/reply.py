"""An answer of a point or an atlas as text, as JSON and as sentences of a report.

Its parts: growth of disturbances, sensitivities to every parameter or physical datum (largest effect first), and the
amplitude of the forced motion against a limit, at a point and along the speeds of a design answer.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, aligned, shown
from drivetrain_jax._quantities import Dimension, Parameter, Variable
from drivetrain_jax.analyses import jacobians
from drivetrain_jax.analysis._base import checked
from drivetrain_jax.analysis.floquet.multipliers import VERDICTS
from drivetrain_jax.runs.axes import placed
from drivetrain_jax.runs.physical import GivenData, described
from drivetrain_jax.runs.predicted import LABELS, resonances
from drivetrain_jax.runs.scene import Scene
from drivetrain_jax.systems import System
from drivetrain_jax.view.style import runs, scene_key, units_of

if TYPE_CHECKING:
    import xarray as xr

    from drivetrain_jax.atlas.windows import Crossing
    from drivetrain_jax.runs.atlas_answers import AtlasQuery


@dataclass(frozen=True, repr=False)
class Reply:
    """An answer in one sentence (empty if there is none), as ``lines`` of text, the first being the heading, and as plain
    numbers, words and lists (``data``)."""

    lines: Sequence[str]
    data: Mapping[str, Any]
    answer: str = ""

    @property
    def text(self) -> str:
        """The answer as ``print`` shows it."""
        return "\n".join([self.answer, *self.lines] if self.answer else self.lines)

    def __str__(self) -> str:
        return self.text

    # A notebook shows what `print` does.
    __repr__ = __str__

    def to_json(self) -> str:
        """``answer`` and ``data`` as one JSON object; numbers that are not finite become null."""
        content = {"answer": self.answer, **self.data} if self.answer else self.data
        # msgspec writes null for numbers that are not finite, json only ASCII.
        return json.dumps(msgspec.json.decode(msgspec.json.encode(content, enc_hook=_builtin)))

    def sentences(self) -> list[str]:
        """The answer, and the lines below the heading as sentences, details indented."""
        parts = [("  " * line.startswith("    "), line.strip()) for line in self.lines[1:]]
        lines = [f"{indent}{text[:1].upper()}{text[1:]}." for indent, text in parts]
        return [self.answer, *lines] if self.answer else lines


def _builtin(value: Any) -> Any:
    """A mapping, an array or a number of NumPy in the types of JSON; complex numbers as ``real`` and ``imag``."""
    if isinstance(value, Mapping):
        return dict(value)
    if np.iscomplexobj(value):
        return {"real": np.real(value), "imag": np.imag(value)}
    return np.asarray(value).tolist()


def growth_at(asked: AtlasQuery, results: Mapping[str, Any]) -> dict[str, float]:
    """The growth that ``spectral_radius`` means at the point of the question; empty if it is not known."""
    system = asked.atlas.scene.system
    point = {**asked.atlas.fixed, **asked.values}
    known = asked.physical({name: value for name, value in point.items() if name == system.roles.get("speed")})
    turns = next((speed["value"] for speed in known.values() if speed["units"] == "rpm"), None)
    return growth_of(system, point, results, turns)


def growth_of(
    system: type[System], point: Mapping[str, Any], results: Mapping[str, Any], turns: float | None
) -> dict[str, float]:
    """The growth that a spectral radius means at a ``point`` (parameters); empty if it is not known.

    ``rate = ln(spectral_radius)/period`` [1/s] is the largest real part of the Floquet exponents, negative for decay;
    ``per_turn`` is the factor of the amplitude per turn of the shaft; ``time_to_double`` or ``time_to_halve`` [s] and the
    same in turns follow. ``turns`` is the speed [rpm], if known, of a shaft whose time has no unit.
    """
    radius = results.get("spectral_radius")
    frequency = point.get(system.roles.get("speed", "")) if system.time_units == "s" else None
    # An undecided radius is 1 within its error, and so is its growth 0; without damping it is 1.
    undecided = int(results.get("verdict", 0)) == VERDICTS.index("undecided")
    if radius is None or undecided or abs(radius - 1) < 1e-15 or not (frequency or system.periods_per_turn):
        return {}
    # A period takes 1/frequency seconds; otherwise the unit of time is the turn.
    turn = 60 / turns if turns else 1.0
    with np.errstate(divide="ignore"):
        rate = np.log(radius) * (frequency or system.periods_per_turn / turn)
    way, time = "double" if rate > 0 else "halve", np.log(2) / np.abs(rate)
    rates = {"rate": rate, "per_turn": np.exp(rate * turn), f"time_to_{way}": time, f"turns_to_{way}": time / turn}
    names = ("rate", "time") if frequency else ("rate", "per", "time", "turns") if turns else ("per", "turns")
    return {n: float(x) for n, x in rates.items() if np.isfinite(x) and n.startswith(names)}


def speed_in_rpm(system: type[System], physical: Mapping[str, tuple[Any, str]]) -> float | None:
    """The speed [rpm] among physical data with their units; None without one."""
    needs = system.physical.source(system.roles.get("speed", "")) if system.physical else ""
    value, units = physical.get(needs.partition(",")[0], (None, ""))
    return None if value is None else value * _units.factor(units, "rpm")


def growth_lines(rates: Mapping[str, float], width: int = 24, sign: str = "= ") -> list[str]:
    """The growth as text, after a word of this ``width`` and a ``sign``."""
    if not rates:
        return []
    grows = rates["rate"] > 0 if "rate" in rates else rates["per_turn"] > 1
    way = "double" if grows else "halve"
    rate = f"{abs(rates['rate']):.4g} 1/s" if "rate" in rates else ""
    per_turn = f"by a factor {rates['per_turn']:.6g} per turn" if "per_turn" in rates else ""
    seconds = f"{rates[f'time_to_{way}']:.4g} s" if f"time_to_{way}" in rates else ""
    turns = f"{rates[f'turns_to_{way}']:.4g} turns" if f"turns_to_{way}" in rates else ""
    ends = ", ".join(text for text in (seconds, turns) if text)
    word = "growth" if grows else "decay"
    return [
        f"  {word:<{width}} {sign}{', '.join(filter(None, (rate, per_turn)))}{f'; {way}s in {ends}' if ends else ''}"
    ]


def verdict_words(verdict: str, grows: Mapping[str, float], radius: bool = True) -> list[str]:
    """The meaning of a verdict (by the spectral ``radius``) and the growth, as parts of a sentence."""
    word = verdict.replace("_", " ").capitalize()
    word += ": the spectral radius is 1 within its error" if radius and verdict == "undecided" else ""
    return [word, *(line.strip() for line in growth_lines(grows, width=0, sign=""))]


# Part of the largest effect below which an effect is rounding.
_ROUNDING = 1e-9


class Sensitivity(NamedTuple):
    """The ``slope`` of the answer ``output`` by the datum ``name`` in its ``units``, and its change for one ``percent``
    more; both are arrays for an answer with a dimension."""

    name: str
    units: str
    slope: Any
    percent: Any
    output: str = "spectral_radius"


def radius_sensitivities(asked: AtlasQuery, slopes: Mapping[str, float] | None) -> list[Sensitivity] | None:
    """Sensitivities of the spectral radius at the point of a question; ``slopes`` is its gradient by the parameters."""
    if slopes is None:
        return None

    def change(changes: Mapping[str, Any], _: Any) -> Any:
        return sum((slopes[name] * x for name, x in changes.items() if name in slopes), 0.0)

    point = {**asked.atlas.fixed, **asked.values}
    return _of_data(asked.atlas.scene.system, asked.shaft, point, "", change)


def differentiable(results: Iterable[Variable]) -> list[Variable]:
    """The ``results`` that may have derivatives and a table: numbers with at most one dimension."""
    numbers = [v for v in results if v.dtype == "float64" and len(v.dims) < 2]
    return [v for v in numbers if not v.name.endswith(("_error", "_residual", "_margin"))]


def point_sensitivities(
    scene: Scene,
    given: Iterable[str],
    physical: Mapping[str, Any],
    parameters: Mapping[str, Any],
    values: Mapping[str, Any],
) -> list[Sensitivity]:
    """Sensitivities of the results ``values`` of a point, by result, largest effect first: by the ``given`` names and by
    parameters that do not follow from them. ``physical`` are the data in their units; numbers of 0 have none."""
    system, asked = scene.system, map(scene.analysis.variable, scene.request.outputs)
    names = [v.name for v in differentiable(asked)]
    # An empty list is the default of an option, and no value of it.
    options = {n: x for n, x in scene.request.options.items() if x != ()} | {"method": scene.request.method}
    keys, found = jacobians(scene.analysis.name, system.of(parameters), names, options, values, hold=True)
    known = described(system)
    pool = {name: {**parameters, **physical}[name] for name in given if name in known}
    follow = system.physical.converted(pool) if system.physical else {}
    data = {name: x for name, x in parameters.items() if name not in follow} | pool
    real = {
        n: x for n, x in data.items() if known[n].units and not (known[n].integer or known[n].choices or known[n].text)
    }
    leaves = [(n, i, y) for n, x in real.items() for i, y in (enumerate(x) if isinstance(x, tuple) else [(None, x)])]
    leaves = [(name, entry, float(x)) for name, entry, x in leaves if x and np.isfinite(x)]

    def entries(x: Any) -> Any:
        """The parameters of ``keys`` at the values ``x`` of ``leaves``."""
        everything = dict(data)
        for (name, entry, _), y in zip(leaves, x, strict=True):
            everything[name] = placed(everything[name], entry, y)
        if system.physical:
            everything |= system.physical.converted({name: everything[name] for name in pool})
        return jnp.stack([everything[name] if entry is None else everything[name][entry] for name, entry in keys])

    x = np.array([x for *_, x in leaves])
    chain = np.asarray(jax.jacfwd(entries)(x))
    effects = []
    for output, jacobian in found.items():
        # A derivative that does not exist affects only the data on which its parameter depends.
        slopes = np.where(chain == 0, 0.0, jacobian[..., None] * chain).sum(axis=-2)
        of_output = [
            Sensitivity(
                name if entry is None else f"{name}[{entry}]", known[name].units, slope, slope * value / 100, output
            )
            for (name, entry, value), slope in zip(leaves, np.moveaxis(slopes, -1, 0), strict=True)
        ]
        effects += sorted(of_output, key=lambda effect: -np.max(np.abs(np.nan_to_num(effect.percent))))
    return effects


def limit_sensitivities(asked: AtlasQuery, parameter: str, limit: Crossing) -> list[Sensitivity]:
    """Sensitivities of a limit of ``parameter``, in physical units if its data are known; empty without a gradient.

    On the limit the spectral radius is 1, so ``d parameter/dp = -(d rho/dp)/(d rho/d parameter)``.
    """
    point = {**asked.atlas.fixed, **asked.numbers(), **limit.point, parameter: limit.value}
    slopes = radius_gradient(asked.atlas.scene.system, point)
    if slopes is None or slopes[parameter] == 0:
        return []
    turned = {name: -slope / slopes[parameter] for name, slope in slopes.items() if name != parameter}

    def limit_at(changes: Mapping[str, Any], data: Mapping[str, Any]) -> Any:
        value = limit.value + sum(turned[n] * x for n, x in changes.items() if n in turned)
        back = asked.shaft.physical.back(parameter, data) if asked.shaft else None
        return back[1](value) if back else value

    return _of_data(asked.atlas.scene.system, asked.shaft, point, parameter, limit_at)


def _of_data(
    system: type[System],
    shaft: GivenData | None,
    point: Mapping[str, float],
    without: str,
    answer: Callable[[dict[str, Any], Any], Any],
) -> list[Sensitivity]:
    """Sensitivities of ``answer(changes of the parameters, data)`` by the physical data, and by parameters without such.

    The quantity behind the parameter ``without`` is no datum, because it is the answer.
    """
    data: dict[str, Any] = {name: value for name, value in point.items() if name != without}
    if shaft:
        follow = {rule.parameter: rule.needs for rule in shaft.physical.conversions}
        ends = [known for name, value in data.items() if (known := shaft.quantity(name, value))]
        numbers = {name: x for name, x in shaft.data.items() if isinstance(x, (int, float))}
        given = {name: x for name, x in numbers.items() if name in shaft.physical.names}
        given |= {name: x for name, x, _ in ends}
        given.pop(follow[without][0] if without in follow else "", None)
        known = {name for name, needs in follow.items() if set(needs) <= given.keys()}
        used = {need for name in known for need in follow[name]}
        data = {name: x for name, x in given.items() if name in used} | {
            name: value for name, value in data.items() if name not in known
        }

    def answer_at(numbers: Mapping[str, Any]) -> Any:
        everything = {**data, **numbers}
        parameters = everything | (shaft.physical.converted(everything) if shaft else {})
        return answer({name: parameters[name] - x for name, x in point.items() if name in parameters}, everything)

    names = described(system)
    slopes = jax.grad(answer_at)({name: float(value) for name, value in data.items() if not names[name].integer})
    sensitivities = [Sensitivity(n, names[n].units, float(x), float(x) * data[n] / 100) for n, x in slopes.items()]
    return sorted(sensitivities, key=lambda rule: -abs(rule.percent))


def gradient_lines(sensitivities: Sequence[Sensitivity] | None, output: str = "spectral_radius") -> list[str]:
    """The sensitivities of a number as text."""
    effects = sensitivities or ()
    slopes = np.array([effect.slope for effect in effects])
    # What has no effect has the slope 0, also where the others have none.
    if not np.isfinite(slopes[slopes != 0]).any() and not (effects and np.isfinite(slopes).all()):
        why = "two multipliers have the largest modulus, within the errors, or it cannot be computed"
        why = why if output == "spectral_radius" else "it has no derivative at this point"
        return [f"gradient of {output}", f"  none: {why}"]
    least = _ROUNDING * max(abs(np.nan_to_num(effect.percent)) for effect in effects)
    return [
        f"gradient of {output}, largest effect of 1 % first",
        *(
            f"  {effect.name:<24} {effect.percent:+.6g} for +1 %, {effect.slope:.6g}"
            f"{'' if effect.units == '1' else f' per {effect.units}'}"
            for effect in effects
            if not abs(effect.percent) <= least
        ),
    ]


def effect_lines(
    sensitivities: Sequence[Sensitivity], variables: Sequence[Variable], labels: Mapping[str, Sequence[Any]]
) -> list[str]:
    """The sensitivities of several results as text: a table for one with a dimension, whose entries ``labels`` name."""
    lines = []
    for variable in variables:
        effects = [effect for effect in sensitivities if effect.output == variable.name]
        if not variable.dims:
            lines += gradient_lines(effects, variable.name)
            continue
        changes = np.array([effect.percent for effect in effects])
        least = _ROUNDING * np.max(np.abs(np.nan_to_num(changes)), initial=0.0)
        rows = [
            [effect.name, *(f"{x:+.4g}" if np.isfinite(x) else "-" for x in row)]
            for effect, row in zip(effects, changes, strict=True)
            if np.any(np.abs(row) > least)
        ]
        (dim,), unit = variable.dims, "" if variable.units == "1" else f" [{variable.units}]"
        head = [dim, *map(str, labels[dim])]
        lines += [f"change of {variable.name}{unit} for +1 % of a value, largest first"]
        lines += aligned([head, *rows]) if rows else ["  none: it has no derivative at this point"]
    return lines


def limit_line(asked: AtlasQuery, parameter: str, limit: Crossing | None, before: str = "") -> tuple[str, list[Any]]:
    """The sensitivities of a limit as a line of text and as data; empty without any."""
    sensitivities = limit_sensitivities(asked, parameter, limit) if limit else []
    if limit is None or not sensitivities:
        return "", []
    physical = asked.shaft.quantity(parameter, limit.value) if asked.shaft else None
    name, _, stored = physical or (parameter, 0.0, asked.atlas.scene.system.parameter(parameter).units)
    units = asked.show(parameter, limit.value)[-1] if asked.show else stored
    size = 1.0 if units == stored else _units.factor(stored, units)
    least = _ROUNDING * abs(sensitivities[0].percent)
    changes = ", ".join(
        f"{effect.name} {size * effect.percent:+.3g}" for effect in sensitivities if abs(effect.percent) > least
    )
    unit = "" if units == "1" else f" [{units}]"
    return f"{before}+1 % of a value changes {name} by{unit}: {changes}", [
        x._replace(output=name)._asdict() for x in sensitivities
    ]


def radius_gradient(system: type[System], values: Mapping[str, float]) -> dict[str, float] | None:
    """Derivatives of the spectral radius by all parameters of ``system`` at ``values``, integers apart; None without any."""
    keys, found = jacobians("floquet", system.of(values), ["spectral_radius"], {}, {}, hold=False)
    slopes = {name: float(x) for (name, _), x in zip(keys, found["spectral_radius"], strict=True)}
    real = [name for name in system.models["floquet"].parameters if not system.parameter(name).integer]
    return {name: slopes[name] for name in real} if np.isfinite([slopes[name] for name in real]).all() else None


# Samples of a range of speeds: evenly spaced, and halving distances from both ends, where a resonance may lie.
EVEN, _HALVINGS = 91, range(8, 22)
# Points and rounds by which peaks and crossings of the limit are refined.
_PARTS, _PEAK_ROUNDS, _LIMIT_ROUNDS, _VERDICT_ROUNDS = 9, 2, 3, 5
# Most rounds for a sharp peak, which a neighbour falls short of by more than this part.
_SHARP_ROUNDS, _SHARP = 12, 1e-3
# Part of the middle of an unstable range up to which a predicted resonance belongs to it.
_NEAR = 0.01


@dataclass(frozen=True)
class Limit:
    """A largest allowed amplitude in the unit ``own`` of the ``displacements``, and the unit of its answers."""

    value: float
    units: str
    displacements: Dimension
    own: str

    @classmethod
    def from_text(cls, system: type[System], written: Any) -> Limit:
        """The checked limit; :class:`InputError` for a system without a forced response."""
        if "forced" not in system.models or system.displacements is None:
            raise InputError(
                f"amplitude = {shown(written)}: {system.name} has no forced response; expected a system that has one"
            )
        units = system.state[0].units
        largest = math.pi / 2 if units == "rad" else math.inf
        parameter = Parameter("amplitude", units, "limit", lower=0.0, open_lower=True, upper=largest)
        parts = _units.split(written) if isinstance(written, str) else None
        if parts and not parts[1]:
            written = parts[0]
        value = float(checked(parameter, written, ""))
        return cls(value, parts[1] if parts and parts[1] else units, system.displacements, units)

    def written(self, amplitude: float) -> str:
        """An amplitude as text, in the unit of the limit."""
        return f"{amplitude * _units.factor(self.own, self.units):.6g} {self.units}"

    def at_point(self, amplitudes: np.ndarray, verdict: int) -> tuple[str, dict[str, Any]]:
        """The amplitudes at one point with this verdict, and whether they are within the limit: text and data.

        ``within`` is None if that is undecided.
        """
        known, unstable, undecided = bool(np.all(np.isfinite(amplitudes))), verdict == 1, verdict == 2
        above = known and bool(np.max(amplitudes) > self.value)
        within = None if not known or (undecided and not above) else not (above or unstable)
        names = [str(label) for label in self.displacements.labels(len(amplitudes))]
        listed = ", ".join(f"{name} {self.written(a)}" for name, a in zip(names, amplitudes, strict=True))
        compared = "unstable: the motion grows beyond" if unstable else "above" if above else "within"
        doubt = " if the motion is stable, which is undecided" if within is None else ""
        values = [float(a) if np.isfinite(a) else None for a in amplitudes]
        text = f"{listed}; {compared} the limit of {self.written(self.value)}{doubt}" if known else "no value"
        data = {"amplitude": dict(zip(names, values, strict=True)), "limit": self.value, "units": self.own}
        return text, data | {"within": within}

    def along(
        self,
        amplitude: Callable[[np.ndarray], np.ndarray],
        low: float,
        high: float,
        likely: np.ndarray,
        named: Callable[[float], str],
    ) -> tuple[str, dict[str, Any]]:
        """The largest amplitude along the speeds from ``low`` to ``high``, and the speeds within the limit: text and data.

        ``amplitude`` returns those of all displacements, ``named`` writes a speed. ``likely`` are speeds near peaks, which
        may be narrower than the distance of the samples.
        """
        x, y = _sampled(amplitude, low, high, likely, self.value, _LIMIT_ROUNDS)
        size = np.max(y, axis=1)
        k = int(np.argmax(size))
        largest, where, within = float(size[k]), float(x[k]), runs(x, size <= self.value)
        name = str(self.displacements.labels(y.shape[1])[int(np.argmax(y[k]))])
        text, limit = f"at most {self.written(largest)} ({name} at {named(where)})", self.written(self.value)
        if largest <= self.value:
            text += f": within the limit of {limit}"
        else:
            ranges = ", ".join(f"{named(a)} to {named(b)}" for a, b in within)
            kept = f"within the limit from {ranges}" if ranges else "above it at all of these speeds"
            text += f": above the limit of {limit}; {kept}"
        data = {"limit": self.value, "units": self.own, "largest": largest, "where": where, "displacement": name}
        return text, data | {"within": [list(ends) for ends in within]}


def _sampled(
    function: Callable[[np.ndarray], np.ndarray], low: float, high: float, likely: np.ndarray, limit: float, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, k) of ``function`` at samples (n,) from ``low`` to ``high``: dense at peaks, and in ``rounds`` ever closer
    to places where the largest of k crosses ``limit``."""
    steps = (high - low) * 0.5 ** np.array(_HALVINGS)
    likely = likely[(likely > low) & (likely < high)]
    x = np.unique(np.concatenate([np.linspace(low, high, EVEN), low + steps, high - steps, likely]))
    y = function(x)
    for number in range(_SHARP_ROUNDS):
        size = np.max(y, axis=1)
        peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
        if number >= _PEAK_ROUNDS:
            peaks = peaks[size[peaks] - np.minimum(size[peaks - 1], size[peaks + 1]) > _SHARP * size[peaks]]
        x, y = _refined(function, x, y, [(x[k - 1], x[k + 1]) for k in peaks])
    for _ in range(rounds):
        inside = np.max(y, axis=1) <= limit
        x, y = _refined(function, x, y, [(x[k], x[k + 1]) for k in np.flatnonzero(inside[1:] != inside[:-1])])
    return x, y


def with_unstable_ranges(dataset: xr.Dataset) -> tuple[xr.Dataset, float]:
    """``dataset``, a ``floquet`` result over one axis, with its unstable ranges (``unstable_NAME``) and the resonances next
    to them (``unstable_resonance``); and the value of the axis with the largest spectral radius.

    Both ends of a range are unstable by their error bound; closer ones beyond are not. A range between two samples is found
    if the radius rises there, or if a resonance is predicted there.
    """
    from drivetrain_jax.runs.run import run

    (name,) = dataset["outcome"].dims
    axis, scene = dataset[name], tomllib.loads(str(dataset.attrs["scene"]))
    outputs = ["spectral_radius", "verdict"]

    def size(x: np.ndarray) -> np.ndarray:
        values = x.tolist() if units_of(axis) == "1" else [f"{value!r} {units_of(axis)}" for value in x.tolist()]
        solved = run({**scene, "axes": {scene_key(axis): {"values": values}}, "outputs": outputs})
        radius, unstable = np.nan_to_num(solved["spectral_radius"].values), solved["verdict"].values == 1
        # Above 1 is what the verdict calls unstable.
        return np.where(unstable, np.maximum(radius, 1 + 1e-15), np.minimum(radius, 1.0))[:, None]

    known, predicted, labels = resonances(dataset), np.empty(0), []
    # The axis may be a physical datum, such as the speed in rpm.
    if known is not None and known.name == f"{LABELS}_{name}" and known.ndim == 1:
        predicted, labels = known.values, known[LABELS].values.tolist()
    likely = np.concatenate([axis.values, predicted[np.isfinite(predicted)]])
    x, y = _sampled(size, float(axis.min()), float(axis.max()), likely, 1.0, _VERDICT_ROUNDS)
    ends = np.reshape(runs(x, y[:, 0] > 1), (-1, 2))
    names = []
    for low, high in ends:
        apart = np.nan_to_num(np.abs(predicted - (low + high) / 2), nan=np.inf)
        near = bool(apart.size) and apart.min() <= max(high - low, _NEAR * high)
        names.append(labels[apart.argmin()] if near else "")
    about = {**axis.attrs, "long_name": f"lower and upper end of an unstable range, {name}"}
    found = {
        f"unstable_{name}": (("unstable_range", "end"), ends, about),
        "unstable_resonance": ("unstable_range", names),
    }
    return dataset.assign_coords(found), float(x[y[:, 0].argmax()])


def _refined(
    amplitude: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray, between: list[tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Samples with more of them ``between`` these pairs of speeds."""
    if not between:
        return x, y
    new = np.setdiff1d(np.concatenate([np.linspace(a, b, _PARTS) for a, b in between]), x)
    if not new.size:
        return x, y
    x, y = np.concatenate([x, new]), np.concatenate([y, amplitude(new)])
    order = np.argsort(x)
    return x[order], y[order]


def forced_at(atlas: Any, amplitude: Any, point: Mapping[str, float], verdict: Any) -> tuple[list[str], dict[str, Any]]:
    """The comparison of a stored atlas with a limit at one ``point``, as lines and as data; empty without a limit."""
    if amplitude is None:
        return [], {}
    limit = Limit.from_text(atlas.scene.system, amplitude)
    columns = {name: np.array([value]) for name, value in point.items()}
    verdict = atlas.direct(columns, "verdict")[0] if verdict is None else verdict
    text, data = limit.at_point(atlas.amplitude(columns)[0], int(verdict))
    return [f"forced amplitude: {text}"], {"forced": data}


def forced_over(
    atlas: Any, amplitude: Any, ranges: list[Any], at: Mapping[str, float], named: Callable[[str, float], str]
) -> tuple[list[str], dict[str, Any]]:
    """The comparison with a limit in ``ranges`` of speed: a line for each, and data; no lines without a limit."""
    if amplitude is None:
        return [], {}
    system = atlas.scene.system
    limit, speed, predicted = Limit.from_text(system, amplitude), system.roles["speed"], system.resonances

    def amplitudes(speeds: np.ndarray) -> np.ndarray:
        """The amplitudes with the other parameters ``at``; no value counts as infinite."""
        columns = {name: np.full(speeds.size, at[name]) for name in atlas.parameters if name != speed}
        return np.nan_to_num(atlas.amplitude({**columns, speed: speeds}), nan=np.inf)

    likely = np.empty(0)
    if ranges and predicted and predicted.axis == speed:
        forced = tuple(family.prefix for family in predicted.families if family.forced)
        excited = [bool(forced) and label.startswith(forced) for label in predicted.labels]
        likely = np.asarray(predicted.values({**atlas.fixed, **at}), float)[np.array(excited)]
    compared = [limit.along(amplitudes, low, high, likely, partial(named, speed)) for low, high in ranges]
    return [f"forced amplitude {text}" for text, _ in compared], {"forced": [data for _, data in compared]}
