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
from jax import Array

from drivetrain_jax._wording import counted
from drivetrain_jax.systems._base import Number, System, parameter, serves
from drivetrain_jax.systems._modal import DrivenSprings, SpringSystem
from drivetrain_jax.systems._planetary_springs import (
    ERRORS,
    FAMILIES,
    PER_PLANET,
    driven_springs,
    plane_springs,
    rotational_springs,
)
from drivetrain_jax.systems.planetary_units import PHYSICAL


def check(fixed: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` unless all lists have the same length, one entry per planet; warn of planets in one place."""
    angles = fixed.get("planet_angle")
    if angles is not None and all(isinstance(angle, (int, float)) for angle in angles):
        apart = [math.remainder(a - b, 2 * math.pi) for i, a in enumerate(angles) for b in angles[:i]]
        if any(abs(gap) < 1e-9 for gap in apart):
            warnings.warn(f"planet_angle = {list(angles)}: several planets are in one place", stacklevel=2)
    for name in (*PER_PLANET, *ERRORS):
        value = fixed.get(name)
        if isinstance(value, tuple) and angles is not None and len(value) != len(angles):
            raise ValueError(
                f"{name} = {list(value)}: {counted(len(value), 'entry', 'entries')} where planet_angle has {len(angles)}; "
                "allowed is one number, or one entry per planet"
            )


def _mass(long_name: str, default: float, **more: Any) -> Any:
    return parameter("kg", long_name, default=default, lower=0.0, open_lower=True, **more)


def _stiffness(long_name: str, default: float | None, **more: Any) -> Any:
    return parameter("N/m", long_name, default=default, lower=0.0, **more)


def _pressure_angle(long_name: str, **more: Any) -> Any:
    limit = {"lower": -math.pi / 2, "upper": math.pi / 2, "open_lower": True, "open_upper": True}
    return parameter("rad", long_name, **limit, **more)


def _error(units: str, long_name: str, default: float) -> Any:
    return parameter(units, f"{long_name}", default=default, listed=True, broadcast=True)


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
        del t
        springs, (q, rate) = self.springs(), jnp.split(jnp.asarray(y), 2)
        pulls = springs.stiffness * jnp.sum(springs.extensions * q, axis=1)
        forces = jnp.sum(springs.extensions * pulls[:, None], axis=0)
        return jnp.concatenate([rate, -forces / springs.mass])
