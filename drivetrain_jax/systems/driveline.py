"""Driveline: a chain of Hooke joints, gears, torsionally flexible shafts and inertias, driven at constant speed.

Own derivation, docs/theory/driveline.md, whose equation numbers are used here. Element i = 0..N-1, counted from the driving
end: a joint (angle beta_i, phase_i of its yokes), then the ratio r_i, then the shaft k_i, c_i, then the inertia J_i at its
end; the last end is free. Time is the rotation tau = speed t of the driving end; the prime is d/dtau. theta_i is the twist
of shaft i, a_i = Psi_i + x_i the absolute rotation of J_i, and Psi_i that of the rigid chain. All functions broadcast over
entries of any common shape.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from drivetrain_jax._errors import counted
from drivetrain_jax._quantities import Component, Dimension, Variable
from drivetrain_jax.resonances import DRIVELINE
from drivetrain_jax.systems._base import (
    POSITIVE,
    RPM,
    Number,
    PhysicalData,
    System,
    Values,
    numeric,
    parameter,
    scaled,
    serves,
)
from drivetrain_jax.systems._models import (
    Block,
    FloquetModel,
    Flow,
    ForcedModel,
    LinearPeriodic,
    Rows,
    SpringSystem,
    weighted_factor,
)
from drivetrain_jax.systems._tubes import TUBES, stiffness_of_tubes
from drivetrain_jax.systems.cardan import speed_ratio

Components = Sequence[Any]
# A list is also an array, and each entry a number, an array of lanes, or a text such as "41/11".
Entries = Any

_LISTS = ("k", "c", "J", "beta", "phase", "ratio")

# Gears and the common period of the joints.


# Most turns of the driving end in a period, and the largest denominator of a ratio. Two fractions with denominators up to
# this one differ by 1e-6, so a number is one of them only if it is meant.
MOST_TURNS, _DENOMINATORS = 24, 1000
_EPS = float(np.finfo(float).eps)
# Rounding of a product of ratios times the denominator, for traced values.
_WHOLE = 1e-12


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, jax.core.Tracer)


def _fraction(x: float) -> Fraction | None:
    """The fraction of small integers whose rounding is ``x``, None if there is none."""
    fraction = Fraction(x).limit_denominator(_DENOMINATORS)
    return fraction if abs(float(fraction) - x) <= 2 * _EPS * abs(x) else None


def _half_turns(speeds: Sequence[float]) -> Fraction | None:
    """The smallest T/pi > 0 for which T/pi times each of the relative ``speeds`` is an integer; None if there is none.

    With speeds p_i/q_i in lowest terms it is lcm(q_i)/gcd(p_i).
    """
    fractions = [_fraction(x) for x in speeds]
    if None in fractions:
        return None
    known = [x for x in fractions if x is not None]
    common = math.lcm(*(x.denominator for x in known))
    turns = Fraction(common, math.gcd(*(abs(x.numerator) for x in known)))
    return turns if common <= _DENOMINATORS and turns <= 2 * MOST_TURNS else None


def _traced_half_turns(speeds: Sequence[Any], bent: Sequence[Any]) -> Array:
    """As :func:`_half_turns` for the joints that are ``bent``, with NaN for None and 1 without any such joint."""
    shape = jnp.broadcast_shapes(*map(jnp.shape, (*speeds, *bent)))
    multiples = jnp.arange(1.0, _DENOMINATORS + 1).reshape(-1, *(1,) * len(shape))
    common, divisor = jnp.ones((_DENOMINATORS, *shape), bool), jnp.zeros(shape, int)
    for speed, counts in zip(speeds, bent, strict=True):
        turned = multiples * jnp.abs(speed)
        common &= ~jnp.asarray(counts) | (jnp.abs(turned - jnp.round(turned)) <= _WHOLE * turned)
    first = jnp.argmax(common, axis=0) + 1.0
    for speed, counts in zip(speeds, bent, strict=True):
        whole = jnp.round(first * jnp.abs(speed)).astype(int)
        divisor = jnp.where(counts, jnp.gcd(divisor, whole), divisor)
    turns = first / jnp.maximum(divisor, 1)
    turns = jnp.where(jnp.any(common, axis=0) & (turns <= 2 * MOST_TURNS), turns, jnp.nan)
    for speed, counts in zip(speeds, bent, strict=True):
        turns = _stepped(turns, speed, counts)
    return turns


@jax.custom_jvp
def _stepped(turns: Any, speed: Any, bent: Any) -> Any:
    """``turns``, whose derivative by the relative ``speed`` of a joint is NaN where the joint is ``bent``."""
    return turns


@_stepped.defjvp
def _(primals: tuple[Any, Any, Any], tangents: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    turns, _, bent = primals
    return turns, tangents[0] + scaled(jnp.where(bent, jnp.nan, 0.0), tangents[1])


# The rigid motion.


class Joint(NamedTuple):
    """A joint with its gear along the rigid motion: the ratio ``h`` of speeds, its derivatives, and Psi' before it."""

    h: Any
    slope: Any
    curve: Any
    rate: Any


def clock(tau: Any) -> tuple[Any, Any, Any]:
    """``tau``, ``cos 2 tau`` and ``sin 2 tau``."""
    return tau, jnp.cos(2 * tau), jnp.sin(2 * tau)


def _rotated(cosine: Any, sine: Any, phase: Any) -> tuple[Any, Any]:
    """Cosine and sine of twice an angle after it has grown by ``phase``."""
    if _is_number(phase) and phase == 0:
        return cosine, sine
    c, s = jnp.cos(2 * phase), jnp.sin(2 * phase)
    return c * cosine - s * sine, s * cosine + c * sine


def rigid_motion(
    beta: Components, phase: Components, ratio: Components, tau: Any, cosine: Any, sine: Any, order: int = 2
) -> list[Joint]:
    """The joints along the rigid motion Psi_i = r_i F_i(Psi_{i-1}), with derivatives up to ``order``.

    ``cosine`` and ``sine`` are those of 2 tau. Without gears each joint maps e^(2i Psi) by a rational function, eq. (4);
    the angle itself is needed at a gear alone.
    """
    joints, angle, rate, acceleration = [], tau, 1.0, 0.0
    last, gears = _gears(beta, ratio)
    for i, (b, p, r) in enumerate(zip(beta, phase, ratio, strict=True)):
        if _is_straight(b):
            joints.append(Joint(r, 0.0, 0.0, rate))
        else:
            c, square = jnp.cos(b), jnp.sin(b) ** 2
            cosine, sine = _rotated(cosine, sine, p)
            d = ((1 + cosine) + c**2 * (1 - cosine)) / 2
            eta = c / d
            by_angle = c * square * sine / d**2
            slope = r * by_angle * rate
            curve = 0.0
            if order > 1:
                second = 2 * c * square * (cosine / d**2 + square * sine**2 / d**3)
                curve = r * (second * rate**2 + by_angle * acceleration)
            joints.append(Joint(r * eta, slope, curve, rate))
            if i < last:
                if gears and i <= gears[-1]:
                    rho = jnp.tan(b / 2) ** 2
                    angle = angle - jnp.arctan2(rho * sine, 1 + rho * cosine)
                turned = ((1 + cosine) - c**2 * (1 - cosine)) / (2 * d), c * sine / d
                cosine, sine = _rotated(*turned, -p)
        joint = joints[-1]
        rate, acceleration = joint.h * rate, joint.h * acceleration + joint.slope * rate
        if i in gears:
            angle = r * angle
            cosine, sine = jnp.cos(2 * angle), jnp.sin(2 * angle)
    return joints


def behind(beta: Any, phase: Any, angle: Any) -> Any:
    """The rotation F behind a joint whose input has turned by ``angle``, eq. (1)."""
    rho, twice = jnp.tan(beta / 2) ** 2, 2 * (angle + phase)
    return angle - jnp.arctan2(rho * jnp.sin(twice), 1 + rho * jnp.cos(twice))


def _is_straight(beta: Any) -> bool:
    return _is_number(beta) and beta == 0


def _gears(beta: Components, ratio: Components) -> tuple[int, list[int]]:
    """Number of the last joint, -1 without any, and the numbers of the gears before it."""
    last = max((i for i, b in enumerate(beta) if not _is_straight(b)), default=-1)
    return last, [i for i in range(last) if not (_is_number(ratio[i]) and ratio[i] == 1)]


def check(fixed: Values) -> None:
    """``ValueError`` unless all lists have one entry per element, ratios are not 0, and the joints have a common period."""
    lists = {name: fixed[name] for name in (*_LISTS, "theta_0", "theta_rate_0") if fixed.get(name, ()) != ()}
    first, count = next(((name, len(value)) for name, value in lists.items()), ("", 0))
    for name, value in lists.items():
        if len(value) != count:
            raise ValueError(
                f"{name}: {counted(len(value), 'entry', 'entries')} where {first} has {count}; expected one per element"
            )
    ratio, beta, speed, speeds = fixed.get("ratio", ()), fixed.get("beta", ()), 1.0, []
    for i, (r, b) in enumerate(zip(ratio, beta if len(beta) else (0,) * len(ratio), strict=False)):
        if not _is_straight(b):
            speeds.append(speed)
        if not _is_number(r):
            return
        if r == 0:
            raise ValueError(f"ratio[{i}] = 0: expected a ratio other than 0, negative if it reverses")
        speed *= r
    if speeds and _half_turns(speeds) is None:
        raise ValueError(
            f"ratio = {list(ratio)}: the joints have no common period of up to {MOST_TURNS} turns; expected ratios of few "
            'teeth between joints, such as "11/41"'
        )


# The uneven rotation of the rigid chain, and phases that remove it.


# Samples of a period, its parts whose highest peaks are refined, and hyperbolic length below which joints cancel.
_SAMPLES, _PARTS, _CANCELLED = 4096, 128, 1e-9
# Distances within rounding of extremes, and of their derivatives.
_LEVEL, _ALIKE = 1e-12, 1e-9


def range_of(function: Callable[[Any], Any], period: Any) -> Any:
    """Largest minus smallest value of a smooth function of that ``period``, ``(...)``, by samples and Newton's method.

    A peak narrower than a few samples may be missed: behind a gear of hundreds of teeth the range may be 0.1 % too small.
    """
    step, size = jnp.asarray(period, float) / _SAMPLES, _SAMPLES // _PARTS
    sign = jnp.array([1.0, -1.0]).reshape(-1, *(1,) * step.ndim)
    slope = lambda t: jax.jvp(function, (t,), (jnp.ones_like(t),))[1]  # noqa: E731

    def highest(part: Array) -> tuple[Array, Array]:
        """Of the function and of its negative, the highest peak among the samples of a part, -inf without one, and where."""
        number = (part * size + jnp.arange(-1, size + 1)).reshape(-1, *(1,) * step.ndim)
        # Without the barrier XLA would compute the values again for each of their uses.
        values = jax.lax.optimization_barrier(jax.lax.stop_gradient(function(step * number)))
        before, here, after = (sign * values[k : k + size, None] for k in range(3))
        # The vertex of the parabola: the sample next to a lower peak may lie above that next to the highest one.
        bent = 2 * here - before - after
        vertex = here + (before - after) ** 2 / (8 * jnp.where(bent > 0, bent, jnp.inf))
        peaks = jnp.where((here < before) | (here < after), -jnp.inf, vertex)
        return jnp.max(peaks, axis=0), step * (part * size + jnp.argmax(peaks, axis=0))

    def nearer(_: int, t: Array) -> Array:
        first, second = jax.jvp(slope, (t,), (jnp.ones_like(t),))
        moved = t - first / jnp.where(second == 0, jnp.inf, second)
        return jnp.clip(moved, start - step, start + step)

    tops, start = jax.lax.map(highest, jnp.arange(_PARTS))
    extremes = sign * function(jax.lax.fori_loop(0, 4, nearer, start))
    return jnp.maximum(jnp.sum(_largest(jnp.where(tops == -jnp.inf, -jnp.inf, extremes)), axis=0), 0.0)


@jax.custom_jvp
def _largest(values: Array) -> Array:
    """The largest of ``values`` along the first axis; no derivative where equal ones move apart. As the rule compares
    tangents, only forward derivatives exist."""
    return jnp.max(values, axis=0)


@_largest.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (values,), (slopes,) = primals, tangents
    top, place = jnp.max(values, axis=0), jnp.argmax(values, axis=0)
    slope = jnp.take_along_axis(slopes, place[None], axis=0)[0]
    equal = values >= top - _LEVEL * (1 + jnp.abs(top))
    apart = jnp.any(equal & (jnp.abs(slopes - slope) > _LEVEL + _ALIKE * jnp.abs(slope)), axis=0)
    return top, jnp.where(apart, jnp.nan, slope)


def _moved(b: Any, rho: Any, phase: Any) -> Any:
    """The image of ``b`` under the joint, eq. (4)."""
    a = rho * jnp.exp(-2j * phase)
    return (b + a) / (1 + jnp.conj(a) * b)


def _is_unit(gear: Any) -> Any:
    """True if a product of ratios is 1 or -1, up to rounding."""
    return jnp.abs(jnp.abs(gear) - 1) <= _WHOLE


def best_phases(beta: Components, phase: Components, ratio: Components) -> list[Any]:
    """Phases in [0, pi) that minimise the uneven rotation of each run of joints at one speed; its first joint keeps its own.

    A joint moves a point of the hyperbolic plane by l = ln sec(beta) in the direction of its phase, eq. (8). The path closes
    if no l is longer than all others together; each joint turns back as far as the remaining ones can make up for.
    """
    phases, b, lengths = [], jnp.zeros((), complex), [-jnp.log(jnp.cos(x)) for x in beta]
    gear: Any = 1.0
    for i, (p, length) in enumerate(zip(phase, lengths, strict=True)):
        bent = length != 0
        # Gears from one joint to the next whose ratios multiply to 1 change nothing; to -1, they mirror the rotation.
        passed = jnp.where(_is_unit(gear), jnp.where(gear > 0, b, jnp.conj(b)), 0.0)
        b = jnp.where(bent, passed, b)
        # Joints behind any other gear make up for nothing.
        together, onward, total, longest = True, ratio[i], 0.0, 0.0
        for r, after in zip(ratio[i + 1 :], lengths[i + 1 :], strict=True):
            together &= (after == 0) | _is_unit(onward)
            total, longest = total + after * together, jnp.maximum(longest, after * together)
            onward = r * jnp.where(after == 0, onward, 1.0)
        size = jnp.abs(b)
        distance, free = 2 * jnp.arctanh(size), 2 * jnp.arctanh(size) < _CANCELLED
        back = jnp.abs(distance - length)
        goal = jnp.clip(jnp.clip(back, jnp.maximum(0.0, 2 * longest - total), total), back, distance + length)
        volume = jnp.sinh(distance) * jnp.sinh(length)
        cosine = (jnp.cosh(goal) - jnp.cosh(distance) * jnp.cosh(length)) / jnp.where(volume == 0, 1.0, volume)
        # Straight back without the rounding of the cosine.
        cosine = jnp.where(goal <= back, -1.0, jnp.clip(cosine, -1.0, 1.0))
        turned = (jnp.arccos(cosine) - jnp.angle(jnp.where(free, 1.0, b))) / 2
        phases.append(jnp.mod(jnp.where(free | (length == 0), p, turned), math.pi))
        b, gear = _moved(b, jnp.tan(beta[i] / 2) ** 2, phases[-1]), ratio[i] * jnp.where(bent, 1.0, gear)
    return phases


# Part of the uneven rotation of all joints that remains, by rounding, where they cancel.
_CANCELS = 1e-14


def uneven_rotation(beta: Components, phase: Components, ratio: Components, half_turns: Any) -> tuple[Any, Any]:
    """Range of the speed of the rigid output over its mean, and of its lead [rad], peak to peak.

    Without gears the chain is one joint, eq. (8): 4 rho/(1 - rho^2) and 2 asin(rho).
    """
    last, gears = _gears(beta, ratio)
    if not gears:
        b: Any = jnp.zeros((), complex)
        for angle, p in zip(beta, phase, strict=True):
            b = _moved(b, jnp.tan(angle / 2) ** 2, p)
        total = sum(jnp.tan(angle / 2) ** 2 for angle in beta)
        # Where joints cancel, the range has a corner. The root of 0 has no derivative by what would move them.
        corner = (jnp.abs(b) <= _CANCELS * total) & (total > 0)
        rho = jnp.where(corner, jnp.sqrt(jnp.where(corner, 0.0 * (total + sum(phase)), 1.0)), jnp.abs(b))
        return 4 * rho / (1 - rho**2), 2 * jnp.arcsin(rho) * abs(math.prod(ratio[last:]))
    mean = math.prod(ratio)

    def turned(tau: Any) -> tuple[Any, Any]:
        """The rotation of the output over the mean ratio, and its derivative."""
        angle, speed = tau, 1.0
        for b, p, r in zip(beta, phase, ratio, strict=True):
            rho = jnp.tan(b / 2) ** 2
            speed *= (1 - rho**2) / (1 + 2 * rho * jnp.cos(2 * (angle + p)) + rho**2)
            angle = r * behind(b, p, angle)
        return angle / mean, speed

    shape = jnp.broadcast_shapes(*map(jnp.shape, (*beta, *phase, *ratio)))
    period = jnp.broadcast_to(math.pi * jnp.asarray(half_turns), shape)
    return range_of(lambda t: turned(t)[1], period), range_of(lambda t: turned(t)[0] - t, period) * abs(mean)


PHASING = (
    Variable("speed_variation", "1", "speed of the rigid output, peak to peak over its mean", lower=0.0),
    Variable("angle_variation", "rad", "lead of the rigid output, peak to peak", lower=0.0),
    Variable("least_variation", "1", "speed_variation with the phases best_phase", lower=0.0),
    Variable(
        "best_phase", "rad", "phases that minimise speed_variation, of each run of joints at one speed", ("joint",)
    ),
)


def phasing_sentence(values: Values, parameters: Values) -> str:
    """The answer in one sentence."""
    part, degrees, least = values["speed_variation"], np.degrees(values["angle_variation"]), values["least_variation"]
    speed = parameters.get("speed")
    mean = abs(math.prod(parameters.get("ratio") or (1.0,)))
    rpm = f", {part * speed * mean / RPM:.4g} rpm at {speed * mean / RPM:.5g} rpm" if speed else ""
    phases = ", ".join(f"{round(np.degrees(p), 2):.4g}" for p in values["best_phase"])
    best = f"with the phases [{phases}] deg by {round(100 * least, 9):.4g} %"
    if part - least <= 1e-9 * part + 1e-12:
        speeds = np.cumprod([1.0, *np.abs(parameters.get("ratio") or ())])
        angles = parameters.get("beta") or ()
        bent = [speed for speed, angle in zip(speeds, angles, strict=False) if angle != 0] or [1.0]
        # Joints at different speeds have no closed form: each run of joints at one speed was made even for itself.
        runs = "the best phases of each run of joints at one speed do not"
        best = f"{'no phases' if max(bent) - min(bent) <= _WHOLE else runs} make it less"
    return f"The output speed varies by {round(100 * part, 9):.4g} % peak to peak ({degrees:.4g} deg{rpm}); {best}."


_CHAIN = ("speed", *_LISTS)
PHYSICAL = PhysicalData(TUBES, stiffness_of_tubes("k"))

SHAFT = Dimension("shaft", "number of the shaft from the driving end", ())
_LIST = {"listed": True, "lower": 0.0}
_NONE: dict[str, Any] = {"default": (), "listed": True}


class Driveline(System):
    """The driveline of the module's docstring. Lists have one entry per element.

    >>> from drivetrain_jax import Driveline
    >>> lists = {"k": [2e5, 9e4, 2e5], "c": [5.0, 5.0, 5.0], "J": [0.1, 0.1, 4.0], "beta": [0.1, 0.2, 0.0]}
    >>> truck = Driveline(speed="1500 rpm", phase=[0.0, "90 deg", 0.0], ratio=[1, 1, "11/41"], **lists)
    >>> truck.vector_field(0.0, [0.0] * 6).shape
    (6,)
    """

    name = "driveline"
    title = "Driveline: a chain of Hooke joints, gears, shafts and inertias"
    source = "own derivation, docs/theory/driveline.md"
    physical = PHYSICAL
    resonances = DRIVELINE
    periods_per_turn = 0
    roles = MappingProxyType({"speed": "speed"})
    mode_families = ("torsional",)
    state = (Component("theta", "rad", "twist of a shaft"), Component("theta_rate", "1", "d theta/d tau", "θ'"))
    state_axis = displacements = SHAFT
    torque_units = "N m"

    speed: Number = parameter("rad/s", "speed of the driving end", **POSITIVE)
    k: Entries = parameter("N m/rad", "stiffness of the shafts", open_lower=True, **_LIST)
    c: Entries = parameter("N m s/rad", "damping of the shafts", **_LIST)
    J: Entries = parameter("kg m2", "inertias at the ends of the shafts", open_lower=True, **_LIST)
    beta: Entries = parameter(
        "rad",
        "angles of the joints, 0: no joint",
        symbol="β",
        lower=-math.pi / 2,
        upper=math.pi / 2,
        open_lower=True,
        open_upper=True,
        **_NONE,
    )
    phase: Entries = parameter("rad", "angles of the input yokes from the normal of the plane of their joint", **_NONE)
    ratio: Entries = parameter("1", 'output over input speed of the gears, such as "11/41"', fraction=True, **_NONE)
    theta_0: Entries = parameter("rad", "twists of the shafts at tau = 0", **_NONE)
    theta_rate_0: Entries = parameter("1", "d theta/d tau of the shafts at tau = 0", **_NONE)

    def entries(self, name: str, none: float = 0.0) -> Components:
        """One entry of the list ``name`` for each element; ``none`` for an empty list."""
        # The rigid motion needs no stiffness.
        count = len(self.k or self.beta or self.phase or self.ratio)
        return getattr(self, name) or (none,) * count

    @property
    def chain(self) -> tuple[Components, Components, Components]:
        """``beta``, ``phase`` and ``ratio`` of all elements."""
        return self.entries("beta"), self.entries("phase"), self.entries("ratio", 1.0)

    def half_turns(self) -> Any:
        """The period T of the joints over pi; NaN if they have none of up to `MOST_TURNS` turns, 1 without joints.

        A number, unless it depends on values that are traced or differ in a batch.
        """
        beta, _, ratio = self.chain
        speeds = [1.0]
        for r in ratio[:-1]:
            speeds.append(speeds[-1] * r)
        joints = [(speed, b) for speed, b in zip(speeds, beta, strict=True) if not _is_straight(b)]
        if all(_is_number(speed) for speed, _ in joints):
            # Joints that may be straight in a part of the batch count only if they do not matter.
            certain = [speed for speed, b in joints if _is_number(b)]
            sets = [certain, *([*certain, speed] for speed, b in joints if not _is_number(b)), [x for x, _ in joints]]
            periods = {_half_turns(speeds_of_set) if speeds_of_set else Fraction(1) for speeds_of_set in sets}
            if len(periods) == 1:
                known = periods.pop()
                return math.nan if known is None else float(known)
        return _traced_half_turns([x for x, _ in joints], [b != 0 for _, b in joints])

    def torques(self, theta: Components, rates: Components) -> list[Any]:
        """Torques of the shafts over speed^2: k theta/w^2 + c theta'/w."""
        w = self.speed
        return [k * x / w**2 + c * v / w for k, c, x, v in zip(self.k, self.c, theta, rates, strict=True)]

    def _slopes(self, theta: Components, rates: Components, ratios: Components, excess: Components) -> Array:
        """``y'`` for ``ratios`` h: theta_i'' = a_i'' - h_i a_{i-1}'' - excess_i, J_i a_i'' = -T_i + h_{i+1} T_{i+1}."""
        torques = [*self.torques(theta, rates), 0.0]
        onward = [*ratios[1:], 0.0]
        absolute = [
            (h * after - torque) / inertia
            for h, after, torque, inertia in zip(onward, torques[1:], torques, self.J, strict=False)
        ]
        before = [0.0, *absolute[:-1]]
        relative = [a - h * b - x for a, h, b, x in zip(absolute, ratios, before, excess, strict=True)]
        return jnp.stack(jnp.broadcast_arrays(*rates, *relative))

    def vector_field(self, tau: Any, y: Any) -> Array:
        """Nonlinear equations of motion, ``y' = f(tau, y)`` with ``y = (theta_0, ..., theta_0', ...)``, eqs (1)-(3).

        ``y`` has shape ``(2 N, ...)``.
        """
        count = len(self.k)
        theta, rates = list(y[:count]), list(y[count:])
        angle, rate, ratios, excess = tau, 1.0, [], []
        for b, p, r, twist, slope in zip(*self.chain, theta, rates, strict=True):
            eta, by_angle, _ = speed_ratio(b, angle + p)
            angle = r * behind(b, p, angle) + twist
            excess.append(r * by_angle * rate**2)
            ratios.append(r * eta)
            rate = ratios[-1] * rate + slope
        return self._slopes(theta, rates, ratios, excess)

    def linear_field(self, tau: Any, y: Any, forced: bool = True) -> Array:
        """Right-hand side of the linear equations (A) in twists, with the forcing f of the rigid motion if ``forced``."""
        count = len(self.k)
        theta, rates = list(y[:count]), list(y[count:])
        joints = rigid_motion(*self.chain, *clock(tau))
        x, v, excess = 0.0, 0.0, []
        for joint, twist, slope in zip(joints, theta, rates, strict=True):
            excess.append(2 * joint.slope * v + joint.curve * x + (joint.slope * joint.rate if forced else 0.0))
            x, v = twist + joint.h * x, slope + joint.h * v + joint.slope * x
        return self._slopes(theta, rates, [joint.h for joint in joints], excess)

    def _twist_rows(self, *at: Any) -> Rows:
        """The rows of (A) in twists."""
        unit = np.eye(2 * len(self.k))
        columns = [self.linear_field(at[0], list(column), forced=False) for column in unit]
        half = len(self.k)
        upper = tuple(tuple(1.0 if j == i + half else 0 for j in range(2 * half)) for i in range(half))
        return upper + tuple(tuple(column[half + i] for column in columns) for i in range(half))

    def _absolute(self, *at: Any) -> tuple[list[list[Any]], list[list[Any]]]:
        """E and P of q'' + E q' + P q = 0, q = J^(1/2) x."""
        w, k, c, inertia = self.speed, self.k, self.c, self.J
        damping, stiffness = ([[0] * len(k) for _ in k] for _ in range(2))
        for i, joint in enumerate(rigid_motion(*self.chain, *at, order=1)):
            damping[i][i] = c[i] / (w * inertia[i])
            stiffness[i][i] = k[i] / (w**2 * inertia[i])
            if i:
                j, root = i - 1, jnp.sqrt(inertia[i]) * jnp.sqrt(inertia[i - 1])
                damping[j][j] = damping[j][j] + joint.h**2 * c[i] / (w * inertia[j])
                both = joint.h * (joint.h * k[i] / w + joint.slope * c[i])
                stiffness[j][j] = stiffness[j][j] + both / (w * inertia[j])
                damping[i][j] = damping[j][i] = -joint.h * c[i] / (w * root)
                stiffness[j][i] = -joint.h * k[i] / (w**2 * root)
                stiffness[i][j] = stiffness[j][i] - joint.slope * c[i] / (w * root)
        return damping, stiffness

    def _rows(self, *at: Any) -> Rows:
        """``(q, q')' = A (q, q')`` of the absolute rotations, eq. (A)."""
        damping, stiffness = self._absolute(*at)
        n = len(damping)
        upper = tuple(tuple(1.0 if j == i + n else 0 for j in range(2 * n)) for i in range(n))
        return upper + tuple(tuple(-x for x in (*p, *e)) for p, e in zip(stiffness, damping, strict=True))

    def _reversal(self, half: Any) -> tuple[Rows, Rows]:
        """``R0`` and ``R1``, which lead from half a period to the period: N is even about both of its ends."""
        start, end = (self._absolute(*clock(tau))[0] for tau in (0.0, half))
        unit, none = np.eye(len(end)).tolist(), [0] * len(end)
        first = [none + u for u in unit] + [u + [-x for x in row] for u, row in zip(unit, start, strict=True)]
        last = [row + u for u, row in zip(unit, end, strict=True)] + [u + none for u in unit]
        return tuple(map(tuple, first)), tuple(map(tuple, last))

    @property
    def is_even(self) -> bool:
        """True if the rigid motion is odd in time: all joints have the phase 0 or pi/2."""
        beta, phase, _ = self.chain
        joints = [p for b, p in zip(beta, phase, strict=True) if not _is_straight(b)]
        return all(_is_number(p) and p == round(p / (math.pi / 2)) * (math.pi / 2) for p in joints)

    def log_determinant(self) -> Array:
        """Exact ``ln det Z`` over the period pi of a chain without gears (Liouville).

        Eq. (7): -(pi/w) sum c_i [1/J_i + r_i^2 m_i/J_{i-1}]; m_i is the mean of eta_i^2, from the image b of 0.
        """
        total, b = 0.0, 0j
        for i, (beta, phase, ratio) in enumerate(zip(*self.chain, strict=True)):
            rho = jnp.tan(beta / 2) ** 2
            s = -rho * jnp.exp(2j * phase) * b
            mean = (1 + rho**2) / (1 - rho**2) * ((1 + s) / (1 - s)).real + 2 * (s / (1 - s) ** 2).real
            share = 1 / self.J[i] + (ratio**2 * mean / self.J[i - 1] if i else 0.0)
            total = total + self.c[i] * share
            b = _moved(b, rho, phase)
        return jnp.asarray(-math.pi / self.speed * total)

    def panels(self, rtol: float) -> np.ndarray:
        """Panels over the marched span, from the largest frequency of two neighbouring inertias, the angles and the decay.

        Fitted to the chain of the benchmark and to 64 random chains of 2, 4 and 6 inertias each: 1.3, 1.3 and 2.4 times the
        need in the median. The prediction affects the cost, but never the accuracy, which the solver tests.
        """
        leaves = [self.speed, *self.k, *self.c, *self.J, *self.entries("beta"), *self.entries("ratio", 1.0)]
        xp, speed, *others = numeric(*leaves)
        n = len(self.k)
        k, c, inertia, beta, ratio = (others[i * n : (i + 1) * n] for i in range(5))
        cosines = [xp.cos(b) for b in beta]
        square = [r**2 * (1 + x**2) / (2 * x) for r, x in zip(ratio, cosines, strict=True)]

        def diagonal(spring: Sequence[Any]) -> list[Any]:
            onward = [s * x for s, x in zip(square[1:], spring[1:], strict=True)]
            return [(x + y) / j for x, y, j in zip(spring, [*onward, 0.0], inertia, strict=True)]

        stiff, largest, decay = diagonal(k), 0.0, 0.0
        for i, d in enumerate(diagonal(c)):
            largest, decay = xp.maximum(largest, stiff[i]), xp.maximum(decay, d)
            if i:
                half, mean = (stiff[i - 1] - stiff[i]) / 2, (stiff[i - 1] + stiff[i]) / 2
                largest = xp.maximum(
                    largest, mean + xp.sqrt(half**2 + square[i] * k[i] ** 2 / inertia[i - 1] / inertia[i])
                )
        time = math.pi * self.half_turns() / (2 if self.is_even else 1) / speed
        sharpness = sum(-xp.log(x) for x in cosines)
        light = 0.8 + 1.2 * (time * xp.sqrt(largest)) ** 1.2 + 2 * sharpness
        return light * (1e-9 / rtol) ** 0.1 + xp.sqrt(time * decay / 2)

    def is_hamiltonian(self) -> Any:
        """True without damping."""
        return sum(abs(c) for c in self.c) == 0

    @serves("frequency_response", check=check, parameters=_CHAIN, returns=ForcedModel)
    @serves("forced", check=check, parameters=_CHAIN)
    def forced_model(self) -> ForcedModel:
        """The nonlinear chain, and its linearisation (A) in twists with the forcing of the rigid motion."""
        count, period = len(self.k), math.pi * self.half_turns()
        torques = jnp.concatenate([jnp.diag(jnp.stack(x)) for x in (self.k, [self.speed * c for c in self.c])], axis=1)
        return ForcedModel(self.vector_field, self.linear_field, period, tuple(range(count)), 2 * count, torques)

    @serves("history", check=check)
    def flow(self) -> Flow:
        """The nonlinear equations with a strobe every period of the joints."""
        start = (*self.entries("theta_0"), *self.entries("theta_rate_0"))
        period = math.pi * self.half_turns()
        return Flow(Partial(type(self)._components, self, period / (2 * math.pi)), start, period=period, turns=(1,))

    def _components(self, unit: Any, angles: Components, y: Any) -> tuple[Any, ...]:
        """The components of ``y'``; the driving end turns by ``unit`` while the clock turns by 1."""
        return tuple(self.vector_field(unit * angles[0], y))

    @serves("floquet", check=check, parameters=_CHAIN)
    def floquet_model(self) -> FloquetModel:
        """The linearisation (A): in twists over its period, and in absolute rotations over half of it if that is enough."""

        def own(method: Callable[..., Any], *more: Any) -> Partial:
            return Partial(method, self, *more)

        kind, period = type(self), math.pi * self.half_turns()
        beta, _, ratio = self.chain
        exact = None if _gears(beta, ratio)[1] else own(kind.log_determinant)
        natural = LinearPeriodic(own(kind._twist_rows), period, clock, log_determinant=exact)
        span = period / 2 if self.is_even else period
        reversal = own(kind._reversal, span) if self.is_even else None
        reduced = LinearPeriodic(own(kind._rows), span, clock, log_determinant=exact, reversal=reversal)
        return FloquetModel(
            natural=natural, reduced=reduced, panels=own(kind.panels), hamiltonian=own(kind.is_hamiltonian)
        )

    @serves("phasing", check=check, parameters=("beta", "phase", "ratio"), results=PHASING, says=phasing_sentence)
    def phasing(self) -> dict[str, Any]:
        """Uneven rotation of the rigid output, and the phases that minimise it among joints at one speed."""
        beta, phase, ratio = self.chain
        best = best_phases(beta, phase, ratio)
        variation, angle = uneven_rotation(beta, phase, ratio, self.half_turns())
        least, _ = uneven_rotation(beta, best, ratio, self.half_turns())
        # Parts at different speeds, each made even as far as possible, may add up to more than before.
        best = [jnp.where(least > variation, jnp.mod(p, math.pi), x) for p, x in zip(phase, best, strict=True)]
        least = jnp.minimum(least, variation)
        return {"speed_variation": variation, "angle_variation": angle, "least_variation": least, "best_phase": best}

    @serves("modes", check=check, parameters=("k", "J", "ratio"))
    def springs(self) -> SpringSystem:
        """The chain with straight joints as masses and springs: the twists are N a with the plain ratios."""
        n, ratio = len(self.k), self.entries("ratio", 1.0)
        shape = jnp.broadcast_shapes(*map(jnp.shape, (*self.k, *self.J, *ratio)))

        def spread(entries: Components) -> Array:
            return jnp.stack([jnp.broadcast_to(jnp.asarray(x, float), shape) for x in entries])

        stiffness, mass = spread(self.k), spread(self.J)
        rows = [[1.0 if i == j else -ratio[i] if i == j + 1 else 0.0 for j in range(n)] for i in range(n)]
        extensions = jnp.stack(list(map(spread, rows)))
        factor = weighted_factor(extensions, stiffness, mass)
        identity = np.eye(n).reshape(n, n, 1, *(1,) * len(shape))
        whole = Block(factor, np.zeros(n, int), np.zeros(n, bool), jnp.broadcast_to(identity, (n, n, 1, *shape)))
        names, inertias = (tuple(f"{name}_{i}" for i in range(n)) for name in ("a", "inertia"))
        zero, numbers = jnp.zeros(shape), np.arange(n)
        return SpringSystem(extensions, stiffness, mass, (whole,), whole, zero, names, inertias, numbers, 1)
