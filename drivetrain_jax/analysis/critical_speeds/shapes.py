"""Mode shapes of a stepped shaft, without the growth that spoils the plain transfer matrices.

At a natural frequency the planes L of the states that obey the conditions left of a section and R of those that obey
the conditions right of it share one line, the mode: with the symplectic form w, ``L w R = c v v^T``, c the same at all
sections. That gives the state v where the mode is largest. From there it is carried outwards, to the right within the
planes R and to the left within the planes L (as eigenvectors from twisted factorisations: Dhillon & Parlett, Linear
Algebra Appl. 387 (2004) 1): what comes across a segment or a joint fixes the state in the plane behind it, and does so
also where the product has lost a part that hardly moves, or is at rest.
"""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis.critical_speeds.compound import (
    Plane,
    Scales,
    Waves,
    between,
    even_and_odd,
    hinge_shares,
    planes,
    rotation_shares,
    split_inertia,
    support_shares,
)
from drivetrain_jax.analysis.numerics.linear_algebra import looped_matmul, matmul, solve
from drivetrain_jax.analysis.numerics.singular_values import jacobi_vectors
from drivetrain_jax.systems import Shaft

# Linear forms of the state that are the same at both ends of a segment and on both sides of a joint.


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
    def from_shaft(cls, shaft: Shaft, q: Array) -> Segments:
        """Of the segments of ``shaft`` at ``q = sqrt(p)``."""
        scales = Scales.from_shaft(shaft)
        square = (q * scales.b[:, None]) ** 2
        none = jnp.zeros_like(square)
        s = none if shaft.kGA is None else square * (shaft.EI / shaft.kGA)[:, None]
        massless = shaft.rhoA == 0
        t = none if shaft.rhoI is None else square * (shaft.rhoI / jnp.where(massless, 1.0, shaft.rhoA))[:, None]
        half = (s - t) / 2
        root = jnp.sqrt(half * half + 1)
        ratio = jnp.where(half > 0, half + root, 1 / (root - half))
        size = jnp.sqrt(1 + ratio * ratio)
        waves = Waves.from_numbers(s, t)
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
    behind = (alpha, beta / nu, jnp.where(long, falling, unit * alpha_h), unit * jnp.where(long, rising, beta_h / size))
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
    scales = Scales.from_shaft(shaft)

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


# Modes of multiple and of almost equal frequencies: the eigenspace of all of them, and its directions.
#
# At a natural frequency the conditions ``A(q) x = 0`` on the states x at the ends of all segments have a solution. For
# a cluster of frequencies the solutions are the smallest singular vectors X of A at one of them. With the left vectors
# Y, which follow from X by the symplectic form, ``Y^T A' X`` is the mass matrix of the modes (times a number) and ``Y^T
# A X`` their stiffness beside that frequency: the directions that diagonalise both are the modes, orthogonal in the
# mass (Rayleigh & Ritz). In an exactly multiple frequency the stiffness is rounding and any orthogonal directions are
# right: those are taken that differ most in their places, so that each moves one of the spans that hinges on rigid
# supports separate.

# Relative distance up to which q belong to a cluster: a double root of Psi is known to the root of rounding only.
_CLOSE = 1e-7
# Relative distance up to which q are equal, and the one by which places part them.
_EQUAL, _PARTED = 1e-13, 1e-14
# The symplectic form of the states (f, theta, M, F).
_FORM = np.array([[0, 0, 0, -1.0], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]])


def states_in_clusters(shaft: Shaft, q: Array, states: Array) -> Array:
    """``states`` at the ends of segments, ``(2n, 4, modes, *lanes)``, with those of the eigenspace where ``q`` is in a
    cluster."""
    modes, lanes = q.shape[0], q.shape[1:]
    if modes == 1:
        return states
    flat = q.reshape(modes, -1)
    near = jnp.abs(flat[1:] - flat[:-1]) <= _CLOSE * flat[1:]
    apart, index = jnp.ones_like(near[:1]), jnp.arange(modes)[:, None]
    first = jax.lax.cummax(jnp.where(jnp.concatenate([apart, ~near]), index, 0))
    last = jax.lax.cummin(jnp.where(jnp.concatenate([~near, apart]), index, modes), reverse=True)
    fields = jax.tree.map(lambda field: field.reshape(len(field), -1), shaft.spread())
    most = min(modes, 2 * shaft.segments)

    def own(mode: tuple[Array, ...]) -> Array:
        q, size, rank, known = mode
        return jax.lax.cond(
            jnp.any(size > 1), lambda: jnp.where(size > 1, _states(fields, q, size, rank, most), known), lambda: known
        )

    known = jnp.moveaxis(states.reshape(*states.shape[:2], modes, -1), 2, 0)
    found = jax.lax.map(own, (jnp.take_along_axis(flat, first, axis=0), last - first + 1, index - first, known))
    return jnp.moveaxis(found, 0, 2).reshape(*states.shape[:2], modes, *lanes)


def _states(shaft: Shaft, q: Array, size: Array, rank: Array, most: int) -> Array:
    """States ``(2n, 4, lanes)`` of the mode ``rank`` of the ``size`` ones at and above ``q``, at most ``most``."""
    (before, behind), slopes = jax.jvp(partial(_conditions, shaft), (q,), (jnp.ones_like(q),))
    links, lanes = before.shape[2:]
    number = jnp.arange(links)
    blocks = jnp.zeros((links, 4, links + 1, 4, lanes)).at[number, :, number].set(jnp.moveaxis(before, 2, 0))
    blocks = blocks.at[number, :, number + 1].set(-jnp.moveaxis(behind, 2, 0))
    matrix = blocks[:, :, 1:-1].reshape(4 * links, 4 * (links - 1), lanes)
    vectors = jacobi_vectors(matrix)[0]
    smallest = jnp.argsort(jnp.sum(looped_matmul(matrix, vectors) ** 2, axis=0), axis=0)[:most]
    vectors = jnp.take_along_axis(vectors, smallest[None], axis=1)
    x = jnp.moveaxis(vectors.reshape(links - 1, 4, most, lanes), 0, 2)

    dual = matmul(jnp.asarray(_FORM)[:, :, None, None], x) * jnp.repeat(Scales.from_shaft(shaft).e3, 2, axis=0)
    nothing = jnp.zeros_like(x[:, :, :1])

    def in_front(of: Array) -> Array:
        return jnp.concatenate([nothing, of], axis=2)

    def after(of: Array) -> Array:
        return jnp.concatenate([of, nothing], axis=2)

    both = jnp.concatenate([before, behind], axis=1)
    pair = jnp.concatenate([in_front(dual), after(dual)])
    y = solve(matmul(both, jnp.swapaxes(both, 0, 1)), matmul(both, pair))

    direction, unit = jnp.arange(most)[:, None], jnp.eye(most)[:, :, None]
    inside = (direction[:, None] < size) & (direction[None] < size)

    def form(left: Array, right: Array) -> Array:
        product = jnp.sum(matmul(jnp.swapaxes(left, 0, 1), right), axis=2)
        return jnp.where(inside, 0.5 * (product + jnp.swapaxes(product, 0, 1)), 0.0)

    def change(links: Links) -> Array:
        return matmul(links.before, in_front(x)) - matmul(links.behind, after(x))

    mass = form(y, change(Links(*slopes))) + jnp.where(inside, 0.0, unit)
    axes = jacobi_vectors(mass)[0]
    axes = axes / jnp.sqrt(jnp.sum(axes * matmul(mass, axes), axis=0))

    def along_axes(form: Array) -> Array:
        return matmul(jnp.swapaxes(axes, 0, 1), matmul(form, axes))

    stiffness = along_axes(form(y, change(Links(before, behind))))
    places = along_axes(form(x, x * jnp.arange(links - 1)[:, None]))
    places = _PARTED * q * places / jnp.sum(jnp.abs(places), axis=(0, 1))
    stiffness = jnp.where(jnp.abs(stiffness) > _EQUAL * q, stiffness, 0.0) - places
    # Positive, so that its singular vectors are its eigenvectors.
    turned = jacobi_vectors(stiffness + 2 * jnp.sum(jnp.abs(stiffness), axis=(0, 1)) * unit)[0]
    distance = -jnp.sum(turned * matmul(stiffness, turned), axis=0)
    place = jnp.argsort(jnp.where(direction < size, distance, jnp.inf), axis=0)
    own = jnp.take_along_axis(place, jnp.minimum(rank, most - 1)[None], axis=0)
    combination = matmul(axes, jnp.take_along_axis(turned, own[None], axis=1))
    return jnp.moveaxis(matmul(x, combination[:, :, None])[:, 0], 0, 1)


def _conditions(shaft: Shaft, q: Array) -> Links:
    """The forms along all segments, across all joints and at the ends, ``(4, 4, 2n + 1, lanes)``, at ``q`` of every lane.

    At an end, two forms of its state vanish, and two of a state beyond it, which is nothing.
    """
    scales, q = Scales.from_shaft(shaft), q[None]
    along, across = along_segments(Segments.from_shaft(shaft, q)), across_joints(shaft, q)
    none, one = jnp.zeros_like(q), jnp.ones_like(q)

    def end(node: int, sign: float) -> tuple[Array, Array]:
        m, k_rot, inertia = (None if x is None else x[node] for x in (shaft.m, shaft.k_rot, shaft.inertia))
        e1, e3 = scales.e1[node], scales.e3[node]
        keep, add = support_shares(shaft.k[node], m, e3, q)
        turn, hold = rotation_shares(k_rot, inertia, e1, q)
        force, moment = (sign * add / e3, none, none, keep), (none, -sign * hold / e1, turn, none)
        empty = (none,) * 4
        rows = (force, moment, empty, empty), (empty, empty, (one, none, none, none), (none, one, none, none))
        at, beyond = (jnp.stack([jnp.stack(jnp.broadcast_arrays(*row)) for row in part]) for part in rows)
        return at, beyond

    (at_a, beyond_a), (at_d, beyond_d) = end(0, 1.0), end(-1, -1.0)

    def woven(first: Array, across: Array, along: Array, last: Array) -> Array:
        segments = jnp.stack(jnp.broadcast_arrays(across, along), axis=1).reshape(-1, *along.shape[1:])[1:]
        return jnp.moveaxis(jnp.concatenate([first[None], segments, last[None]])[..., 0, :], 0, 2)

    return Links(woven(beyond_a, across.before, along.before, at_d), woven(at_a, across.behind, along.behind, beyond_d))


# Multiple of its asymmetry up to which the product of two planes is rounding.
_APART = 30.0
# A deflection up to this part of the state is rounding.
_ROUNDING = 1024 * np.finfo(float).eps
# The state (f, theta, M, F) seen from the other end of the shaft.
_MIRROR = np.array([1.0, -1.0, 1.0, -1.0])


def _right(u: Plane) -> Array:
    """The matrix of the plane of the mirrored shaft: theta and F change their sign."""
    return _antisymmetric(-u[0], u[1], u[2], u[3], -u[4])


def _antisymmetric(y12: Array, y13: Array, y14: Array, y24: Array, y34: Array) -> Array:
    """A plane as the antisymmetric matrix of its minors, rows f, theta, M, F, shape ``(4, 4, ...)``."""
    o = jnp.zeros_like(y12)
    rows = ((o, y12, y13, y14), (-y12, o, y14, y24), (-y13, -y14, o, y34), (-y14, -y24, -y34, o))
    return jnp.stack([jnp.stack(row) for row in rows])


def _shared_states(left: Plane, right: Plane) -> tuple[Array, Array, Array]:
    """The state that both planes contain, ``(4, ...)``, its largest entry 1; the square of that entry in
    ``L w R``; and whether it is more than rounding.

    Planes that share no line leave a product that is not symmetric. So they do in a part of the shaft that is at rest,
    where both are of the order of rounding.
    """
    # w R: F_v f_w - f_v F_w + theta_v M_w - M_v theta_w.
    R = _right(right)
    L = _antisymmetric(left[0], left[1], -left[2], left[3], left[4])
    product = matmul(L, jnp.stack([-R[3], R[2], -R[1], R[0]]))
    diagonal = jnp.stack([product[i, i] for i in range(4)])
    best = jnp.argmax(jnp.abs(diagonal), axis=0)
    chosen = [best == i for i in range(4)]
    column = sum(jnp.where(chosen[i], product[:, i], 0.0) for i in range(4))
    entry = sum(jnp.where(chosen[i], diagonal[i], 0.0) for i in range(4))
    moving = jnp.abs(entry) > _APART * jnp.abs(product[0, 3] - product[3, 0])
    return column / jnp.where(entry == 0, 1.0, entry), jnp.abs(entry), moving


def _next_state(plane: Array, link: Links, state: Array) -> Array:
    """The state in a plane behind a link, ``(4, ...)``: from the two forms that differ most there, 0 if all are 0."""
    rows, values = link.behind, matmul(link.before, state[:, None])[:, 0]
    images = matmul(plane, jnp.swapaxes(rows, 0, 1))
    minors = matmul(rows, images)
    pairs = tuple(combinations(range(4), 2))
    best = jnp.argmax(jnp.stack([jnp.abs(minors[i, j]) for i, j in pairs]), axis=0)
    result, minor = jnp.zeros_like(state), jnp.zeros_like(state[0])
    for k, (i, j) in enumerate(pairs):
        result = jnp.where(best == k, images[:, j] * values[i] - images[:, i] * values[j], result)
        minor = jnp.where(best == k, minors[i, j], minor)
    return jnp.where(minor == 0, 0.0, result / jnp.where(minor == 0, 1.0, minor))


def _carried(across: Links, along: Links, ahead: tuple[Plane, Plane], start: Array | np.ndarray, place: Array) -> Array:
    """States at the 2n ends of segments from the one at ``place`` (``start``) to the last; 0 before. ``ahead`` are the
    planes of the other side there, in front of and behind the segments. Shape ``(2n, 4, modes, ...)``."""

    def step(state: Array, segment: Any) -> tuple[Array, Array]:
        number, across, along, front, behind = segment
        entering = jnp.where(place == number, start, _next_state(_right(front), across, state))
        leaving = jnp.where(place == number + 1, start, _next_state(_right(behind), along, entering))
        return leaving, jnp.stack([entering, leaving])

    segments = len(along.before)
    states = jax.lax.scan(step, jnp.zeros_like(start), (2 * jnp.arange(segments), across, along, *ahead))[1]
    return states.reshape(2 * segments, *start.shape)


def _end_states(shaft: Shaft, q: Array, waves: Segments) -> tuple[Array, Array]:
    """States in front of and behind every segment in its own coordinates, of one scale: ``(n, 4, modes, ...)``."""
    mirrored = shaft.mirrored()
    front, behind, log_front, log_behind = planes(shaft, q)
    from_d, from_d_behind, log_d, log_d_behind = planes(mirrored, q)
    right_front, right_behind = (tuple(x[::-1] for x in u) for u in (from_d_behind, from_d))

    def ends(front: Array, behind: Array) -> Array:
        return jnp.stack([front, behind], axis=-q.ndim - 1).reshape(*front.shape[: -q.ndim - 1], -1, *q.shape)

    at_front, at_behind = _shared_states(front, right_front), _shared_states(behind, right_behind)
    shared, square, moving = (ends(a, b) for a, b in zip(at_front, at_behind, strict=True))
    # If parts share a frequency, all is rounding; their states come from the eigenspace.
    moving = moving | ~jnp.any(moving, axis=0)
    logs = ends(log_front + log_d_behind[::-1], log_behind + log_d[::-1])
    unit = jnp.log(jnp.repeat(Scales.from_shaft(shaft).e1, 2, axis=0))[:, None]
    place = jnp.argmax(jnp.where(moving, jnp.log(square) + unit + logs, -jnp.inf), axis=0)
    start = jnp.take_along_axis(shared, place[None, None], axis=1)[:, 0]

    along, turned = along_segments(waves), _MIRROR.reshape(4, *(1,) * q.ndim)
    to_the_right = _carried(across_joints(shaft, q), along, (right_front, right_behind), start, place)
    last = 2 * shaft.segments - 1
    along, ahead = jax.tree.map(lambda x: x[::-1], (along, (behind, front)))
    to_the_left = _carried(across_joints(mirrored, q), along, ahead, turned * start, last - place)[::-1] * turned
    number = jnp.arange(last + 1).reshape(-1, *(1,) * (q.ndim + 1))
    states = states_in_clusters(shaft, q, jnp.where(number < place, to_the_left, to_the_right))
    return states[::2], states[1::2]


def _deflection(w: Segments, front: Array, behind: Array, xi: Array) -> Array:
    """Deflection at the phases ``xi`` in [0, z] of a segment with these states at its ends."""
    alpha, beta, alpha_h, beta_h = w.split(front)
    _, _, alpha_end, beta_end = w.split(behind)
    cos, sin, _ = even_and_odd(-w.trigonometric2, xi)
    trigonometric = beta * cos - w.trigonometric2 * alpha * sin
    mu, long = w.number, w.long
    falling = 0.5 * (beta_h - mu * alpha_h) * jnp.exp(-mu * xi)
    rising = 0.5 * (beta_end + mu * alpha_end) * jnp.exp(-mu * (w.z - xi))
    ch, sh, growth = even_and_odd(w.hyperbolic2, jnp.where(long, 0.0, xi))
    short = (beta_h * ch + w.hyperbolic2 * alpha_h * sh) * jnp.exp(growth)
    waves = w.sine * trigonometric + w.cosine * jnp.where(long, falling + rising, short)
    return jnp.where(w.massless, sum(a * v for a, v in zip(w.cubic(xi), front, strict=True)), waves)


def mode_shapes(shaft: Shaft, q: Array, x: Array) -> Array:
    """Deflections of the modes ``q = sqrt(p) > 0`` at ``x`` in [0, 1], the distance from A over the whole length.

    ``q`` has shape ``(modes, *lanes)``, the result ``(modes, len(x), *lanes)``. The largest deflection is +1. A mode that
    turns without deflection, as hinged spans with shear and rotary inertia have at their cut-off, is 0 everywhere.
    """
    waves, b = Segments.from_shaft(shaft, q), Scales.from_shaft(shaft).b
    front, behind = _end_states(shaft, q, waves)
    lanes = q.shape[1:]
    place = x.reshape(len(x), *(1,) * len(lanes)) * jnp.sum(shaft.length, axis=0)
    starts = jnp.cumsum(shaft.length, axis=0) - shaft.length
    shape = jnp.zeros((q.shape[0], len(x), *lanes))
    for i in range(shaft.segments):
        wide = Segments(*(field[i][:, None] for field in waves))
        xi = (q * b[i])[:, None] * jnp.clip(place - starts[i], 0.0, shaft.length[i])
        here = _deflection(wide, front[i][:, :, None], behind[i][:, :, None], xi)
        shape = here if i == 0 else jnp.where(place >= starts[i], here, shape)
    size = jnp.max(jnp.abs(jnp.concatenate([front, behind])), axis=(0, 1))
    still = jnp.max(jnp.abs(shape), axis=1) <= _ROUNDING * size
    return normalised(jnp.where(still[:, None], 0.0, shape))


def normalised(shape: Array) -> Array:
    """``(modes, stations, ...)`` with the largest deflection of every mode +1; a mode without any stays 0."""
    best = jnp.argmax(jnp.abs(shape), axis=1, keepdims=True)
    largest = jnp.take_along_axis(shape, best, axis=1)
    return shape / jnp.where(largest == 0, 1.0, largest)
