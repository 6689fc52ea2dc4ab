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

from drivetrain_jax._wording import counted
from drivetrain_jax.systems._base import Number, System, parameter, serves
from drivetrain_jax.systems._shaft import Shaft, stack
from drivetrain_jax.systems.bicardan_units import PHYSICAL

_PER_SEGMENT, _PER_JOINT = ("EI", "rhoA", "kGA", "rhoI"), ("k_joint", "m_joint", "k_hinge", "I_joint")

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
                    f"allowed is one per {what}, {needed}"
                )
    mass, rotary = (_entries(fixed.get(name, ()), segments, none) for name, none in (("rhoA", 1.0), ("rhoI", 0.0)))
    for i, (each, own) in enumerate(zip(mass, rotary, strict=True)):
        # Traced values are not checked.
        if isinstance(each, (int, float)) and isinstance(own, (int, float)) and each == 0 and own > 0:
            raise ValueError(f"rhoI[{i}] = {own:g}: allowed is 0 for a segment without mass (rhoA[{i}] = 0)")


def _entries(value: Any, count: int, none: float) -> tuple[Any, ...]:
    """One entry for each of ``count`` places from a list, one number for all of them, or an empty list."""
    if not isinstance(value, tuple):
        return (value,) * count
    return value or (none,) * count


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

    @serves("critical_speeds", check=check)
    def shaft(self) -> Shaft:
        """The shaft with these parameters (numbers, or arrays of one shape of lanes; lists as tuples of them).

        Parameters without effect, such as masses of 0, are left out of the computation.
        """
        length = self.length if isinstance(self.length, tuple) else (self.length,)
        segments = len(length)

        def entries(name: str, count: int, none: float) -> tuple[Any, ...]:
            return _entries(getattr(self, name), count, none)

        def unless(items: tuple[Any, ...], none: float) -> Any:
            return None if all(isinstance(x, (int, float)) and x == none for x in items) else stack(items)

        supports = (self.k_A, *entries("k_joint", segments - 1, 0.0), self.k_D)
        masses = (self.m_A, *entries("m_joint", segments - 1, 0.0), self.m_D)
        springs = (self.k_rot_A, *(0.0,) * (segments - 1), self.k_rot_D)
        inertias = (self.I_A, *entries("I_joint", segments - 1, 0.0), self.I_D)
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
        ).arrays()
