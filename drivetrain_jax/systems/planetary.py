"""Planetary gear: sun, ring, carrier and N planets at arbitrary angles, each with two translations and one rotation.

Source: A. Shahabi, F. Sheykh Samani, "Vibrations of the planetary gear sets with unequally spaced planets", Modares
Mechanical Engineering 16(12), 2016, after J. Lin, R. G. Parker, J. Vib. Acoust. 121, 316-321, 1999. Equation numbers
are those of docs/theory/planetary.md, which lists where the printed equations had to be corrected.

Coordinates: [x, y, u] of carrier, ring, sun, then [xi, eta, u] of every planet; u is a rotation times the base radius,
xi points radially outwards, eta tangentially. All functions broadcast over parameters of any common shape.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax._errors import InputError, counted
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import (
    POSITIVE,
    Conversion,
    Number,
    PhysicalData,
    System,
    Values,
    numeric,
    parameter,
    serves,
)
from drivetrain_jax.systems._models import Block, DrivenSprings, SpringSystem, entries_of, stack, weighted_factor

# Springs, masses and invariant blocks of planetary gears; equation numbers are those of docs/theory/planetary.md.


BODIES = ("carrier", "ring", "sun")
_CENTRAL = 9
_PER_PLANET = 3
FAMILIES = ("rotational", "translational", "planet")
ROTATIONAL, TRANSLATIONAL, PLANET = range(3)
# Largest value of :func:`spacing` that is zero up to the rounding of the angles.
_BALANCED = 4e-16


PER_PLANET = ("m_p", "I_p", "k_sp", "k_rp", "k_p")
ERRORS = ("e_s", "e_r", "phase_s", "phase_r")

# Extensions of the springs (rows: bearing radially, tangentially, mesh with ring, with sun) per unit of the central
# coordinates, as coefficients of (1, cos psi, sin psi), times (1, cos a, sin a) of the pressure angle: (2)-(5).
_CENTRAL_PARTS = np.zeros((3, 4, _CENTRAL, 3))
_CENTRAL_PARTS[0, 0, 0, 1] = _CENTRAL_PARTS[0, 0, 1, 2] = 1.0
_CENTRAL_PARTS[0, 1, 0, 2] = -1.0
_CENTRAL_PARTS[0, 1, 1, 1] = _CENTRAL_PARTS[0, 1, 2, 0] = 1.0
for _row, _x, _sign in ((2, 3, 1.0), (3, 6, -1.0)):
    _CENTRAL_PARTS[0, _row, _x + 2, 0] = _CENTRAL_PARTS[1, _row, _x + 1, 1] = 1.0
    _CENTRAL_PARTS[1, _row, _x, 2] = -1.0
    _CENTRAL_PARTS[2, _row, _x, 1] = _CENTRAL_PARTS[2, _row, _x + 1, 2] = -_sign
# The same coefficients per unit of the coordinates of the planet itself.
_PLANET_PARTS = np.zeros((3, 4, _PER_PLANET))
_PLANET_PARTS[0, 0, 0] = _PLANET_PARTS[0, 1, 1] = _PLANET_PARTS[0, 2, 2] = -1.0
_PLANET_PARTS[0, 3, 2] = 1.0
_PLANET_PARTS[1, 2:, 1] = -1.0
_PLANET_PARTS[2, 2, 0], _PLANET_PARTS[2, 3, 0] = 1.0, -1.0


def spacing(planet_angle: Any) -> Any:
    """``c1 = |sum e^(i psi)| / N``: zero if rotation and translation are uncoupled."""
    module = np if all(isinstance(angle, (int, float)) for angle in planet_angle) else jnp
    x, y = (sum(function(angle) for angle in planet_angle) for function in (module.cos, module.sin))
    return module.hypot(x, y) / len(planet_angle)


def _lanes(*arrays: Any) -> tuple[int, ...]:
    return jnp.broadcast_shapes(*(jnp.shape(array) for array in arrays))


def _complete(values: Values) -> dict[str, Any]:
    """The numbers among ``values``, completed by derived pressure angles and bearing stiffnesses by direction."""
    numbers = {name: value for name, value in values.items() if not isinstance(value, str)}
    angles = {f"pressure_angle_{body}": numbers["pressure_angle"] for body in "rs"}
    bearings = {f"k_{body}{axis}": numbers[f"k_{body}"] for body in "crs" for axis in "xy"}
    return angles | bearings | numbers


def _spread(values: Values) -> dict[str, Any]:
    """All parameters as arrays of one common shape ``(...)``; parameters of the planets have the shape ``(N, ...)``."""
    count = len(values["planet_angle"])
    complete = _complete(values)
    entries = [entry for value in complete.values() for entry in (value if isinstance(value, tuple) else (value,))]
    shape = _lanes(*entries)

    def spread(value: Any) -> Array:
        return jnp.broadcast_to(jnp.asarray(value, float), shape)

    spread_values: dict[str, Any] = {}
    for name, value in complete.items():
        if name in PER_PLANET or name == "planet_angle":
            spread_values[name] = jnp.stack([spread(entry) for entry in entries_of(value, count)])
        else:
            spread_values[name] = spread(value)
    return spread_values


def _extensions(p: Mapping[str, Array], directions: Array) -> tuple[Array, Array]:
    """``B`` of n planets, and its part (4, 3, ...) for the own coordinates of one planet.

    The rows of ``directions`` (n, 3, ...) are (1, cos psi, sin psi) of the planets. The rows of ``B`` are the springs by
    kind, then by planet, then the bearings of the bodies.
    """
    n, lanes = directions.shape[0], directions.shape[2:]
    # Rows: two bearings of a planet, which have no pressure angle, and its meshes.
    angle, meshes = jnp.stack([p["pressure_angle_r"], p["pressure_angle_s"]]), np.array([0, 0, 0, 1])
    weights = (jnp.ones((4, *lanes)), jnp.cos(angle)[meshes], jnp.sin(angle)[meshes])
    central, of_planet = (
        sum(
            w.reshape(4, *(1,) * (part.ndim - 1), *lanes) * part[(...,) + (None,) * len(lanes)]
            for w, part in zip(weights, parts, strict=True)
        )
        for parts in (_CENTRAL_PARTS, _PLANET_PARTS)
    )
    coupling = sum(directions[None, :, None, i] * central[:, None, :, i] for i in range(3))  # pyright: ignore[reportIndexIssue]
    eye = np.eye(n).reshape(1, n, n, 1, *(1,) * len(lanes))
    planets = (eye * of_planet[:, None, None]).reshape(4 * n, _PER_PLANET * n, *lanes)  # pyright: ignore[reportIndexIssue]
    springs = jnp.concatenate([coupling.reshape(4 * n, _CENTRAL, *lanes), planets], axis=1)  # pyright: ignore[reportAttributeAccessIssue]
    bearings = np.eye(_CENTRAL, _CENTRAL + _PER_PLANET * n).reshape(_CENTRAL, -1, *(1,) * len(lanes))
    return jnp.concatenate([springs, jnp.broadcast_to(bearings, (_CENTRAL, *springs.shape[1:]))]), of_planet  # pyright: ignore[reportReturnType]


def _stiffness_and_mass(p: Mapping[str, Array], n: int) -> tuple[Array, Array]:
    """Stiffness (4n + 9, ...) and mass (9 + 3n, ...) of ``n`` planets."""
    springs = [p["k_p"][:n], p["k_p"][:n], p["k_rp"][:n], p["k_sp"][:n]]
    bearings = jnp.stack([p[f"k_{body}{kind}"] for body in "crs" for kind in "xyu"])
    bodies = jnp.stack([p[f"{kind}_{body}"] for body in "crs" for kind in ("m", "m", "I")])
    planets = jnp.stack([p["m_p"][:n], p["m_p"][:n], p["I_p"][:n]], axis=1)
    planets = planets.reshape(_PER_PLANET * n, *planets.shape[2:])
    return jnp.concatenate([*springs, bearings]), jnp.concatenate([bodies, planets])


def orthonormal_frame(columns: Array) -> tuple[Array, Array]:
    """``Q`` (n, n, ...) and ``R`` (n, k, ...) with ``columns`` (n, k, ...) = Q R, by Householder reflections.

    ``Q`` is orthonormal even if columns are dependent.
    """
    n, k = columns.shape[:2]
    frame = jnp.broadcast_to(np.eye(n).reshape(n, n, *(1,) * (columns.ndim - 2)), (n, n, *columns.shape[2:]))
    for j in range(min(n - 1, k)):
        x = columns[j:, j]
        norm = jnp.sqrt(jnp.sum(x**2, axis=0))
        v = x.at[0].add(jnp.where(x[0] < 0, -norm, norm))
        size = jnp.sum(v**2, axis=0)
        factor = jnp.where(size > 0, 2 / jnp.where(size > 0, size, 1.0), 0.0)
        columns = columns.at[j:].add(-factor * v[:, None] * jnp.sum(v[:, None] * columns[j:], axis=0))
        frame = frame.at[:, j:].add(-factor * jnp.sum(frame[:, j:] * v, axis=1)[:, None] * v)
    return frame, columns


def _families(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Family and polarisation of the central coordinates and of ``n`` frame vectors times [xi, eta, u]."""
    central = np.tile([TRANSLATIONAL, TRANSLATIONAL, ROTATIONAL], 3)
    planets = np.repeat(np.array([ROTATIONAL, TRANSLATIONAL, TRANSLATIONAL] + [PLANET] * max(n - 3, 0))[:n], 3)
    return np.concatenate([central, planets]), np.arange(_CENTRAL + _PER_PLANET * n) % 3 == 0


def _embed(frame: Array, inertia_frame: Array | None = None) -> Array:
    """The matrix (9 + 3N, 9 + 3k, ...): the identity for the central coordinates, ``frame`` (N, k, ...) for the planets."""
    n, k, lanes = frame.shape[0], frame.shape[1], frame.shape[2:]
    other = frame if inertia_frame is None else inertia_frame
    planets = jnp.zeros((n, _PER_PLANET, k, _PER_PLANET, *lanes))
    for row, part in ((0, frame), (1, frame), (2, other)):
        planets = planets.at[:, row, :, row].set(part)
    whole = jnp.zeros((_CENTRAL + _PER_PLANET * n, _CENTRAL + _PER_PLANET * k, *lanes))
    eye = np.eye(_CENTRAL).reshape(_CENTRAL, _CENTRAL, *(1,) * len(lanes))
    whole = whole.at[:_CENTRAL, :_CENTRAL].set(jnp.broadcast_to(eye, (_CENTRAL, _CENTRAL, *lanes)))
    return whole.at[_CENTRAL:, _CENTRAL:].set(planets.reshape(_PER_PLANET * n, _PER_PLANET * k, *lanes))


def identical_planets(values: Values) -> bool:
    """True if the parameters of all planets are single numbers or lists of equal numbers."""

    def alike(value: Any) -> bool:
        constant = isinstance(value, tuple) and all(isinstance(entry, (int, float)) for entry in value)
        return not isinstance(value, tuple) or (constant and len(set(value)) == 1)

    return all(alike(values[name]) for name in PER_PLANET)


def _inequality(p: Mapping[str, Array]) -> Array:
    """The largest relative difference between two planets in one parameter, 0 to 1."""
    lists = jnp.stack([p[name] for name in PER_PLANET])
    largest = jnp.max(lists, axis=1)
    return jnp.max(
        jnp.where(largest > 0, 1 - jnp.min(lists, axis=1) / jnp.where(largest > 0, largest, 1.0), 0.0), axis=0
    )


def _reduced_blocks(p: Mapping[str, Array], frame: Array, directions: Array, balanced: bool) -> tuple[Block, ...]:
    """The blocks (8)-(9) of identical planets: rotation with translation (separate if ``balanced``), and planets alone.

    The first columns of ``frame`` (N, N, ...) span {1, cos psi, sin psi}; ``directions`` (3, 3, ...) are the components of
    these three vectors in the frame.
    """
    n = frame.shape[0]
    extensions, of_planet = _extensions(p, directions)
    stiffness, mass = _stiffness_and_mass(p, 3)
    factor, basis = weighted_factor(extensions, stiffness, mass), _embed(frame[:, :3])
    family, polar = _families(3)
    # A row belongs to rotation if it is the first of its kind (spring on the mean motion), or a rotational bearing.
    rows = np.concatenate([np.arange(12) % 3 > 0, np.arange(_CENTRAL) % 3 < 2]).astype(int)
    parts = [(rows == kind, family == kind) for kind in (0, 1)] if balanced else [(rows >= 0, family >= 0)]
    blocks = [
        Block(factor[row][:, column], family[column], polar[column], basis[:, column, None]) for row, column in parts
    ]
    if n > 3:
        springs, masses = stiffness[:12:3], mass[_CENTRAL : _CENTRAL + _PER_PLANET]
        alone = jnp.stack([_embed(frame[:, i : i + 1])[:, _CENTRAL:] for i in range(3, n)], axis=2)
        kind = np.full(_PER_PLANET, PLANET)
        blocks.append(Block(weighted_factor(of_planet, springs, masses), kind, kind < 0, alone))
    return tuple(blocks)


def coordinate_names(n: int) -> tuple[str, ...]:
    """``x_c, y_c, u_c, x_r, ...`` of carrier, ring and sun, then ``xi_1, eta_1, u_1, ...`` of the planets."""
    central = tuple(f"{kind}_{body}" for body in "crs" for kind in ("x", "y", "u"))
    return central + tuple(f"{kind}_{i}" for i in range(1, n + 1) for kind in ("xi", "eta", "u"))


def _body_names(n: int) -> tuple[str, ...]:
    return (*BODIES, *(f"planet_{i + 1}" for i in range(n)))


def plane_springs(values: Values) -> SpringSystem:
    """The gear as masses and springs, eqs (1)-(7), with its decomposition (8)-(9) if all planets are alike."""
    p, n = _spread(values), len(values["planet_angle"])
    angles = p["planet_angle"]
    directions = jnp.stack([jnp.ones_like(angles), jnp.cos(angles), jnp.sin(angles)], axis=1)
    extensions, _ = _extensions(p, directions)
    stiffness, mass = _stiffness_and_mass(p, n)
    family, polar = _families(n)
    alike = identical_planets(values)
    frames = [orthonormal_frame(jnp.sqrt(p[name])[:, None] * directions)[0] for name in ("m_p", "I_p")]
    size = _CENTRAL + _PER_PLANET * n
    identity = jnp.broadcast_to(np.eye(size).reshape(size, size, *(1,) * (angles.ndim - 1)), (size, *mass.shape))
    factor = weighted_factor(extensions, stiffness, mass)
    whole = Block(factor, family, polar, identity[:, :, None], _embed(*frames))
    blocks: tuple[Block, ...] = (whole,)
    if alike and n >= 3:
        frame, triangle = orthonormal_frame(directions)
        known = all(isinstance(angle, (int, float)) for angle in values["planet_angle"])
        balanced = known and float(spacing(values["planet_angle"])) <= _BALANCED
        blocks = _reduced_blocks(p, frame, triangle[:3], balanced)
    names, bodies = coordinate_names(n), np.repeat(np.arange(3 + n), 3)
    asymmetry = jnp.maximum(spacing(tuple(angles)), _inequality(p))
    return SpringSystem(
        extensions, stiffness, mass, blocks, whole, asymmetry, names, _body_names(n), bodies, len(FAMILIES)
    )


def _rotations(p: Mapping[str, Array], directions: Array) -> Array:
    """``B`` (2n + 3, 3 + n, ...) of the rotational model, eqs (13)-(14).

    ``directions`` (n, ...) holds a factor for each planet. The rows are meshes with the ring, meshes with the sun, and
    bearings of the bodies.
    """
    n, lanes = directions.shape[0], directions.shape[1:]
    one, none = jnp.ones(lanes), jnp.zeros(lanes)
    ring, sun = (-jnp.cos(p[f"pressure_angle_{body}"]) for body in "rs")
    central = jnp.stack([jnp.stack([ring, one, none]), jnp.stack([sun, none, one])])
    coupling = (directions[None, :, None] * central[:, None]).reshape(2 * n, 3, *lanes)
    constant = np.vstack([np.hstack([np.zeros((2 * n, 3)), np.vstack([-np.eye(n), np.eye(n)])]), np.eye(3, 3 + n)])
    springs = jnp.broadcast_to(constant.reshape(*constant.shape, *(1,) * len(lanes)), (*constant.shape, *lanes))
    return springs.at[: 2 * n, :3].set(coupling)


def _rotational_blocks(p: Mapping[str, Array], stiffness: Any, mass: Any) -> tuple[Block, ...]:
    """The blocks of identical planets in the rotational model: the bodies with the mean planet, and planets alone."""
    n, lanes = p["I_p"].shape[0], p["I_p"].shape[1:]
    frame, triangle = orthonormal_frame(jnp.ones((n, 1, *lanes)))
    embedded = jnp.zeros((3 + n, 3 + n, *lanes)).at[3:, 3:].set(frame)
    embedded = embedded.at[np.arange(3), np.arange(3)].set(1.0)
    factor = weighted_factor(_rotations(p, triangle[:1, 0]), stiffness(1), mass(1))
    blocks = [Block(factor, np.full(4, ROTATIONAL), np.zeros(4, bool), embedded[:, :4, None])]
    if n > 1:
        alone = jnp.sqrt(jnp.stack([p["k_rp"][:1], p["k_sp"][:1]]) / p["I_p"][:1]) * jnp.array([-1.0, 1.0]).reshape(
            2, 1, *(1,) * len(lanes)
        )
        blocks.append(Block(alone, np.full(1, PLANET), np.zeros(1, bool), embedded[:, None, 4:]))
    return tuple(blocks)


def rotational_springs(values: Values) -> SpringSystem:
    """The gear with rotations alone, eqs (13)-(14): centres are fixed, and those of the planets move with the carrier."""
    p, n = _spread(values), len(values["planet_angle"])
    lanes = p["planet_angle"].shape[1:]

    def stiffness(count: int) -> Array:
        return jnp.concatenate([p["k_rp"][:count], p["k_sp"][:count], jnp.stack([p[f"k_{body}u"] for body in "crs"])])

    def mass(count: int) -> Array:
        bodies = jnp.stack([p["I_c"] + jnp.sum(p["m_p"], axis=0), p["I_r"], p["I_s"]])
        return jnp.concatenate([bodies, p["I_p"][:count]])

    extensions = _rotations(p, jnp.ones((n, *lanes)))
    identity = jnp.broadcast_to(np.eye(3 + n).reshape(3 + n, 3 + n, *(1,) * len(lanes)), (3 + n, 3 + n, *lanes))
    mean = orthonormal_frame(jnp.sqrt(p["I_p"])[:, None])[0]
    family = np.array([ROTATIONAL] * 4 + [PLANET] * (n - 1))
    k, m = stiffness(n), mass(n)
    factor = weighted_factor(extensions, k, m)
    whole = Block(factor, family, np.zeros(3 + n, bool), identity[:, :, None], identity.at[3:, 3:].set(mean))
    blocks = _rotational_blocks(p, stiffness, mass) if identical_planets(values) else (whole,)
    names = (*(f"u_{body}" for body in "crs"), *(f"u_{i + 1}" for i in range(n)))
    return SpringSystem(
        extensions, k, m, blocks, whole, _inequality(p), names, _body_names(n), np.arange(3 + n), len(FAMILIES)
    )


def driven_springs(values: Values, springs: SpringSystem) -> DrivenSprings:
    """The gear ``springs`` with transmission errors of its meshes and torques on its bodies, eq (15)."""
    n, names = len(values["planet_angle"]), springs.dofs
    excitations = [stack(entries_of(values[name], n)) for name in ERRORS] + [
        jnp.asarray(values[f"T_{body}"]) for body in "crs"
    ]
    lanes = _lanes(springs.mass[0], *(x[0] for x in excitations[: len(ERRORS)]), *excitations[len(ERRORS) :])

    def spread(array: Array, axes: int) -> Array:
        """``array`` in the shape of the lanes, with its ``axes`` axes first."""
        missing = (1,) * (len(lanes) - array.ndim + axes)
        return jnp.broadcast_to(
            array.reshape(array.shape[:axes] + missing + array.shape[axes:]), array.shape[:axes] + lanes
        )

    sun, ring, sun_phase, ring_phase = (spread(x, 1) for x in excitations[: len(ERRORS)])
    errors = jnp.concatenate([ring * jnp.exp(1j * ring_phase), sun * jnp.exp(1j * sun_phase)])
    # Order of the springs: meshes with the ring, meshes with the sun, bearings of the bodies.
    end = springs.stiffness.shape[0] - (_CENTRAL if len(names) > 3 + n else 3)
    meshes = slice(end - 2 * n, end)
    forces = spread(springs.stiffness[meshes], 1) * errors
    force = jnp.sum(spread(springs.extensions[meshes], 2) * forces[:, None], axis=0)
    for body, torque in zip("crs", excitations[len(ERRORS) :], strict=True):
        force = force.at[names.index(f"u_{body}")].add(spread(torque, 0))
    return DrivenSprings(springs, force)


# Numbers of teeth of a planetary gear and what follows from them, see docs/systems/planetary.md.


def _teeth(teeth: tuple[float, ...]) -> tuple[float, ...]:
    if len(teeth) != 3 or not teeth[0] + teeth[1] < teeth[2]:
        raise InputError(f"teeth = {list(teeth)}: expected those of sun, planet and ring, with sun + planet < ring")
    return teeth


def _phase(angle: Any) -> Any:
    xp, angle = numeric(angle)
    return angle - 2 * math.pi * xp.round(angle / (2 * math.pi))


PHYSICAL = PhysicalData(
    (
        Parameter("teeth", "1", "teeth of sun, planet and ring", lower=1.0, listed=True, integer=True),
        Parameter("carrier_order", "1", "tooth meshes per turn of the carrier, ring held", **POSITIVE),
        Parameter("sun_order", "1", "tooth meshes per turn of the sun, ring held", **POSITIVE),
    ),
    (
        Conversion("carrier_order", ("teeth",), lambda z: _teeth(z)[2], "teeth[2]", whole=("teeth",)),
        Conversion(
            "sun_order",
            ("teeth",),
            lambda z: z[0] * z[2] / (z[0] + z[2]),
            "teeth[0] teeth[2]/(teeth[0] + teeth[2])",
            whole=("teeth",),
        ),
        Conversion(
            "phase_s",
            ("teeth", "planet_angle"),
            lambda z, angle: _phase(-z[0] * angle),
            "-teeth[0] planet_angle",
            optional=True,
            whole=("teeth",),
        ),
        Conversion(
            "phase_r",
            ("teeth", "planet_angle"),
            lambda z, angle: _phase(z[2] * angle),
            "teeth[2] planet_angle",
            optional=True,
            whole=("teeth",),
        ),
    ),
)


def _check_apart(angles: Any) -> list[float]:
    """The differences of concrete ``angles`` of planets; :class:`~drivetrain_jax.InputError` if three or more are equal."""
    if not isinstance(angles, tuple) or not all(isinstance(angle, (int, float)) for angle in angles):
        return []
    apart = [math.remainder(a - b, 2 * math.pi) for i, a in enumerate(angles) for b in angles[:i]]
    if len(angles) > 2 and all(abs(gap) < 1e-9 for gap in apart):
        raise InputError(f"planet_angle = {list(angles)}: all planets are in one place; expected different angles")
    return apart


def check(fixed: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` unless all lists have the same length, one entry per planet; warn of planets in one place."""
    angles = fixed.get("planet_angle")
    if any(abs(gap) < 1e-9 for gap in _check_apart(angles)):
        warnings.warn(f"planet_angle = {list(angles or ())}: several planets are in one place", stacklevel=2)
    for name in (*PER_PLANET, *ERRORS):
        value = fixed.get(name)
        if isinstance(value, tuple) and angles is not None and len(value) != len(angles):
            raise ValueError(
                f"{name} = {list(value)}: {counted(len(value), 'entry', 'entries')} where planet_angle has {len(angles)}; "
                "expected one number, or one entry per planet"
            )


def _mass(long_name: str, default: float, **more: Any) -> Any:
    return parameter("kg", long_name, default=default, **POSITIVE, **more)


def _stiffness(long_name: str, default: float | None, **more: Any) -> Any:
    return parameter("N/m", long_name, default=default, lower=0.0, **more)


def _pressure_angle(long_name: str, **more: Any) -> Any:
    limit = {"lower": -math.pi / 2, "upper": math.pi / 2, "open_lower": True, "open_upper": True}
    return parameter("rad", long_name, **limit, **more)


def _error(units: str, long_name: str, default: float) -> Any:
    return parameter(units, long_name, default=default, **_EACH)


# Largest angle, two turns: larger numbers are probably degrees.
_LARGEST_ANGLE = 4 * math.pi
_EACH = {"listed": True, "broadcast": True}
Numbers = tuple[Number, ...]
# Parameters of masses and springs; all others are excitations.
_OF_SPRINGS = (
    "planet_angle", *PER_PLANET, *(f"{kind}_{body}" for kind in ("m", "I", "k") for body in "src"),
    *(f"k_{body}{axis}" for body in "src" for axis in "uxy"), "pressure_angle", "pressure_angle_s", "pressure_angle_r",
    "model",
)  # fmt: skip


class Planetary(System):
    """The gear of the module's docstring; a parameter of planets is one number for all, or a list with one per planet.

    >>> import jax.numpy as jnp
    >>> from drivetrain_jax import Planetary
    >>> Planetary().springs().mass.shape
    (21,)
    >>> print(Planetary().vector_field(0.0, jnp.zeros(42)).shape)
    (42,)
    """

    name = "planetary"
    title = "Planetary gear"
    source = "A. Shahabi, F. Sheykh Samani, Modares Mechanical Engineering 16(12), 2016"
    roles = MappingProxyType({"planets": "planet_angle"})
    mode_families = FAMILIES
    physical = PHYSICAL

    planet_angle: Numbers = parameter(
        "rad",
        "angle of the planet",
        symbol="ψ",
        default=tuple(i * math.pi / 2 for i in range(4)),
        lower=-_LARGEST_ANGLE,
        upper=_LARGEST_ANGLE,
        listed=True,
    )
    m_s: Number = _mass("mass of the sun", 0.4)
    m_r: Number = _mass("mass of the ring", 2.35)
    m_c: Number = _mass("mass of the carrier", 5.43)
    m_p: Numbers | Number = _mass("mass of a planet", 0.66, **_EACH)
    I_s: Number = _mass("inertia of the sun over its base radius squared", 0.39)
    I_r: Number = _mass("inertia of the ring over its base radius squared", 3.0)
    I_c: Number = _mass("inertia of the carrier over its radius squared", 6.29)
    I_p: Numbers | Number = _mass("inertia of a planet over its base radius squared", 0.61, **_EACH)
    k_sp: Numbers | Number = _stiffness("mesh stiffness between sun and planet", 5e8, **_EACH)
    k_rp: Numbers | Number = _stiffness("mesh stiffness between ring and planet", 5e8, **_EACH)
    k_p: Numbers | Number = _stiffness("bearing stiffness of a planet", 1e8, **_EACH)
    k_s: Number = _stiffness("bearing stiffness of the sun", 1e8)
    k_r: Number = _stiffness("bearing stiffness of the ring", 1e8)
    k_c: Number = _stiffness("bearing stiffness of the carrier", 1e8)
    k_su: Number = _stiffness("rotational stiffness of the sun's bearing", 0.0)
    k_ru: Number = _stiffness("rotational stiffness of the ring's bearing", 1e9)
    k_cu: Number = _stiffness("rotational stiffness of the carrier's bearing", 0.0)
    pressure_angle: Number = _pressure_angle("pressure angle of both meshes", symbol="α", default=math.radians(24.6))
    pressure_angle_s: Number | None = _pressure_angle("pressure angle of the sun's meshes", derived="pressure_angle")
    pressure_angle_r: Number | None = _pressure_angle("pressure angle of the ring's meshes", derived="pressure_angle")
    k_sx: Number | None = _stiffness("bearing stiffness of the sun along x", None, derived="k_s")
    k_sy: Number | None = _stiffness("bearing stiffness of the sun along y", None, derived="k_s")
    k_rx: Number | None = _stiffness("bearing stiffness of the ring along x", None, derived="k_r")
    k_ry: Number | None = _stiffness("bearing stiffness of the ring along y", None, derived="k_r")
    k_cx: Number | None = _stiffness("bearing stiffness of the carrier along x", None, derived="k_c")
    k_cy: Number | None = _stiffness("bearing stiffness of the carrier along y", None, derived="k_c")
    model: str = parameter(
        "1", "degrees of freedom: plane motion, or rotations alone", default="plane", choices=("plane", "rotational")
    )

    e_s: Numbers | Number = _error("m", "transmission error of a mesh with the sun", 1e-6)
    e_r: Numbers | Number = _error("m", "transmission error of a mesh with the ring", 0.0)
    phase_s: Numbers | Number = _error("rad", "phase of the error of a mesh with the sun", 0.0)
    phase_r: Numbers | Number = _error("rad", "phase of the error of a mesh with the ring", 0.0)
    T_s: Number = parameter("N", "torque on the sun over its base radius", default=0.0)
    T_r: Number = parameter("N", "torque on the ring over its base radius", default=0.0)
    T_c: Number = parameter("N", "torque on the carrier over its radius", default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_apart(self.planet_angle)

    @serves("modes", check=check, parameters=_OF_SPRINGS)
    def springs(self) -> SpringSystem:
        """The gear as masses and springs, with its decomposition into invariant blocks if all planets are alike."""
        build = rotational_springs if self.model == "rotational" else plane_springs
        return build({name: value for name, value in self.values.items() if name in _OF_SPRINGS})

    @serves("harmonic_response", check=check)
    def driven(self) -> DrivenSprings:
        """The gear under harmonic transmission errors of its meshes and torques on its bodies."""
        return driven_springs(self.values, self.springs())

    def vector_field(self, t: Any, y: Array) -> Array:
        """``(q', q'')`` of ``y = (q, q')``, shape ``(2 dofs, ...)``: the free motion (1), the same at all times ``t``.

        Errors and torques are left out: their frequency belongs to ``harmonic_response`` and not to the gear.
        """
        springs, (q, rate) = self.springs(), jnp.split(jnp.asarray(y), 2)
        pulls = springs.stiffness * jnp.sum(springs.extensions * q, axis=1)
        forces = jnp.sum(springs.extensions * pulls[:, None], axis=0)
        return jnp.concatenate([rate, -forces / springs.mass])
