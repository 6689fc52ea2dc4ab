"""Linear forms of the state that are the same at both ends of a segment and on both sides of a joint."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import hinge_shares, rotation_shares, support_shares
from drivetrain_jax.analysis.critical_speeds.segments import Scales, between, split_inertia
from drivetrain_jax.analysis.critical_speeds.waves import Waves, even_and_odd
from drivetrain_jax.systems import Shaft


class Segments(NamedTuple):
    """The waves of all segments at the frequencies of the modes, ``(n, modes, ...)``.

    With the rotation ``(cosine, sine)`` the state falls into two pairs with ``alpha' = beta``, ``beta' = r^2 alpha``:
    ``alpha = sine F - cosine theta``, ``beta = sine f - cosine M`` with ``r^2 = -trigonometric2``, and ``alpha = sine
    theta + cosine F``, ``beta = cosine f + sine M`` with ``r^2 = hyperbolic2``. ``z`` is the phase of a whole segment. A
    segment without mass (``massless``) has no waves: its deflection is a cubic, with the ``shear`` number.
    """

    z: Array
    cosine: Array
    sine: Array
    trigonometric2: Array
    hyperbolic2: Array
    shear: Array
    massless: Array

    @classmethod
    def of(cls, shaft: Shaft, q: Array) -> Segments:
        """Of the segments of ``shaft`` at ``q = sqrt(p)``."""
        scales = Scales.of(shaft)
        square = (q * scales.b[:, None]) ** 2
        none = jnp.zeros_like(square)
        s = none if shaft.kGA is None else square * (shaft.EI / shaft.kGA)[:, None]
        massless = shaft.rhoA == 0
        t = none if shaft.rhoI is None else square * (shaft.rhoI / jnp.where(massless, 1.0, shaft.rhoA))[:, None]
        half = (s - t) / 2
        root = jnp.sqrt(half * half + 1)
        ratio = jnp.where(half > 0, half + root, 1 / (root - half))
        size = jnp.sqrt(1 + ratio * ratio)
        waves = Waves.of(s, t)
        z, pair = q * scales.beta[:, None], (waves.trigonometric2, waves.hyperbolic2)
        return cls(z, 1 / size, ratio / size, *pair, s, massless[:, None])

    def split(self, v: Array) -> tuple[Array, Array, Array, Array]:
        """alpha and beta of the trigonometric and of the hyperbolic pair."""
        f, theta, moment, force = v
        c, s = self.cosine, self.sine
        return s * force - c * theta, s * f - c * moment, s * theta + c * force, c * f + s * moment

    @property
    def number(self) -> Array:
        """The real wave number of the hyperbolic pair, 0 above the cut-off."""
        return jnp.sqrt(jnp.maximum(self.hyperbolic2, 0.0))

    @property
    def long(self) -> Array:
        """True if the hyperbolic pair is treated as a falling and a rising wave."""
        return self.number * self.z > 1

    def cubic(self, xi: Array) -> tuple[Array, Array, Array, Array]:
        """Deflection at the phase ``xi`` of a segment without mass, as a form of the state in front of it."""
        half = 0.5 * xi * xi
        return jnp.ones_like(half), xi, half, xi * (half / 3 - self.shear)


class Links(NamedTuple):
    """Four linear forms of the state that are the same at two sections, the state being ``v`` at the first of them and
    ``w`` at the second: ``before @ v = behind @ w``, arrays ``(n, 4, 4, modes, ...)``.

    Nothing in them is large, so that their values are known to rounding of ``v``: where a part cannot be told from
    ``v``, such as a wave that grows or the force behind a rigid support, the form vanishes at the second section.
    """

    before: Array
    behind: Array


def along_segments(w: Segments) -> Links:
    """From the start of every segment to its end, for either direction."""
    o, c, s = jnp.zeros_like(w.cosine), w.cosine, w.sine
    alpha, beta, alpha_h, beta_h = (
        jnp.stack(form, axis=1) for form in ((o, -c, o, s), (s, o, -c, o), (o, s, o, c), (c, o, s, o))
    )
    w, long = Segments(*(field[:, None] for field in w)), w.long[:, None]
    cos, sin, _ = even_and_odd(-w.trigonometric2, w.z)
    ch, sh, growth = even_and_odd(w.hyperbolic2, w.z)
    unit, nu = jnp.exp(-growth), jnp.sqrt(w.trigonometric2)
    size = jnp.sqrt(jnp.maximum(jnp.abs(w.hyperbolic2), 1.0))
    falling, rising = beta_h - w.number * alpha_h, beta_h + w.number * alpha_h
    before = (
        cos * alpha + sin * beta,
        (cos * beta - w.trigonometric2 * sin * alpha) / nu,
        jnp.where(long, unit * falling, ch * alpha_h + sh * beta_h),
        jnp.where(long, rising, (ch * beta_h + w.hyperbolic2 * sh * alpha_h) / size),
    )
    behind = (
        alpha,
        beta / nu,
        jnp.where(long, falling, unit * alpha_h),
        unit * jnp.where(long, rising, beta_h / size),
    )
    waves = Links(jnp.stack(before, axis=1), jnp.stack(behind, axis=1))
    return jax.tree.map(partial(jnp.where, w.massless[:, None]), _without_mass(w), waves)


def _without_mass(w: Segments) -> Links:
    """The four components of the state behind a segment without mass, each over the sum of its coefficients."""
    one, o = jnp.ones_like(w.z), jnp.zeros_like(w.z)
    deflection = w.cubic(w.z)
    rows = (deflection, (o, one, w.z, deflection[2]), (o, o, one, w.z), (o, o, o, one))
    size = jnp.stack([sum(jnp.abs(x) for x in row) for row in rows], axis=1)
    before = jnp.stack([jnp.concatenate(row, axis=1) for row in rows], axis=1)
    own = jnp.eye(4).reshape(1, 4, 4, *(1,) * (w.z.ndim - 2))
    return Links(before / size, own / size)


def across_joints(shaft: Shaft, q: Array) -> Links:
    """Across the joint, its inertias and the support in front of every segment; in front of the first one anything.

    ``f`` passes. ``theta + M/k_hinge`` and ``F - k f`` become theta and F. The moment within the joint is ``M + kappa
    theta`` in front and ``M - kappa theta`` behind it (kappa: that of the rotary inertia there). Each is multiplied by what
    keeps it finite.
    """
    scales = Scales.of(shaft)

    def last(x: Array) -> Array:
        return jnp.concatenate([x[:1], x[:-1]])

    def joints(x: Array) -> Array:
        return jnp.concatenate([x[:1], x])[:, None]

    b, e1, e2, e3 = (joints(between(x)) if shaft.segments > 1 else x[:, None] for x in scales[1:5])
    masses = None if shaft.m is None else shaft.m[:-1, None]
    keep, reaction = support_shares(shaft.k[:-1, None], masses, e3, q)
    hold, turn = (
        (1.0, 0.0) if shaft.k_hinge is None or shaft.segments == 1 else hinge_shares(joints(shaft.k_hinge), e1, q)
    )
    inertias = (None if x is None else x[: shaft.segments, None] for x in split_inertia(shaft))
    (pass_1, kappa_1), (pass_2, kappa_2) = (
        (1.0, 0.0) if x is None else rotation_shares(None, x, e1, q) for x in inertias
    )

    def forms(units: tuple[Array, ...], turn: Any, hold: Any, kappa: Any, reaction: Any) -> Array:
        theta, moment, force = (unit[:, None] for unit in units)
        rows = (
            (1.0, 0.0, 0.0, 0.0),
            (0.0, hold * (theta / b), turn * e2 / b * (moment / e2), 0.0),
            (0.0, kappa * theta / e2, pass_1 * pass_2 * (moment / e2), 0.0),
            (-reaction / e3, 0.0, 0.0, keep * (force / e3)),
        )
        entries = jnp.broadcast_arrays(*(jnp.asarray(x, float) for row in rows for x in row), keep)
        return jnp.stack(entries[:-1], axis=1).reshape(len(keep), 4, 4, *keep.shape[1:])

    units = scales.b, scales.e2, scales.e3
    before = forms(
        tuple(last(x) for x in units), turn * pass_1, hold * pass_1 + turn * kappa_1, pass_2 * kappa_1, reaction
    )
    return Links(before, forms(units, 0.0, hold * pass_1, -pass_1 * kappa_2, 0.0))
