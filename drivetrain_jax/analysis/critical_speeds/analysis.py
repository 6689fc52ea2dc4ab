"""Critical speeds: natural frequencies of the lateral vibration of a shaft, certified by a count.

The synchronous critical speed of a shaft whose gyroscopic effect is neglected is its natural frequency, ``n = 30 p/pi``
rpm. With an ``order`` the inertias include the gyroscopic effect at the speed ``p/|order|``. The method ``certified``
(default, :mod:`~drivetrain_jax.analysis.critical_speeds.frequency_roots`) has full accuracy for any mode. The method
``krylov_determinant`` is the paper's and loses all digits near mode 12; ``count_certified`` marks its roots with the right
number.

Modes are numbered by frequency and not followed along an axis. The frequencies of a shaft in one plane between separated
ends are simple (except with a hinge on, or almost on, a rigid support, or by coincidence), so curves of equal number do not
cross. Shapes of a multiple frequency are orthogonal in the mass.

A shaft without mass in its segments has as many frequencies as masses and inertias; further ones are infinite.

Outcome: ``NOT_FINITE`` if parameters give no finite equations (also if a part moves freely and has no mass),
``NOT_CONVERGED`` if a frequency was not found (NaN),
``TOLERANCE_NOT_MET`` if a root of ``krylov_determinant`` is not certified.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Dimension, Parameter, Variable, count
from drivetrain_jax.analysis._base import Analysis, Outcome, Request, Solver
from drivetrain_jax.analysis.critical_speeds import frequency_roots as shaft_roots
from drivetrain_jax.analysis.critical_speeds.frequency_roots import Roots, frequency_derivatives
from drivetrain_jax.analysis.critical_speeds.mechanisms import is_undefined, mechanism_shapes, zero_modes
from drivetrain_jax.analysis.critical_speeds.shapes import mode_shapes, normalised
from drivetrain_jax.analysis.numerics.lanes import Constants
from drivetrain_jax.systems import Shaft, System

# Amplification factor below which a critical speed counts as critically damped (API 617, API 684).
_DAMPED = 2.5
# Factor of the formula, largest margin of a speed below the range, and the addition for a speed above it.
_FACTOR, _LARGEST, _ABOVE = 0.17, 0.16, 0.1


def separation_margin(speed: Any, lowest: float, highest: float) -> Array:
    """Distance of ``speed`` from the operating range [lowest, highest] over its nearer end; 0 within.

    A critical speed below gives ``(lowest - n)/lowest``, one above ``(n - highest)/highest`` (as in API 617).
    """
    speed = jnp.asarray(speed, float)
    below = (lowest - speed) / (lowest if lowest > 0 else 1.0)
    return jnp.maximum(jnp.maximum(below, (speed - highest) / highest), 0.0)


def required_margin(speed: Any, lowest: float, amplification: Any) -> Array:
    """The margin that API 617 requires of a critical ``speed`` with this ``amplification`` factor AF.

    ``17 (1 - 1/(AF - 1.5))`` percent, at most 16, below the operating range; 10 more within and above it; none for AF < 2.5.
    Models of this package have no damping; a factor comes from a measurement or a damped model.

    >>> print(required_margin([1000.0, 9000.0], lowest=3000.0, amplification=10.0))
    [0.15 0.25]
    """
    factor, above = jnp.asarray(amplification, float), jnp.asarray(speed, float) >= lowest
    below = jnp.minimum(_FACTOR * (1 - 1 / jnp.maximum(factor - 1.5, 1.0)), _LARGEST)
    return jnp.where(factor < _DAMPED, 0.0, below + jnp.where(above, _ABOVE, 0.0))


VARIABLES = (
    Variable("natural_frequency", "Hz", "natural frequency", ("mode",)),
    Variable("angular_frequency", "rad/s", "natural angular frequency", ("mode",)),
    Variable("critical_speed", "rpm", "critical speed", ("mode",)),
    Variable("relative_error", "1", "estimated relative error of the frequencies", ("mode",)),
    Variable(
        "count_certified", "1", "whether the count of frequencies below and above certifies the mode", ("mode",), "int8"
    ),
    Variable(
        "separation_margin", "1", "distance of the critical speed from the operating speeds, over them", ("mode",)
    ),
    Variable("required_margin", "1", "separation margin that API 617 requires for the amplification factor", ("mode",)),
    Variable("mode_shape", "1", "deflection of the mode, largest +1", ("mode", "x")),
)
_ORDER = "order of the excitation, < 0: backward (0: at rest, in the first plane)"
_AMPLIFICATION = "amplification factor at the critical speeds (inf: undamped)"
OPTIONS = (
    count("modes", "number of modes, zero modes included", default=6, lower=1, upper=1000),
    count("stations", "number of points of a mode shape", default=101, lower=2, upper=10001),
    count("order", _ORDER, default=0, lower=-100, upper=100),
    Parameter("operating_min", "rpm", "lowest operating speed", default=0.0, lower=0.0),
    Parameter("operating_max", "rpm", "highest operating speed (0: not given)", default=0.0, lower=0.0),
    Parameter("amplification", "1", _AMPLIFICATION, default=math.inf, lower=1.0, infinite=True),
)
_OPTION_NAMES = tuple(option.name for option in OPTIONS)
# Per rad/s.
_UNITS = {"angular_frequency": 1.0, "natural_frequency": 1 / (2 * math.pi), "critical_speed": 30 / math.pi}
# Parameters that the paper's method does not include.
_ADDITIONS = (
    *("k_joint", "m_A", "m_D", "m_joint", "k_hinge", "kGA", "rhoI"),
    *("k_rot_A", "k_rot_D", "I_A", "I_D", "I_joint"),
)
# Roots of all modes of a chunk together, small enough for the cache.
_ROOTS_PER_CHUNK = 12288
_STATIONS_PER_CHUNK = 1 << 18

Build = Callable[[Mapping[str, Any]], Shaft]


def _dimensions(system: type[System], request: Request, fixed: Mapping[str, Any]) -> tuple[Dimension, ...]:
    options = request.options
    lacking = [name for name in ("relative_error", "mode_shape") if name in request.outputs]
    planes = any(fixed.get(f"k_{place}_y") is not None for place in ("A", "D", "joint"))
    if lacking and planes and options.get("order", 0):
        raise InputError(f"outputs: {lacking[0]!r} is not computed for two planes; expected order = 0")
    if request.method == "krylov_determinant":
        for name in (name for name in _ADDITIONS if name in {p.name for p in system.parameters}):
            if fixed.get(name) != system.parameter(name).default:
                written = f"fixed.{name} = {fixed[name]}" if name in fixed else name
                allowed = "expected the method certified"
                raise InputError(f"{written}: not in the equations of krylov_determinant; {allowed}")
        if 0.0 in np.ravel(fixed.get("rhoA", ())):
            raise InputError("fixed.rhoA: krylov_determinant needs mass in every segment; expected rhoA[i] > 0")
    low, high = options["operating_min"], options["operating_max"]
    margins = [name for name in ("separation_margin", "required_margin") if name in request.outputs]
    if high < low or (high == 0 and margins):
        wanted = f"expected for {margins[0] if margins else 'the operating speeds'} a speed > 0"
        raise InputError(f"options.operating_max = {high:g}: {wanted}, at least operating_min = {low:g}")
    dimensions = [Dimension("mode", "number of the mode", tuple(range(1, options["modes"] + 1)))]
    if "mode_shape" in request.outputs:
        x = tuple(float(value) for value in np.linspace(0.0, 1.0, options["stations"]))
        dimensions.append(Dimension("x", "distance from A over the length of the shaft", x))
    return tuple(dimensions)


def _shapes(shaft: Shaft, roots: Roots, stations: int) -> Array:
    """Shapes of zero modes and of the others; NaN for missing frequencies, 0 for infinite ones."""
    modes, lanes = roots.q.shape[0], roots.q.shape[1:]
    x = jnp.linspace(0.0, 1.0, stations)
    finite = jnp.isfinite(roots.q)
    index = jnp.arange(modes).reshape(modes, *(1,) * len(lanes))
    # Different numbers in place of the others: equal ones would be a cluster.
    elastic = mode_shapes(shaft, jnp.where(finite & (roots.q > 0), roots.q, 1.0 + index), x)
    elastic = jnp.where(jnp.isinf(roots.q)[:, None], 0.0, elastic)
    mechanisms = mechanism_shapes(shaft, x)
    row = jnp.broadcast_to(jnp.minimum(index, len(mechanisms) - 1), (modes, *lanes))
    rigid = normalised(jnp.take_along_axis(mechanisms, row[:, None], axis=0))
    shape = jnp.where((index < zero_modes(shaft))[:, None], rigid, elastic)
    return jnp.where(jnp.isnan(roots.q)[:, None], jnp.nan, shape)


def _at_order(shaft: Shaft, order: int) -> Shaft:
    """The shaft whose natural frequencies are those of the critical speeds of ``order``; 0: at rest."""
    if order == 0:
        return shaft._replace(polar=None, rhoIp=None, spin=None, k_y=None)
    if shaft.spin is not None:
        shaft = shaft._replace(spin=jnp.stack([0.0 * shaft.spin[0], 0.0 * shaft.spin[1] + 1 / order]))
    if shaft.k_y is not None:
        return shaft
    return shaft.turning(jnp.ones(shaft.lanes))._replace(polar=None, rhoIp=None)


def _units(options: Mapping[str, Any]) -> dict[str, float]:
    """Units of the frequencies; a shaft of the critical speed turns once in ``order`` vibrations."""
    return _UNITS | {"critical_speed": _UNITS["critical_speed"] / max(abs(options.get("order", 0)), 1)}


def outcomes(shaft: Shaft, roots: Roots) -> Array:
    """Outcome of every lane."""
    finite = jnp.all(jnp.isfinite(shaft.length) & jnp.isfinite(shaft.EI) & jnp.isfinite(shaft.rhoA), axis=0)
    missing, doubtful = jnp.any(jnp.isnan(roots.q), axis=0), ~jnp.all(roots.certified, axis=0)
    outcome = jnp.where(missing, Outcome.NOT_CONVERGED, jnp.where(doubtful, Outcome.TOLERANCE_NOT_MET, Outcome.SUCCESS))
    return jnp.where(finite & ~is_undefined(shaft), outcome, Outcome.NOT_FINITE).astype(jnp.int8)


def _solve(build: Build, request: Request, values: Mapping[str, Any], effort: Array) -> dict[str, Array]:
    options = request.options
    shaft = _at_order(build(values), options.get("order", 0))
    certified = request.method == "certified"
    roots = (shaft_roots.find_roots if certified else shaft_roots.krylov_roots)(shaft, options["modes"])
    p = roots.q**2
    results = {name: p * unit for name, unit in _units(options).items()}
    results |= {"count_certified": roots.certified.astype(jnp.int8), "outcome": outcomes(shaft, roots)}
    if "relative_error" in request.outputs:
        results["relative_error"] = shaft_roots.relative_error(shaft, roots)
    if "separation_margin" in request.outputs:
        low, high = options["operating_min"], options["operating_max"]
        results["separation_margin"] = separation_margin(results["critical_speed"], low, high)
    if "required_margin" in request.outputs:
        low, factor = options["operating_min"], options["amplification"]
        results["required_margin"] = required_margin(results["critical_speed"], low, factor)
    if "mode_shape" in request.outputs:
        results["mode_shape"] = _shapes(shaft, roots, options["stations"])
    return {name: results[name] for name in (*request.outputs, "outcome")}


def _solvers(system: type[System], request: Request) -> tuple[Solver, ...]:
    build = system.models["critical_speeds"].build
    modes = request.options["modes"]
    room = _ROOTS_PER_CHUNK // modes
    if "mode_shape" in request.outputs:
        room = min(room, _STATIONS_PER_CHUNK // (modes * request.options["stations"]))
    chunk = 1 << max(min(room, 2048), 16).bit_length() - 1
    solve = partial(_solve, build, request)
    return (Solver(request.method, solve, seconds=2e-5, chunk=chunk),)


def _derivatives(
    system: type[System], request: Request, parameters: Any, constants: Constants, results: Mapping[str, Array]
) -> dict[str, Array]:
    """Jacobians of all frequencies and of the separation margin."""
    options, units = request.options, _units(request.options)

    def build(parameters: Any) -> Shaft:
        shaft = system.models["critical_speeds"].build(eqx.combine(parameters, constants.tree))
        return _at_order(shaft, options.get("order", 0))

    known = [results[name] / unit for name, unit in units.items() if name in results and request.method == "certified"]
    q = jnp.sqrt(known[0]) if known else shaft_roots.find_roots(build(parameters), options["modes"]).q
    slope = frequency_derivatives(build, parameters, q)
    jacobians = {name: slope * unit for name, unit in units.items()}
    if "separation_margin" in results:
        low, high = options["operating_min"], options["operating_max"]
        margin = jax.vmap(jax.grad(lambda speed: separation_margin(speed, low, high)))
        jacobians["separation_margin"] = margin(q**2 * units["critical_speed"])[:, None] * jacobians["critical_speed"]
    return jacobians


ANALYSIS = Analysis(
    name="critical_speeds",
    title="critical speeds",
    variables=VARIABLES,
    default_outputs=("natural_frequency", "critical_speed", "count_certified"),
    methods={
        "certified": _OPTION_NAMES,
        "krylov_determinant": tuple(name for name in _OPTION_NAMES if name != "order"),
    },
    method_titles={
        "certified": "roots counted, at full accuracy for any mode",
        "krylov_determinant": "the plain determinant, as published: it loses roots near mode 12",
    },
    options=OPTIONS,
    solvers=_solvers,
    dimensions=_dimensions,
    derivatives=_derivatives,
)
