"""Style of all figures: type sizes, colours that differ in lightness and hue, names, and units of the reader.

Units are those asked for or given, with usual prefixes such as 85 MN/m for 8.5e7 N/m.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax import _units
from drivetrain_jax._errors import InputError, shown

if TYPE_CHECKING:
    import xarray as xr

# Passed to rc_context around every figure; global rcParams stay unchanged.
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "mathtext.fontset": "dejavusans",
    "font.size": 8.0,
    "axes.labelsize": 8.5,
    "axes.titlesize": 8.5,
    "axes.linewidth": 0.7,
    "axes.formatter.useoffset": False,
    # Show powers of ten as a factor, because numbers of six digits would overlap the axis label.
    "axes.formatter.limits": (-3, 5),
    "axes.formatter.use_mathtext": True,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "figure.titlesize": 10.5,
    "legend.fontsize": 8.0,
    "legend.title_fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "hatch.linewidth": 0.5,
}

LINE_COLOURS = ("#1f4e79", "#d1771e", "#3f8f5f", "#7a4fa0", "#999933", "#333333", "#a0308c")
# Attractors differ in lightness and hue.
ATTRACTOR_COLOURS = ("#33517c", "#f2b632", "#9cc3e0", "#c8553d", "#6a994e", "#d9c5e0", "#2d0a2b", "#8d99ae")
FRAME_GREY, PREDICTION = "#555555", "#0b84d8"
# Lightness falls from stable or regular to unstable or irregular, so that flags differ in grey. Stable cells are
# transparent: lines below the cells show there alone.
FLAG_COLOURS = {
    "stable": "#ffffff00",
    "unstable": "#33415c",
    "computed": "#ffffff00",
    "undecided": "#f2b632",
    "no_separation": "#ffffff00",
    "single_sided": "#9cc3e0",
    "double_sided": "#33517c",
    "non_periodic": "#f2b632",
    "fixed_point": "#e6f0f7",
    "periodic": "#b5d3ea",
    "quasi_periodic": "#6ea6d0",
    "parametrically_unstable": "#d1771e",
    "chaotic": "#5b1020",
}
FAILED_COLOUR, PENDING_COLOUR = "#d1495b", "#c4c4c4"

_GREEK = {
    *("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "kappa", "lambda", "mu", "nu", "xi"),
    *("rho", "sigma", "tau", "phi", "chi", "psi", "omega", "Gamma", "Delta", "Theta", "Lambda", "Phi", "Psi", "Omega"),
}

# Largest number of ranges in a sentence.
MOST_RANGES = 8
# Largest length of a list in a caption.
_MOST_ENTRIES = 6
_PRODUCTS = {"EI": "$EI$", "rhoA": r"$\rho{}A$", "rhoI": r"$\rho{}I$", "kGA": r"$\kappa{}GA$"}


def symbol(name: str) -> str:
    """``name`` as a formula, with Greek letters and an index as subscript (``k_A``, ``k_joint``), else unchanged.

    Entries of a list are numbered from 0, as in scenes: ``m_p[1]`` is m_p,1.
    """
    if match := re.fullmatch(r"(.+)\[(\d+)\]|(k_.+)_(y)", name):
        head, number = symbol(match[1] or match[3]), match[2] or match[4]
        if not head.endswith("$"):
            return f"{head}[{number}]"
        return f"{head[:-2]},{number}}}$" if head.endswith("}$") else f"{head[:-1]}_{{{number}}}$"
    if name in _PRODUCTS:
        return _PRODUCTS[name]
    if name in _GREEK:
        return rf"$\{name}$"
    # Without an underscore an index is a number: `rate` is a word.
    if match := re.fullmatch("(" + "|".join(_GREEK) + r"|[A-Za-z]{1,2})(?:_([A-Za-z]{0,2}\d*)|(\d*))", name):
        head, index = match[1], match[2] or match[3]
        head = rf"\{head}" if head in _GREEK else head
        return rf"${head}_{{{index}}}$" if index else f"${head}$"
    if match := re.fullmatch(r"(Ip|[A-Za-z])_([a-z]{3,})", name):
        return rf"${match[1]}_{{\mathrm{{{match[2]}}}}}$"
    return name.replace("_", " ")


def state(dataset: xr.Dataset) -> list[dict[str, Any]]:
    """The components of the system's state: name, units, long_name, symbol, scale. Empty if it declares none."""
    return json.loads(dataset.attrs.get("state", "[]"))


def scene_key(coordinate: xr.DataArray) -> str:
    """The name of a parameter in its scene: ``length[1]`` of the coordinate ``length_1``."""
    return str(coordinate.attrs.get("parameter", coordinate.name))


def parameters(dataset: xr.Dataset) -> dict[str, Any]:
    """The parameters that do not vary, in their stored units: fixed ones, and axes of one value."""
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}"))
    values = {name: _with_infinity(entry["value"]) for name, entry in fixed.items()}
    for coordinate in dataset.coords.values():
        name, _, place = scene_key(coordinate).rstrip("]").partition("[")
        if coordinate.ndim or coordinate.dtype.kind != "f":
            continue
        units = fixed.get(name, {}).get("units", coordinate.attrs.get("units", "1"))
        number = float(value_in(coordinate, units))
        if not place:
            values[name] = number
        elif int(place) < len(values.get(name, [])):
            values[name][int(place)] = number
    return values


def _with_infinity(value: Any) -> Any:
    """``value`` with infinity for the word by which JSON, which has none, holds it."""
    if isinstance(value, list):
        return [_with_infinity(entry) for entry in value]
    return math.inf if value == "inf" else value


def axis_label(coordinate: xr.DataArray) -> str:
    """``long name (symbol) [units]`` of a swept parameter, without a symbol that repeats the long name."""
    name, long_name = scene_key(coordinate), _long_name(coordinate)
    mark = "" if name.replace("_", " ") == long_name else f" ({symbol(name)})"
    return f"{long_name}{mark}{in_brackets(units_of(coordinate))}"


def variable_label(variable: xr.DataArray) -> str:
    """``long name [units]`` of a result."""
    return f"{_long_name(variable)}{in_brackets(units_of(variable))}"


def in_brackets(units: str) -> str:
    """`` [units]`` as a label ends with, or nothing for a pure number."""
    return "" if units in ("1", "") else f" [{written_units(units)}]"


def units_of(variable: xr.DataArray) -> str:
    """The unit of a result in the notation of figures."""
    return written_units(str(variable.attrs.get("units", "1")))


def value_text(name: str, value: object, units: str = "1") -> str:
    """``symbol = value units``, with a prefix of the unit; a list of more than six entries is shortened to its length."""
    entries = value if isinstance(value, (list, tuple)) else [value]
    if len(entries) > _MOST_ENTRIES:
        return f"{symbol(name)}: {len(entries)} values"
    factor, units = prefixed([entry for entry in entries if isinstance(entry, (int, float))], units)
    end = _units.behind(written_units(units))
    digits = "{:.5g}" if entries is value else "{:.6g}"
    texts = (power_of_ten(digits.format(x / factor)) if isinstance(x, (int, float)) else str(x) for x in entries)
    text = ", ".join(texts)
    return f"{symbol(name)} = [{text}]{end}" if entries is value else f"{symbol(name)} = {text}{end}"


def power_of_ten(number: str) -> str:
    """``1.5×10⁻⁵`` for ``1.5e-05``, and ``10⁻⁶`` for ``1e-06``."""
    digits, e, exponent = number.partition("e")
    power = str(int(exponent)).translate(SUPERSCRIPTS) if e else ""
    factor = "" if digits == "1" else f"{digits}×"
    return f"{factor}10{power}" if e else number


def coordinate_text(coordinate: xr.DataArray) -> str:
    """``symbol = value units`` of a scalar coordinate."""
    return value_text(scene_key(coordinate), coordinate.item(), coordinate.attrs.get("units", "1"))


def entry_name(dimension: str, entry: object) -> str:
    """``driving shaft`` for a named entry of a dimension, ``shaft 1`` for a numbered one, ``carrier`` for a body."""
    if dimension == "body":
        return str(entry)
    return f"{dimension} {entry}" if str(entry)[:1].isdigit() else f"{entry} {dimension}"


def ranges_text(axis: xr.DataArray, holds: np.ndarray) -> str:
    """The runs of sampled values of ``axis`` at which ``holds`` is true: ``speed = 1425, 2275 to 2290 rpm``."""
    # An axis keeps the order of its scene, in which neighbours of a list may lie far apart.
    rising = np.argsort(axis.values, kind="stable")
    return runs_text(axis, runs(axis.values[rising], holds[rising]))


def runs(values: np.ndarray, holds: np.ndarray) -> tuple[tuple[float, float], ...]:
    """First and last of the ``values`` in each run that ``holds``."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], holds.astype(np.int8), [0]))))
    return tuple((float(values[a]), float(values[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def runs_text(axis: xr.DataArray, runs: Sequence[Any] | np.ndarray, names: Sequence[str] | np.ndarray = ()) -> str:
    """Ranges of ``axis`` as text, the first ones of many, each with its name in brackets if ``names`` has one."""
    shown = [f"{a:.6g}" if a == b else f"{a:.6g} to {b:.6g}" for a, b in runs[:MOST_RANGES]]
    shown = [f"{text} ({name})" if name else text for text, name in zip_longest(shown, names[: len(shown)])]
    more = f" and {len(runs) - MOST_RANGES} more ranges" if len(runs) > MOST_RANGES else ""
    return f"{scene_key(axis)} = {', '.join(shown)}{more}{_units.behind(units_of(axis))}"


def unstable_text(dataset: xr.Dataset, along: str) -> str:
    """The unstable ranges of the axis ``along`` with the names of their resonances; empty without any."""
    stored, names = dataset.coords.get(f"unstable_{along}"), dataset.coords.get("unstable_resonance", np.empty(0))
    if stored is None or not stored.size:
        return ""
    return f"unstable at {runs_text(dataset[along], stored.values, np.asarray(names))}"


def caption(dataset: xr.Dataset) -> str:
    """One line with the fixed parameters of the scene, then scalar coordinates; defaults are left out.

    Joined results may differ in their fixed parameters, so only their coordinates are shown.
    """
    named_in = _given(dataset)
    # Physical data are shown as they were given, in place of the parameters that follow from them.
    tables = (json.loads(dataset.attrs.get(name, "{}")) for name in ("fixed_parameters", "physical_data"))
    fixed = {name: entry for table in tables for name, entry in table.items()}
    varies = {str(name) for name in (*dataset.coords, *dataset.dims)}
    shown = [] if is_joined(dataset) else [name for name in fixed if name in named_in["fixed"] and name not in varies]
    parts = [_fixed_text(dataset, name, fixed[name]) for name in shown]
    named = set().union(*named_in.values())
    for name, coordinate in dataset.coords.items():
        # An entry of a list may be shown as a part of the whole.
        whole = scene_key(coordinate).partition("[")[0]
        known = whole in fixed if whole != name else name in fixed and name not in named
        if not coordinate.ndim and name != "point" and not known:
            parts.append(coordinate_text(coordinate))
    return ", ".join([*parts, *([dataset.attrs["left_out"]] if "left_out" in dataset.attrs else [])])


def is_joined(dataset: xr.Dataset) -> bool:
    """True if results of several scenes were joined along a dimension that no scene has."""
    dims = {scene_key(dataset[dim]) for dim in dataset["outcome"].dims} if "outcome" in dataset else set()
    return "scene" in dataset.attrs and bool(dims - set().union(*_given(dataset).values()) - {"point"})


def _given(dataset: xr.Dataset) -> dict[str, set[str]]:
    """Names of the parameters in each table of the scene; without a scene all are fixed."""
    if "scene" not in dataset.attrs:
        return {"fixed": set(json.loads(dataset.attrs.get("fixed_parameters", "{}")))}
    return {table: set(scene_of(dataset).get(table, ())) for table in ("fixed", "axes", "points")}


def _fixed_text(dataset: xr.Dataset, name: str, entry: Mapping[str, Any]) -> str:
    """A fixed value in the unit asked for or given; swept entries of a list, such as ``planet_angle[1]``, vary."""
    value, stored = entry["value"], str(entry.get("units", "1"))
    size, units = unit_of(dataset, name, stored)
    if not isinstance(value, (list, tuple)):
        return value_text(name, value * size if isinstance(value, (int, float)) else value, units)
    entries = [c for c in dataset.coords.values() if scene_key(c).startswith(f"{name}[")]
    axes = {scene_key(c): "varies" if c.ndim else float(value_in(c, stored)) for c in entries}
    shown = [axes.get(f"{name}[{i}]", number) for i, number in enumerate(value)]
    return value_text(name, [x * size if isinstance(x, (int, float)) else x for x in shown], units)


def _long_name(variable: xr.DataArray) -> str:
    return str(variable.attrs.get("long_name", variable.name))


# The attribute with the units asked for, and the mark of a converted variable, which takes no further prefix.
ASKED, CONVERTED = "figure_units", "converted"
# Units whose first symbol takes a prefix: N, N/m, N m, N m/rad, N m2, N s/m, Pa.
_PREFIXED = re.compile(r"(N|Pa)(?![A-Za-z])|m$")
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (0.0, ""))
# Displacements in metres: below a centimetre in mm, below a tenth of a millimetre in um.
_SMALL = ((1e-2, 1.0, ""), (1e-4, 1e-3, "m"), (0.0, 1e-6, "u"))
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def written_units(units: str) -> str:
    """A unit of UDUNITS in common notation: ``kg m²`` for ``kg m2`` or ``kg m^2``, ``µm`` for ``um``."""
    powers = re.sub(r"(?<=[A-Za-z])\^?(-?\d+)", lambda power: power[1].translate(SUPERSCRIPTS), units)
    return re.sub(r"\bu(?=m\b)", "\u00b5", powers)


def listed(units: str | Sequence[str]) -> list[str]:
    """The units of ``"rpm,deg"`` or of a list; raises :class:`InputError` for an unknown one, and for two of one kind."""
    listing = units.split(",") if isinstance(units, str) else units
    if not isinstance(listing, (list, tuple)) or not all(isinstance(unit, str) for unit in listing):
        raise InputError(f'units = {shown(units)}: expected units such as "rpm,deg", or a list of them')
    names = [unit.strip() for unit in listing]
    for number, unit in enumerate(names):
        try:
            _units.number(f"1 {unit}", unit)
        except _units.UnitError:
            raise InputError(f"units = {unit!r}: not a unit; expected units such as rpm, deg or mm") from None
        if twin := next((other for other in names[:number] if size(unit, other)), None):
            raise InputError(f"units = {unit!r}: measures the same as {twin}; expected one of them")
    return names


def size(units: str, unit: str) -> float | None:
    """The number of ``unit`` that one of ``units`` is; None if they measure different things."""
    if units in ("1", "") or units == unit:
        return 1.0 if units == unit else None
    try:
        return 1 / _units.factor(unit, units)
    except _units.UnitError:
        return None


def suitable(units: str, asked: Iterable[str]) -> tuple[float, str]:
    """The unit among ``asked`` for a value in ``units``, and its factor; 1 and ``units`` without one."""
    fitting = ((factor, unit) for unit in asked if (factor := size(units, unit)) is not None)
    return next(fitting, (1.0, units))


def in_units(dataset: xr.Dataset, asked: Sequence[str] = ()) -> xr.Dataset:
    """``dataset`` with axes, results and state in the units ``asked`` for, the first that fits each; other axes, and what
    belongs to them, in the unit in which the scene gives them."""
    dataset, changed = dataset.assign_attrs({ASKED: json.dumps(list(asked))}), {}
    for name, variable in dataset.variables.items():
        units = str(variable.attrs.get("units", "1"))
        axis = dataset.coords.get(re.sub(r"^(?:boundary|tip|undecided|resonance|unstable)_|_error$", "", str(name)))
        about = {} if axis is None else {"parameter": axis.name, "units": "1", **axis.attrs}
        factor, unit = unit_of(dataset, str(about["parameter"]) if about.get("units") == units else "", units)
        if unit != units and variable.dtype.kind in "fc":
            attrs = {**variable.attrs, "units": unit, CONVERTED: 1}
            changed[name] = variable.dims, variable.values * factor, attrs
    components, sizes = state(dataset), []
    for component in components:
        factor, component["units"] = suitable(component["units"], asked)
        component["scale"] = component.get("scale", 1.0) * factor / (sizes or [factor])[0]
        sizes.append(factor)
    for name, variable in dataset.variables.items():
        # A point of a section: a displacement and a rate.
        if "units_of_components" in variable.attrs and variable.sizes.get("state") == len(sizes):
            scaled = variable.values * np.array(sizes).reshape([-1 if d == "state" else 1 for d in variable.dims])
            changed[name] = variable.dims, scaled, variable.attrs
    return _assigned(dataset, changed).assign_attrs({"state": json.dumps(components)} if components else {})


def unit_of(dataset: xr.Dataset, name: str, units: str) -> tuple[float, str]:
    """The unit in which figures show the parameter ``name``, stored in ``units``: the one asked for, else that of the first
    text that the scene gives for it; and the factor of the values."""
    scene = scene_of(dataset)
    entries = [scene.get(table, {}).get(name) for table in ("axes", "points", "fixed")]
    entries = [part for entry in entries for part in (entry.values() if isinstance(entry, dict) else [entry])]
    texts = [x for part in entries for x in (part if isinstance(part, list) else [part]) if isinstance(x, str)]
    # The scale of an axis is a text, too, but no number.
    written_units = [written[1] for text in texts if (written := _units.split(text))][:1]
    return suitable(units, [*json.loads(dataset.attrs.get(ASKED, "[]")), *filter(None, written_units)])


def scene_of(dataset: xr.Dataset) -> dict[str, Any]:
    """The tables of the scene of ``dataset``; empty without one."""
    return _parsed(str(dataset.attrs.get("scene", "")))


_parsed = lru_cache(maxsize=8)(tomllib.loads)


def value_in(variable: xr.DataArray, units: str) -> Any:
    """The values of ``variable`` in ``units``, whatever its figure shows."""
    return variable.values * suitable(str(variable.attrs.get("units", units)), [units])[0]


def check_measured(dataset: xr.Dataset, asked: Iterable[str]) -> None:
    """Raise :class:`InputError` for a unit ``asked`` for that measures no parameter and no result of ``dataset``."""
    fixed = json.loads(dataset.attrs.get("fixed_parameters", "{}")).values()
    described = [*(v.attrs for v in dataset.variables.values()), *state(dataset), *fixed]
    units = dict.fromkeys(str(about.get("units", "1")) for about in described)
    remedy = " (a dimensionless speed needs physical data in the scene)"
    for unit in asked:
        if all(size(known, unit) is None for known in units):
            raise InputError(f"units = {unit!r}: nothing in the result measures that; {allowed_units(units)}{remedy}")


def allowed_units(units: Iterable[str]) -> str:
    """``expected ...`` with these units."""
    shown = [written_units(unit) for unit in units if unit not in ("1", "")]
    return f"expected units of {', '.join(shown)}" if shown else "expected none, all values are dimensionless"


def alike(dataset: xr.Dataset, first: xr.Dataset) -> xr.Dataset:
    """``dataset`` in the units of ``first``, whose panels it shares: that of the same variable, else the first that fits."""
    known = {name: str(variable.attrs.get("units", "1")) for name, variable in first.variables.items()}
    changed = {}
    for name, variable in dataset.variables.items():
        units = str(variable.attrs.get("units", "1"))
        factor, unit = suitable(units, [known[name]] if name in known else known.values())
        if unit != units and variable.dtype.kind in "fc":
            changed[name] = variable.dims, variable.values * factor, {**variable.attrs, "units": unit}
    return _assigned(dataset, changed)


def _assigned(dataset: xr.Dataset, changed: Mapping[Hashable, Any]) -> xr.Dataset:
    coords = {name: variable for name, variable in changed.items() if name in dataset.coords}
    return dataset.assign({n: v for n, v in changed.items() if n not in coords}).assign_coords(coords)


def prefixed(values: Any, units: str) -> tuple[float, str]:
    """The divisor of ``values`` for a unit with a suitable prefix, and this unit.

    The prefix suits the median of the moduli without zeros and infinity, because the ends of an axis may lie decades apart.
    """
    size = np.abs(np.asarray(values, float))
    size = size[np.isfinite(size) & (size > 0)]
    if not (_PREFIXED.match(units) and size.size):
        return 1.0, units
    middle = np.median(size)
    if units == "m":
        return next((factor, prefix + units) for least, factor, prefix in _SMALL if middle >= least)
    return next((factor or 1.0, prefix + units) for factor, prefix in _PREFIXES if middle >= factor)


def with_prefixes(dataset: xr.Dataset) -> xr.Dataset:
    """``dataset`` with its axes and results in units with suitable prefixes."""
    prefixes: dict[Hashable, tuple[float, str]] = {}
    changed = {}
    for name, variable in sorted(dataset.variables.items(), key=lambda item: len(str(item[0]))):
        units = str(variable.attrs.get("units", ""))
        # A scalar coordinate belongs to the fixed parameters, whose captions choose prefixes themselves.
        wanted = variable.dtype.kind == "f" and CONVERTED not in variable.attrs and _PREFIXED.match(units)
        if not wanted or not (variable.ndim or name in dataset.data_vars):
            continue
        # One prefix for results of the same unit, which may share an axis, and for NAME, `boundary_NAME`, `tip_NAME_error`.
        axes = [axis for axis, (_, known) in prefixes.items() if f"_{axis}" in str(name) and known.endswith(units)]
        key = units if name in dataset.data_vars else (axes or [name])[-1]
        factor, written = prefixes.setdefault(key, prefixed(variable.values, units))
        changed[name] = (variable.dims, variable.values / factor, {**variable.attrs, "units": written})
    return _assigned(dataset, changed)
