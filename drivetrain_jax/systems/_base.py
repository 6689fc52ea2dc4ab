"""Base class of systems: an Equinox module whose fields are parameters, and whose methods return models for analyses.

A system does not deal with batches, files or figures. For each analysis that it serves, a method marked with :func:`serves`
returns the documented model, for example a :class:`LinearPeriodic` pair for ``floquet``. All models broadcast over a
trailing axis: a parameter is a scalar or an array of shape ``(...)``, and a matrix then has shape ``(n, n, ...)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from decimal import Decimal
from functools import partial
from inspect import cleandoc
from numbers import Complex
from os import PathLike
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError, meant, nearest
from drivetrain_jax._quantities import Component, Dimension, Parameter, Variable
from drivetrain_jax._units import is_unit, with_unit
from drivetrain_jax.resonances import Resonances, Values
from drivetrain_jax.systems._models import (
    DrivenSprings,
    FloquetModel,
    Flow,
    ForcedModel,
    PiecewiseLinearOscillator,
    Shaft,
    SpringSystem,
)
from drivetrain_jax.systems._smoothness import Smoothness

# Physical data of a system, and the parameters that follow from them: in NumPy, unless data are traced by JAX.


# rad/s.
RPM = 2 * np.pi / 60
POSITIVE: dict[str, Any] = {"lower": 0.0, "open_lower": True}


@dataclass(frozen=True)
class Conversion:
    """The computation of ``parameter`` from physical data and other parameters: ``value(*needs)``.

    It takes place if the first of ``needs``, a quantity, is given; the others must then be known. ``formula`` is its text.
    ``back(parameter, *needs[1:])`` returns that quantity. Lists among ``needs`` are taken entry by entry, except ``whole``
    ones; one number is repeated for each entry of the parameter ``per``. A ``replaceable`` conversion gives way to a given
    parameter, an ``optional`` one also to data that are not given.
    """

    parameter: str
    needs: tuple[str, ...]
    value: Callable[..., Any]
    formula: str
    back: Callable[..., Any] | None = None
    optional: bool = False
    replaceable: bool = False
    per: str = ""
    whole: tuple[str, ...] = ()


@dataclass(frozen=True)
class Along:
    """Values along the axis ``axis`` of a scene (or along its points)."""

    axis: str
    values: np.ndarray


@dataclass(frozen=True)
class PhysicalData:
    """The ``quantities`` that a scene may give, and the ``conversions``, in the order in which they are computed.

    A conversion may use the results of earlier ones, and compute a quantity that others need.
    """

    quantities: tuple[Parameter, ...]
    conversions: tuple[Conversion, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return tuple(quantity.name for quantity in self.quantities)

    def quantity(self, name: str) -> Parameter:
        """The quantity called ``name``; ``KeyError`` if there is none."""
        return {quantity.name: quantity for quantity in self.quantities}[name]

    def converted(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters and quantities that follow from ``given``, which holds quantities and parameters.

        Values are numbers, arrays, words, tuples of them (lists), or :class:`Along`. Raises :class:`InputError` if data are
        missing, or if a parameter is given too.
        """
        defaults = {q.name: q.default for q in self.quantities if q.default is not None and q.name not in given}
        results: dict[str, Any] = {}
        for rule in self.conversions:
            known = {**defaults, **given, **results}
            if rule.needs[0] not in known or rule.needs[0] in defaults:
                continue
            missing = [name for name in rule.needs if name not in known]
            if rule.parameter in given and (rule.optional or rule.replaceable):
                continue
            if rule.parameter in given:
                given_text = _shown(given[rule.parameter])
                raise InputError(
                    f"{rule.parameter} = {given_text}: given besides {', '.join(rule.needs)}; expected one of the two"
                )
            if missing and not rule.optional:
                raise InputError(
                    f"{missing[0]}: missing; {rule.parameter} = {rule.formula} needs {' and '.join(missing)}"
                )
            if not missing:
                value, entries = _evaluated(rule, [known[name] for name in rule.needs]), known.get(rule.per)
                if isinstance(entries, tuple) and not isinstance(value, tuple):
                    value = (value,) * len(entries)
                results[rule.parameter] = value
        return results

    def all_converted(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """As :meth:`converted`; raises :class:`InputError` for a quantity from which nothing follows."""
        results = self.converted(given)
        used = {name for rule in self.conversions if rule.parameter in results for name in rule.needs}
        for name in self.names:
            if name in given and name not in used:
                uses = [
                    f"{rule.parameter} needs {', '.join(rule.needs)}" for rule in self.conversions if name in rule.needs
                ]
                raise InputError(f"{name}: nothing follows from it ({'; '.join(uses)}); leave it out")
        return results

    def back(self, parameter: str, known: Mapping[str, Any]) -> tuple[Parameter, Callable[[Any], Any]] | None:
        """The quantity behind ``parameter``, and its value as a function of the parameter; None if there is none, or if data
        are missing."""
        known = {q.name: q.default for q in self.quantities if q.default is not None} | dict(known)
        for rule in self.conversions:
            if rule.parameter == parameter and rule.back and all(name in known for name in rule.needs[1:]):
                return self.quantity(rule.needs[0]), partial(_back, rule.back, [known[name] for name in rule.needs[1:]])
        return None

    def source(self, parameter: str) -> str:
        """The data that ``parameter`` follows from as text, empty without any."""
        return next((", ".join(rule.needs) for rule in self.conversions if rule.parameter == parameter), "")


def _back(back: Callable[..., Any], others: list[Any], value: Any) -> Any:
    return back(value, *others)


def _shown(value: Any) -> str:
    if isinstance(value, Along):
        return f"{value.values[0]:.10g}" if len(value.values) == 1 else f"axis {value.axis}"
    return repr(list(value) if isinstance(value, tuple) else value)


def _axes(conversion: Conversion, needs: list[Any]) -> list[str]:
    """The axis along which ``needs`` vary, if any; :class:`InputError` for several."""
    axes = list(dict.fromkeys(value.axis for value in needs if isinstance(value, Along)))
    if len(axes) > 1:
        raise InputError(
            f"axes.{axes[1]}: changes {conversion.parameter} together with {axes[0]}; expected one of them as an axis, "
            "or both in [points]"
        )
    return axes


def _at(value: Any, i: int) -> Any:
    if isinstance(value, tuple):
        return tuple(_at(entry, i) for entry in value)
    return value.values[i].item() if isinstance(value, Along) else value


def _evaluated(conversion: Conversion, needs: list[Any]) -> Any:
    """The value of a conversion: a number or word, a tuple of them, :class:`Along`, or a tuple with some of these."""
    listed = [
        isinstance(value, tuple) and name not in conversion.whole
        for name, value in zip(conversion.needs, needs, strict=True)
    ]
    lengths = {name: len(v) for name, v, is_listed in zip(conversion.needs, needs, listed, strict=True) if is_listed}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {count}" for name, count in lengths.items())
        raise InputError(f"{conversion.needs[0]}: {counts} entries; expected lists of one length")
    if lengths:
        count = next(iter(lengths.values()))
        entries = [[v[i] if is_listed else v for v, is_listed in zip(needs, listed, strict=True)] for i in range(count)]
        return tuple(_evaluated(conversion, entry) for entry in entries)
    axes = _axes(conversion, needs)
    value: Any
    try:
        value = conversion.value(*(need.values if isinstance(need, Along) else need for need in needs))
    except TypeError:
        inside = [entry for value in needs if isinstance(value, tuple) for entry in value if isinstance(entry, Along)]
        if not inside:
            raise
        # Arithmetic with an entry of a whole list that varies: value by value.
        axes = _axes(conversion, [*needs, *inside])
        value = [conversion.value(*(_at(need, i) for need in needs)) for i in range(len(inside[0].values))]
    if axes:
        return Along(axes[0], np.asarray(value, float))
    return value if isinstance(value, (str, jax.core.Tracer, Along)) or np.ndim(value) else float(value)


Method = TypeVar("Method", bound=Callable[..., Any])
Number = float | Array | np.ndarray
_PARAMETER, _SERVES = "parameter", "_serves"
# The usual class of the model of an analysis.
_MODELS: dict[str, type] = {
    **dict.fromkeys(("floquet", "atlas"), FloquetModel),
    "forced": ForcedModel,
    **dict.fromkeys(("history", "lyapunov", "poincare"), Flow),
    **dict.fromkeys(("parameters", "phasing"), Mapping),
    **dict.fromkeys(("steady_state", "basins", "frequency_response"), PiecewiseLinearOscillator),
    "modes": SpringSystem,
    "harmonic_response": DrivenSprings,
    **dict.fromkeys(("critical_speeds", "whirl"), Shaft),
}
# What people give as a value, right or wrong.
_DATA = (Complex, Decimal, str, bytes, list, tuple, dict, set, PathLike)


@dataclass(frozen=True)
class Model:
    """The service of a system for one analysis."""

    #: ``build(values)``: the model, from the values of ``parameters``.
    build: Callable[[Values], Any]
    #: Names of the parameters that the model uses.
    parameters: tuple[str, ...]
    #: ``check(fixed)`` raises ``ValueError`` with one line, ``name = value: expected ...``, if parameters in range do not
    #: match each other. ``fixed`` holds the values that do not vary, and a whole list even if one of its entries varies.
    check: Callable[[Values], None] | None = None
    #: Coordinates of an atlas. None: the parameters, and an atlas only on request (``method = "auto"`` makes none).
    smooth: Smoothness | None = None
    #: Variables of an analysis whose results are the system's own (``parameters``).
    results: tuple[Variable, ...] = ()
    #: Names of those ``results`` that are computed by default; empty: all.
    default_outputs: tuple[str, ...] = ()
    #: ``says(values, parameters)``: the answer of a point in one sentence.
    says: Callable[[Values, Values], str] | None = None
    #: Class of the model if it is not the usual one of the analysis (``history``: a flow).
    returns: type | None = None


def numeric(*values: Any) -> tuple[Any, ...]:
    """The module to compute with, then ``values`` as its arrays of floats: NumPy, unless one of them is traced."""
    module = jnp if any(isinstance(value, jax.core.Tracer) for value in values) else np
    return module, *(module.asarray(value, float) for value in values)


def scaled(factor: Any, x: Any) -> Array:
    """``factor * x``, in which NaN times 0 is 0, also when transposed: a NaN affects only its own result and parameter.

    The product is written as the solution y of ``y = (factor * x, x)``, because jax accepts a given transpose of a linear
    solve.
    """
    factor, x = jnp.broadcast_arrays(factor, x)

    def times(y: Array) -> Array:
        return jnp.where(y == 0, 0.0, factor * y)

    solution = jax.lax.custom_linear_solve(
        lambda y: y.at[0].add(-factor * y[1]),
        jnp.stack([jnp.zeros_like(x), x]),
        lambda _, b: b.at[0].add(times(b[1])),
        lambda _, b: b.at[1].add(times(b[0])),
    )
    return solution[0]


def parameter(units: str, long_name: str, **more: Any) -> Any:
    """A field of a :class:`System`: a parameter in ``units``; ``more`` as in :class:`Parameter` (default, range, ...).

    Words are static parts of the module; numbers and lists of numbers are leaves.
    """
    described = Parameter("", units, long_name, **more)
    static = bool(described.choices) or described.text
    return eqx.field(kw_only=True, static=static, default=described.default, metadata={_PARAMETER: described})


def serves(
    *analyses: str,
    parameters: tuple[str, ...] | None = None,
    check: Callable[[Values], None] | None = None,
    **declared: Any,
) -> Callable[[Method], Method]:
    """Mark a method of a :class:`System` as the one that returns the model of these ``analyses``.

    ``parameters``: names of those that the model uses, by default all. ``check`` and other ``declared`` entries (``smooth``,
    ``results``, ...) as in :class:`Model`.
    """

    def mark(method: Method) -> Method:
        known = {"parameters": parameters, "check": check, **declared}
        vars(method).setdefault(_SERVES, {}).update(dict.fromkeys(analyses, known))
        return method

    return mark


class System(eqx.Module):
    """A drivetrain model, see the module's docstring. A subclass declares its parameters as fields by :func:`parameter`.

    Concrete values are checked against their ranges: :class:`~drivetrain_jax.InputError` names the first one out of range.
    Traced values are not checked.

    A model for ``atlas`` without one for ``floquet``, one for ``history`` without ``state``, or a :class:`ForcedModel`
    without ``state`` and ``displacements`` raises ``ValueError``.
    """

    #: Name in scenes, ``cardan``.
    name: ClassVar[str]
    #: One line about the system.
    title: ClassVar[str]
    #: The publication.
    source: ClassVar[str] = ""
    #: Named parameter sets of the source.
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({})
    #: Predicted resonances.
    resonances: ClassVar[Resonances | None] = None
    #: Unit of time in the equations; ``1``: nondimensional.
    time_units: ClassVar[str] = "1"
    #: Periods of the equations in a turn of the shaft; 0: unknown.
    periods_per_turn: ClassVar[int] = 0
    #: Physical data that parameters follow from.
    physical: ClassVar[PhysicalData | None] = None
    #: Names of the parameters that analyses and figures ask for. ``speed`` (or excitation frequency): horizontal axis of
    #: figures and path of ``frequency_response``; ``angle`` and ``damping``: design questions; ``initial_displacement`` and
    #: ``initial_rate``: ``steady_state`` and ``history``; ``half_play`` and ``planets`` (their angles): figures.
    roles: ClassVar[Mapping[str, str]] = MappingProxyType({})
    #: Components of the state.
    state: ClassVar[tuple[Component, ...]] = ()
    #: Dimension of the entries of each component of the state, if their number depends on the parameters.
    state_axis: ClassVar[Dimension | None] = None
    #: Dimension of the components of the state whose amplitudes ``forced`` reports.
    displacements: ClassVar[Dimension | None] = None
    #: Unit of the torques that ``forced`` reports at the displacements; empty: none.
    torque_units: ClassVar[str] = ""
    #: Names of the families of ``modes`` by their codes.
    mode_families: ClassVar[tuple[str, ...]] = ()
    #: The parameters, which follow from the fields.
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    #: The models by analysis, which follow from the methods marked with :func:`serves`.
    models: ClassVar[dict[str, Model]] = {}

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        body = vars(cls)
        fields = {
            name: body[name].metadata for name in body.get("__annotations__", {}) if hasattr(body.get(name), "metadata")
        }
        for name, kind in body.get("__annotations__", {}).items():
            if name not in fields and "ClassVar" not in str(kind):
                raise TypeError(f"{cls.__name__}.{name}: not a parameter; expected {name}: Any = parameter(...)")
        for name in fields:
            if hasattr(System, name) or name == "outcome":
                raise InputError(f"{cls.__name__}.{name}: a name that every system or result has; expected another one")
        own = {name: replace(m[_PARAMETER], name=name) for name, m in fields.items() if _PARAMETER in m}
        cls.parameters = tuple(({p.name: p for p in cls.parameters} | own).values())
        # For `help`: meaning, range, unit and default of each parameter; the signature has None where there is no default.
        about = []
        for p in cls.parameters:
            value = p.derived or ("none" if p.default == () else p.default)
            default = "required" if value is None else f"default {value}"
            about.append(f"    {p.name}: {p.long_name}; {p.allowed_in_units}; {default}.")
        cls.__doc__ = "\n".join([cleandoc(body.get("__doc__") or getattr(cls, "title", "")), "", "Args:", *about])
        if "models" not in body:
            # Methods of the base build this class, whose parameters and other methods they use.
            marked = {a: getattr(model.build, "__wrapped__", None) for a, model in cls.models.items()}
            inherited = {a: _models(cls, body.get(m.__name__, m), m)[a] for a, m in marked.items() if m}
            inherited = dict(cls.models) | inherited
            cls.models = inherited | {a: m for method in body.values() for a, m in _models(cls, method).items()}
        _check_names(cls)
        if "atlas" in cls.models and "floquet" not in cls.models:
            raise ValueError(f"models of {cls.name}: atlas needs floquet as well")
        for analysis, model in cls.models.items():
            orbits = (model.returns or _MODELS.get(analysis)) is ForcedModel
            for needed, asked in (("state", orbits or analysis == "history"), ("displacements", orbits)):
                if asked and not getattr(cls, needed):
                    raise ValueError(f"models of {cls.name}: {analysis} needs {needed}, an attribute of the class")

    def __new__(cls, *values: Any, **given: Any) -> Any:
        """A new system; raises :class:`~drivetrain_jax.InputError` for a name that is no parameter."""
        if values:
            raise InputError(
                f"{cls.__name__}: {len(values)} values without names; expected {cls.__name__}(name=value, ...)"
            )
        physical = cls.physical.names if cls.physical else ()
        known = [field.name for field in dataclass_fields(cls)]
        for name in given:
            if name in physical:
                raise InputError(f"{name}: physical data; expected in {cls.__name__}.from_physical(...)")
            if name not in known:
                raise InputError(f"{name}: unknown{meant(name, cls.parameters)}; expected {', '.join(known)}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for kind in self.parameters:
            object.__setattr__(self, kind.name, _admitted(kind, getattr(self, kind.name)))

    def __repr__(self) -> str:
        return printed(self)

    @classmethod
    def of(cls, values: Values) -> Any:
        """The system with these ``values``, which are not checked; a parameter that is missing has its default."""
        new = object.__new__(cls)
        for kind in cls.parameters:
            object.__setattr__(new, kind.name, values.get(kind.name, kind.default))
        return new

    @property
    def values(self) -> dict[str, Any]:
        """The parameters by name, those left out that are to be derived from others."""
        named = {kind.name: getattr(self, kind.name) for kind in self.parameters}
        return {name: value for name, value in named.items() if value is not None}

    @classmethod
    def from_physical(cls, **data: Any) -> Any:
        """The system whose parameters follow from physical ``data``; parameters may be among them, and JAX may trace them.

        >>> from drivetrain_jax import Cardan
        >>> print(round(Cardan.from_physical(J1=2, J2=0.5, k1=6e4, k2=4e4, c1=0.3, c2=0.2, speed=1425, angle=12).Omega, 4))
        0.8616
        """
        if cls.physical is None:
            raise InputError(f"system = {cls.name!r}: has no physical data; expected {cls.__name__}(...)")
        known = {kind.name: kind for kind in (*cls.physical.quantities, *cls.parameters)}
        for name in data:
            if name not in known:
                guess = meant(name, known.values())
                raise InputError(f"{name}: unknown{guess}; expected {', '.join(known)}")
        given = {name: _admitted(known[name], value) for name, value in data.items()}
        values = given | cls.physical.all_converted(given)
        return cls(**{name: value for name, value in values.items() if name not in cls.physical.names})

    @classmethod
    def unit_of_time(cls) -> str:
        """The unit of times in results and options; a time without unit is the angle of a shaft, in rad."""
        return "rad" if cls.time_units == "1" else cls.time_units

    @classmethod
    def role(cls, name: str) -> str:
        """The parameter with the role ``name``; :class:`~drivetrain_jax.InputError` if there is none."""
        if name not in cls.roles:
            raise InputError(f"system = {cls.name!r}: has no {name}; expected a system whose roles name it")
        return cls.roles[name]

    @classmethod
    def parameter(cls, name: str) -> Parameter:
        """The parameter called ``name``; ``KeyError`` if there is none."""
        return {p.name: p for p in cls.parameters}[name]


def _check_names(system: type[System]) -> None:
    """Raise :class:`~drivetrain_jax.InputError` for units that are none, and for names that are no parameters."""
    names = [quantity.name for quantity in system.parameters]
    for quantity in (*system.parameters, *(system.physical.quantities if system.physical else ())):
        if not is_unit(quantity.units):
            raise InputError(
                f"{system.__name__}.{quantity.name}: units = {quantity.units!r}; expected 1 or units such as N m/rad"
            )
    named = {f"roles[{role!r}]": [name] for role, name in system.roles.items()}
    for analysis, model in system.models.items():
        named[f"parameters of {analysis}"] = list(model.parameters)
        named[f"smooth of {analysis}"] = list(model.smooth.coordinates) if model.smooth else []
    for where, listed in named.items():
        for name in listed:
            if name not in names:
                raise InputError(f"{system.__name__}: {where}: {name!r} is not a parameter{nearest(name, names)}")


def _models(system: type[System], method: Any, marked: Any = None) -> dict[str, Model]:
    """The models that ``method`` of ``system`` returns, by analysis; it has the marks of ``marked``, which it replaces."""
    marks = getattr(marked or method, _SERVES, {})
    if not marks:
        return {}

    kinds = tuple({known.get("returns") or _MODELS.get(name, object) for name, known in marks.items()})

    def build(values: Values) -> Any:
        model = method(system.of(values))
        if model is None or not isinstance(model, kinds):
            where, allowed = f"{system.__name__}.{method.__name__}", " or ".join(sorted(k.__name__ for k in kinds))
            raise InputError(f"{where} returned {type(model).__name__}; expected a model of the class {allowed}")
        return model

    # The source file of a model determines its digest.
    build.__wrapped__ = method  # pyright: ignore[reportFunctionMemberAccess]
    everything = tuple(p.name for p in system.parameters)
    return {
        name: Model(build, **(known if known["parameters"] is not None else known | {"parameters": everything}))
        for name, known in marks.items()
    }


def _admitted(described: Parameter, value: Any) -> Any:
    """``value`` in its stored type, or :class:`InputError`. A list becomes a tuple of its entries, traced or not; other
    arrays and traced values are unchanged."""
    if value is None:
        if described.default is None and not described.derived:
            raise InputError(f"{described.name}: missing; expected {described.allowed_in_units}")
        return None
    if described.choices or described.text:
        return described.check(value)
    if described.listed and isinstance(value, (np.ndarray, jax.Array)) and value.ndim == 1:
        value = list(value) if isinstance(value, jax.core.Tracer) else value.tolist()
    if described.listed and isinstance(value, (list, tuple)):
        one = replace(described, listed=False)
        return tuple(_number(replace(one, name=f"{one.name}[{i}]"), entry) for i, entry in enumerate(value))
    return _number(described, value)


def _number(described: Parameter, value: Any) -> Any:
    value = with_unit(value)
    if isinstance(value, list):
        return np.array([_number(described, entry) for entry in value])
    if np.ma.is_masked(value):
        raise InputError(f"{described.name}: a masked value; expected numbers, {described.allowed_in_units}")
    if isinstance(value, jax.core.Tracer) or not hasattr(value, "dtype"):
        # A placeholder of a transformation, such as a shape, is no number either.
        return described.check(value) if isinstance(value, _DATA) or hasattr(value, "columns") else value
    whole = np.asarray(value)
    if whole.dtype.kind not in "iuf":
        raise InputError(f"{described.name}: an array of {whole.dtype}; expected numbers, {described.allowed_in_units}")
    # The extremes stand for all values of a range without holes.
    holes = described.integer or described.or_zero
    for number in np.unique(whole) if holes else (whole.min(), whole.max()) if whole.size else ():
        described.check(float(number))
    return value if whole.dtype.kind == "f" else whole.astype(float)


# Most complex numbers that are printed: the multipliers of a point.
_FEW = 8


def printed(tree: Any) -> str:
    """The text of ``tree`` with the values of arrays of one number and of few complex numbers, and the shapes of others."""

    def number(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array) or isinstance(leaf, jax.core.Tracer):
            return leaf
        few = leaf.ndim == 1 and leaf.size <= _FEW and jnp.iscomplexobj(leaf)
        return leaf.tolist() if few or leaf.ndim == 0 else leaf

    return eqx.tree_pformat(jax.tree.map(number, tree))
