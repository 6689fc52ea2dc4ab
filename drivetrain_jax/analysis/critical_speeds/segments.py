"""The segments of a shaft with their nodes, in the units in which the propagation runs."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.mechanisms import highest_frequency
from drivetrain_jax.systems import Shaft

# Phase of a segment without mass over that of all others, where it need only be negligible: its effect is the fourth power.
_FAINT = 1e-12


class Scales(NamedTuple):
    """Quantities of the segments alone: ``beta = l (rhoA/EI)^(1/4)``, so that z = q beta, and the units of S22, S12
    and S11: ``e1 = b EI``, ``e2 = b^2 EI``, ``e3 = b^3 EI`` with ``b = (rhoA/EI)^(1/4)``; shape ``(n, ...)`` each.

    A segment without mass takes the mean of all segments for ``rhoA``; results do not depend on it. ``r`` is the mass of
    a segment over the one in its ``b``: 0 there, else 1. ``faint`` takes so short a phase that r = 1 is right as well.
    """

    beta: Array
    b: Array
    e1: Array
    e2: Array
    e3: Array
    r: Array

    @classmethod
    def of(cls, shaft: Shaft, faint: bool = False) -> Scales:
        """The scales of ``shaft``."""
        massless, mean = shaft.rhoA == 0, _mean_mass(shaft.rhoA)
        b = jnp.sqrt(jnp.sqrt(jnp.where(massless, mean, shaft.rhoA) / shaft.EI))
        if faint:
            phase = jnp.sum(jnp.where(massless, 0.0, shaft.length * b), axis=0)
            highest = jnp.where(phase > 0, 1.0, highest_frequency(shaft))
            phase = jnp.where(phase > 0, phase, 1 / jnp.where(highest == 0, 1.0, highest))
            b = jnp.where(massless, _FAINT * jnp.minimum(b, phase / shaft.length), b)
        e1 = b * shaft.EI
        # Not the number 0: derivatives by rhoA pass here.
        return cls(shaft.length * b, b, e1, b * e1, b * b * e1, jnp.where(massless, shaft.rhoA / mean, 1.0))


def _mean_mass(rhoA: Array) -> Array:
    """The mean of all segments, 1 if none has mass. Other masses would give scales the lanes of other parameters."""
    mean = jnp.mean(rhoA, axis=0)
    return jax.lax.stop_gradient(jnp.where(mean == 0, 1.0, mean))


class Segment(NamedTuple):
    """A segment with the node in front of it: the slices over which the propagation runs. ``inertia_before`` is that in
    front of an elastic joint."""

    beta: Array
    e1: Array
    e2: Array
    e3: Array
    r: Array | None
    k: Array
    unit: Array
    m: Array | None
    k_hinge: Array | None
    turn: Array | None
    k_rot: Array | None
    inertia: Array | None
    inertia_before: Array | None
    shear: Array | None
    rotary: Array | None


class LastNode(NamedTuple):
    """The node at D, with the scales of the segment in front of it."""

    k: Array
    m: Array | None
    unit: Array
    k_rot: Array | None
    inertia: Array | None
    e1: Array
    e3: Array


def segments_of(shaft: Shaft, faint: bool = False) -> tuple[Segment, LastNode]:
    """The segments, each with the node in front of it, and the last node; for ``faint`` see :class:`Scales`."""
    scales = Scales.of(shaft)
    inner = Scales.of(shaft, faint=True) if faint else scales
    unit = jnp.concatenate([scales.e3[:1], between(scales.e3), scales.e3[-1:]])
    hinges = turn = None
    if shaft.k_hinge is not None:
        hinges = jnp.concatenate([jnp.full_like(shaft.k_hinge[:1], jnp.inf), shaft.k_hinge])
    if not (hinges is None and shaft.k_rot is None and shaft.inertia is None):
        turn = jnp.concatenate([scales.e1[:1], between(scales.e1)])
    shear = rotary = None
    if shaft.is_timoshenko:
        square = inner.b * inner.b
        shear = jnp.zeros_like(square) if shaft.kGA is None else square * shaft.EI / shaft.kGA
        # A segment without mass has no rotary inertia either.
        mass = jnp.where(shaft.rhoA == 0, 1.0, shaft.rhoA)
        rotary = jnp.zeros_like(square) if shaft.rhoI is None else square * shaft.rhoI / mass
    before, behind = split_inertia(shaft)
    k_rot, inertia, m = (None if x is None else x[:-1] for x in (shaft.k_rot, behind, shaft.m))
    own = inner.beta, inner.e1, inner.e2, inner.e3, None if faint else inner.r
    segments = Segment(*own, shaft.k[:-1], unit[:-1], m, hinges, turn, k_rot, inertia, before, shear, rotary)
    k_rot, inertia, m = (None if x is None else x[-1] for x in (shaft.k_rot, shaft.inertia, shaft.m))
    return segments, LastNode(shaft.k[-1], m, unit[-1], k_rot, inertia, scales.e1[-1], scales.e3[-1])


def split_inertia(shaft: Shaft) -> tuple[Array | None, Array | None]:
    """Rotary inertia in front of the joint at every node but the last, and behind the joint at every node.

    All of it is behind a joint if all joints are rigid (the first is then None).
    """
    whole = shaft.inertia
    if whole is None or shaft.k_hinge is None:
        return None, whole
    halves = 0.5 * whole[1:-1]
    first = jnp.zeros_like(whole[:1])
    return jnp.concatenate([first, halves]), jnp.concatenate([whole[:1], halves, whole[-1:]])


def between(scale: Array) -> Array:
    """The mean of both sides at every joint."""
    return (scale[1:] + scale[:-1]) / 2
