"""Bicardanic shaft: lateral vibration of a stepped shaft on elastic supports.

Source: I. Bulac, "Vibrations of the bicardanic transmissions with elastic supports", Fiabilitate si Durabilitate,
Supplement 1/2012. Equation numbers are those of docs/theory/bicardan.md, which lists the printed errors.

The paper's model is a Bernoulli-Euler shaft in segments with springs k_A, k_D at its ends. Supports, masses and rotary
inertias at the joints, joints with finite rotational stiffness, masses, rotary inertias and rotational springs at the
ends, shear and rotary inertia of the segments are additions; their defaults mean "none". A segment may have no mass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from drivetrain_jax._errors import counted
from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems._base import POSITIVE, Conversion, Number, PhysicalData, System, numeric, parameter, serves
from drivetrain_jax.systems._models import Shaft, entries_of, stack
from drivetrain_jax.systems._tubes import MATERIALS, ring_power

# Physical data of a bicardanic shaft and the parameters of ``bicardan``, see docs/systems/bicardan.md.


def _area(outer: Any, inner: Any) -> Any:
    return math.pi / 4 * ring_power(outer, inner, 2)


def shear_coefficient(outer: Any, inner: Any, e: Any, g: Any) -> Any:
    """Cowper's coefficient of a hollow circle, J. Appl. Mech. 33 (1966), 335-340."""
    _, outer, inner, e, g = numeric(outer, inner, e, g)
    nu, m2 = e / (2 * g) - 1, (inner / outer) ** 2
    round_part = (1 + m2) ** 2
    return 6 * (1 + nu) * round_part / ((7 + 6 * nu) * round_part + (20 + 12 * nu) * m2)


def _shear_stiffness(outer: Any, inner: Any, e: Any, g: Any) -> Any:
    return shear_coefficient(outer, inner, e, g) * g * _area(outer, inner)


_EACH: dict[str, Any] = {"listed": True, "broadcast": True}
_SECTION = ("outer_diameter", "inner_diameter")

PHYSICAL = PhysicalData(
    (
        Parameter("outer_diameter", "m", "outer diameters of the segments", usual=10.0, **POSITIVE, **_EACH),
        Parameter("inner_diameter", "m", "bores of the segments", default=0.0, usual=10.0, lower=0.0, **_EACH),
        Parameter("material", "1", "material of all segments: E, G, density", choices=tuple(MATERIALS)),
        Parameter("E", "Pa", "Young's modulus of the segments", **POSITIVE, **_EACH),
        Parameter("G", "Pa", "shear modulus of the segments; without it no shear", **POSITIVE, **_EACH),
        Parameter("density", "kg/m3", "density of the segments, 0: without mass", lower=0.0, **_EACH),
    ),
    (
        Conversion("E", ("material",), lambda name: MATERIALS[name][0], "that of the material", optional=True),
        Conversion("G", ("material",), lambda name: MATERIALS[name][1], "that of the material", optional=True),
        Conversion("density", ("material",), lambda name: MATERIALS[name][2], "that of the material", optional=True),
        Conversion(
            "EI",
            (*_SECTION, "E"),
            lambda outer, inner, e: e * (math.pi / 64 * ring_power(outer, inner, 4)),
            "pi/64 E (outer_diameter^4 - inner_diameter^4)",
            per="length",
        ),
        Conversion(
            "rhoA",
            (*_SECTION, "density"),
            lambda outer, inner, density: density * _area(outer, inner),
            "pi/4 density (outer_diameter^2 - inner_diameter^2)",
            replaceable=True,
            per="length",
        ),
        Conversion(
            "kGA",
            (*_SECTION, "E", "G"),
            _shear_stiffness,
            "pi/4 kappa G (outer_diameter^2 - inner_diameter^2)",
            optional=True,
            per="length",
        ),
        Conversion(
            "rhoI",
            (*_SECTION, "rhoA", "G"),
            lambda outer, inner, rhoA, g: rhoA * (outer**2 + inner**2) / 16,
            "rhoA (outer_diameter^2 + inner_diameter^2)/16",
            optional=True,
        ),
        Conversion(
            "rhoIp",
            (*_SECTION, "rhoA", "G"),
            lambda outer, inner, rhoA, g: rhoA * (outer**2 + inner**2) / 8,
            "rhoA (outer_diameter^2 + inner_diameter^2)/8",
            optional=True,
        ),
    ),
)


_PER_SEGMENT = ("EI", "rhoA", "kGA", "rhoI", "rhoIp")
_PER_JOINT = ("k_joint", "m_joint", "k_hinge", "I_joint", "Ip_joint", "k_joint_y")

_SUPPORTS = {"k_A": 85e6, "k_D": 20e6}
_REAL = {"length": (0.07, 0.59, 0.25), "rhoA": (15.288, 2.808, 5.5068), **_SUPPORTS}
_E = 2.1e11
PRESETS = {
    "paper": _REAL | {"EI": tuple(_E * math.pi / 64 * x for x in (50e-3**4, 50e-3**4 - 45e-3**4, 30e-3**4))},
    # I = 3.06e-7, 1.055e-7, 3.97e-8 m4 with the printed areas; the solid bar has its exact area, 19.635e-4 m2.
    "paper_fitted": _REAL | {"EI": (64260.0, 22155.0, 8337.0)},
    "paper_solid": {"length": (0.3,) * 3, "EI": (64260.0,) * 3, "rhoA": (15.3153,) * 3, **_SUPPORTS},
    "paper_tube": {"length": (0.3,) * 3, "EI": (22155.0,) * 3, "rhoA": (2.808,) * 3, **_SUPPORTS},
}


def check(fixed: Mapping[str, Any]) -> None:
    """``ValueError`` unless the lists have one entry per segment or joint, and only segments with mass rotary inertia."""
    segments = len(fixed["length"])
    for names, needed, what in ((_PER_SEGMENT, segments, "segment"), (_PER_JOINT, segments - 1, "joint")):
        for name in names:
            value = fixed.get(name, ())
            if isinstance(value, tuple) and value != () and len(value) != needed:
                raise ValueError(
                    f"{name} = {list(value)}: {counted(len(value), 'entry', 'entries')} where length has {segments}; "
                    f"expected one per {what}, {needed}"
                )
    mass = entries_of(fixed.get("rhoA", ()), segments, 1.0)
    for name in ("rhoI", "rhoIp"):
        for i, pair in enumerate(zip(mass, entries_of(fixed.get(name, ()), segments), strict=True)):
            # Traced values are not checked.
            if all(isinstance(x, (int, float)) for x in pair) and pair[0] == 0 < pair[1]:
                raise ValueError(f"{name}[{i}] = {pair[1]:g}: expected 0 for a segment without mass (rhoA[{i}] = 0)")


# Stiffnesses [N m2] and masses per length [kg/m] beyond this range may overflow or underflow on the way to frequencies.
_RANGE = {"listed": True, "lower": 1e-60, "upper": 1e60}
_LIST = {"listed": True, "lower": 0.0}
_NONE = {"default": (), "broadcast": True, **_LIST}
Numbers = tuple[Number, ...]


class Bicardan(System):
    """The stepped shaft of the module's docstring: segments from A to D, joints between them.

    It has no ``vector_field``: the shaft is a continuum, whose modes are exact and not those of an ODE.

    >>> from drivetrain_jax import Bicardan
    >>> Bicardan(**Bicardan.presets["paper"]).shaft().segments
    3
    """

    name = "bicardan"
    title = "Bicardanic shaft on elastic supports"
    source = "Bulac, Fiabilitate si Durabilitate, Supplement 1/2012"
    presets = PRESETS
    physical = PHYSICAL

    length: Numbers = parameter(
        "m", "lengths of the segments, from A to D", usual=100.0, listed=True, lower=1e-30, upper=1e30
    )
    EI: Numbers = parameter("N m2", "bending stiffness of the segments", **_RANGE)
    rhoA: Numbers = parameter(
        "kg/m", "mass per length of the segments, 0: without mass", symbol="ρA", or_zero=True, **_RANGE
    )
    k_A: Number = parameter("N/m", "stiffness of the support at A", lower=0.0, infinite=True)
    k_D: Number = parameter("N/m", "stiffness of the support at D", lower=0.0, infinite=True)
    k_joint: Numbers | Number = parameter(
        "N/m", "stiffness of supports at the joints between segments", infinite=True, **_NONE
    )
    m_A: Number = parameter("kg", "lumped mass at A", default=0.0, lower=0.0)
    m_D: Number = parameter("kg", "lumped mass at D", default=0.0, lower=0.0)
    m_joint: Numbers | Number = parameter("kg", "lumped masses (yokes) at the joints between segments", **_NONE)
    k_hinge: Numbers | Number = parameter(
        "N m/rad", "rotational stiffness of the joints, inf: rigid", infinite=True, **_NONE
    )
    kGA: Numbers | Number = parameter(
        "N", "shear stiffness of the segments, inf: no shear", open_lower=True, infinite=True, **_NONE
    )
    rhoI: Numbers | Number = parameter("kg m", "rotary inertia per length of the segments", symbol="ρI", **_NONE)
    k_rot_A: Number = parameter("N m/rad", "rotational stiffness to ground at A", default=0.0, lower=0.0, infinite=True)
    k_rot_D: Number = parameter("N m/rad", "rotational stiffness to ground at D", default=0.0, lower=0.0, infinite=True)
    I_A: Number = parameter("kg m2", "rotary inertia of a disc or yoke at A", default=0.0, lower=0.0)
    I_D: Number = parameter("kg m2", "rotary inertia of a disc or yoke at D", default=0.0, lower=0.0)
    I_joint: Numbers | Number = parameter(
        "kg m2", "rotary inertias at the joints, half on each side of an elastic joint", **_NONE
    )
    speed: Number = parameter("rad/s", "speed of the shaft", default=0.0, lower=0.0)
    Ip_A: Number = parameter("kg m2", "polar inertia of a disc or yoke at A", default=0.0, lower=0.0)
    Ip_D: Number = parameter("kg m2", "polar inertia of a disc or yoke at D", default=0.0, lower=0.0)
    Ip_joint: Numbers | Number = parameter(
        "kg m2", "polar inertias at the joints, half on each side of an elastic joint", **_NONE
    )
    rhoIp: Numbers | Number = parameter("kg m", "polar inertia per length of the segments", symbol="ρI_p", **_NONE)
    k_A_y: Number | None = parameter(
        "N/m", "stiffness of the support at A in a second plane", derived="k_A", lower=0.0, infinite=True
    )
    k_D_y: Number | None = parameter(
        "N/m", "stiffness of the support at D in a second plane", derived="k_D", lower=0.0, infinite=True
    )
    k_joint_y: Numbers | Number | None = parameter(
        "N/m",
        "stiffness of supports at the joints in a second plane",
        derived="k_joint",
        broadcast=True,
        infinite=True,
        **_LIST,
    )

    @serves("critical_speeds", "whirl", check=check)
    def shaft(self) -> Shaft:
        """The shaft with these parameters (numbers, or arrays of one shape of lanes; lists as tuples of them).

        Parameters without effect, such as masses of 0, are left out of the computation.
        """
        length = self.length if isinstance(self.length, tuple) else (self.length,)
        segments = len(length)

        def entries(name: str, count: int, none: float) -> tuple[Any, ...]:
            return entries_of(getattr(self, name), count, none)

        def unless(items: tuple[Any, ...], none: float) -> Any:
            return None if all(isinstance(x, (int, float)) and x == none for x in items) else stack(items)

        supports = (self.k_A, *entries("k_joint", segments - 1, 0.0), self.k_D)
        masses = (self.m_A, *entries("m_joint", segments - 1, 0.0), self.m_D)
        springs = (self.k_rot_A, *(0.0,) * (segments - 1), self.k_rot_D)
        inertias = (self.I_A, *entries("I_joint", segments - 1, 0.0), self.I_D)
        polar = unless((self.Ip_A, *entries("Ip_joint", segments - 1, 0.0), self.Ip_D), 0.0)
        per_length, second = unless(entries("rhoIp", segments, 0.0), 0.0), None
        if any(k is not None for k in (self.k_A_y, self.k_D_y, self.k_joint_y)):
            first, last = (k if k_y is None else k_y for k, k_y in ((self.k_A, self.k_A_y), (self.k_D, self.k_D_y)))
            joints = entries("k_joint" if self.k_joint_y is None else "k_joint_y", segments - 1, 0.0)
            second = stack((first, *joints, last))
        return Shaft(
            stack(length),
            stack(entries("EI", segments, 0.0)),
            stack(entries("rhoA", segments, 0.0)),
            stack(supports),
            unless(masses, 0.0),
            unless(entries("k_hinge", segments - 1, math.inf), math.inf),
            unless(entries("kGA", segments, math.inf), math.inf),
            unless(entries("rhoI", segments, 0.0), 0.0),
            unless(springs, 0.0),
            unless(inertias, 0.0),
            polar,
            per_length,
            None if polar is None and per_length is None else stack((self.speed, 0.0)),
            second,
        ).arrays()
