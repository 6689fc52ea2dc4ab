"""Independent solvers of the gear-rattle equation without jax: oracle of the tests and rivals of the benchmarks.

    u'' + (c/I) u' + (k/I) f(u) = B0 + B1 cos(omega t),
    f = u - (1 - alpha) b for u > b, alpha u for |u| <= b, u + (1 - alpha) b for u < -b.

``extended`` goes from event to event in extended precision (80 bits). The general solution of each region comes from its
complex roots; events are bracketed by dense samples of u and of its extremes, then bisected. ``scipy_events`` integrates
each region with SciPy and its event location. ``scipy_plain`` integrates across the kinks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

Real = np.longdouble
Complex = np.clongdouble
# Samples per radian of the fastest motion, and samples per evaluation.
_DENSITY, _BATCH = 6, 256


@dataclass(frozen=True)
class _Region:
    """General solution ``q(t) + c1 exp(l1 t) + c2 exp(l2 t)`` (``l1 = 0`` and a drift if the stiffness is 0)."""

    stiffness: np.longdouble
    damping: np.longdouble
    force: np.longdouble
    amplitude: np.longdouble
    omega: np.longdouble

    @property
    def roots(self) -> tuple:
        """Exponents of the free motion, the slower one first."""
        half = self.damping / 2
        root = np.sqrt(Complex(half * half - self.stiffness))
        fast = -half - root if (half + root).real >= (half - root).real else -half + root
        return self.stiffness / fast, fast

    def transition(self, elapsed: np.longdouble) -> np.ndarray:
        """Derivatives of ``u, v`` after ``elapsed`` by those at the start."""
        slow, fast = self.roots
        a, b = np.exp(slow * elapsed), np.exp(fast * elapsed)
        rows = [slow * b - fast * a, a - b], [slow * fast * (b - a), slow * a - fast * b]
        return np.array(rows / (slow - fast)).real

    def start(self, t: np.longdouble, u: np.longdouble, v: np.longdouble) -> Callable[[np.ndarray], tuple]:
        """``u, v`` as functions of the time elapsed since ``t``."""
        slow, fast = self.roots
        response = Complex(self.amplitude) / (self.stiffness - self.omega**2 + Complex(1j) * self.damping * self.omega)
        drift = Real(0) if self.stiffness else self.force / self.damping
        rest = self.force / self.stiffness if self.stiffness else Real(0)
        phase = np.exp(Complex(1j) * self.omega * t)
        x = Complex(u - rest - (response * phase).real)
        y = Complex(v - drift - (Complex(1j) * self.omega * response * phase).real)
        first = (y - fast * x) / (slow - fast)
        second = x - first

        def at(elapsed: np.ndarray) -> tuple:
            wave = response * phase * np.exp(Complex(1j) * self.omega * elapsed)
            one, two = first * np.exp(slow * elapsed), second * np.exp(fast * elapsed)
            position = (wave + one + two).real + rest + drift * elapsed
            velocity = (Complex(1j) * self.omega * wave + slow * one + fast * two).real + drift
            return position, velocity

        return at

    def acceleration(self, at: Callable, elapsed: np.longdouble) -> np.longdouble:
        """Slope of the velocity of ``at`` by a central difference, accurate enough for Newton's method."""
        h = Real(1e-7) / self.pace
        return (at(elapsed + h)[1] - at(elapsed - h)[1]) / (2 * h)

    @property
    def pace(self) -> float:
        """Fastest angular frequency or rate."""
        half = float(self.damping) / 2
        return max(float(self.omega), math.sqrt(abs(half**2 - float(self.stiffness))) + half)


def _zero(function: Callable, low: np.longdouble, high: np.longdouble) -> np.longdouble:
    """A zero of ``function`` (which returns value and slope) between ``low`` and ``high``, where it changes sign.

    The method is Newton's iteration, with bisection where it leaves the bracket; the result is on the side of ``high``.
    """
    sign = np.sign(function(low)[0])
    guess = (low + high) / 2
    for _ in range(100):
        value, slope = function(guess)
        if np.sign(value) == sign:
            low = guess
        else:
            high = guess
        if high - low <= 4 * np.spacing(high):
            break
        newton = guess - value / slope if slope else low
        # A step beyond the zero, so that the bracket closes from both sides.
        newton += np.spacing(high) * (2 if newton <= guess else -2) * (1 if newton != guess else 0)
        guess = newton if low < newton < high and abs(newton - guess) < (high - low) / 2 else (low + high) / 2
    return high


def _exit(at: Callable, region: _Region, bounds: tuple, span: np.longdouble) -> np.longdouble:
    """Time until the motion leaves ``bounds``, at most ``span``."""
    step = Real(1 / (_DENSITY * region.pace))
    begin, batch = Real(0), 16
    while begin < span:
        times = np.minimum(begin + step * np.arange(batch + 1), span)
        u, v = at(times)
        reach = 2 * step * np.minimum(np.abs(v[1:]), np.abs(v[:-1]))
        peak = (v[1:] * v[:-1] < 0) & (
            (np.maximum(u[1:], u[:-1]) + reach > bounds[1]) | (np.minimum(u[1:], u[:-1]) - reach < bounds[0])
        )
        for i in np.flatnonzero((u[1:] > bounds[1]) | (u[1:] < bounds[0]) | peak):
            low, high = times[i], times[i + 1]
            if bounds[0] <= u[i + 1] <= bounds[1]:
                # An extreme in between may lie beyond a flank although both samples do not.
                high = _zero(lambda t: (at(t)[1], region.acceleration(at, t)), low, high)
                if bounds[0] <= at(high)[0] <= bounds[1]:
                    continue
            flank = bounds[1] if at(high)[0] > bounds[1] else bounds[0]
            return (
                _zero(lambda t, f=flank: (at(t)[0] - f, at(t)[1]), low, high)
                if i or begin
                else _leave(at, flank, low, high)
            )
        begin, batch = times[-1], min(2 * batch, _BATCH)
    return span


def _leave(at: Callable, flank: np.longdouble, low: np.longdouble, high: np.longdouble) -> np.longdouble:
    """The exit within the first sample, at the start of which the motion may be on this flank."""
    outside = np.sign(at(high)[0] - flank)
    for _ in range(80):
        middle = (low + high) / 2
        if middle in (low, high):
            break
        low, high = (low, middle) if np.sign(at(middle)[0] - flank) == outside else (middle, high)
    return high


def _regions(values: Mapping[str, float]) -> dict[int, tuple[_Region, tuple]]:
    mass, b = Real(values["I"]), Real(values["b"])
    stiffness, damping = Real(values["k"]) / mass, Real(values["c"]) / mass
    alpha, mean = Real(values["alpha"]), Real(values["B0"])
    rest = (Real(values["B1"]), Real(values["omega"]))
    push = stiffness * (1 - alpha) * b
    infinity = Real(np.inf)
    return {
        1: (_Region(stiffness, damping, mean + push, *rest), (b, infinity)),
        0: (_Region(alpha * stiffness, damping, mean, *rest), (-b, b)),
        -1: (_Region(stiffness, damping, mean - push, *rest), (-infinity, -b)),
    }


def extended(values: Mapping[str, float], u0: float, v0: float, periods: int) -> tuple[float, float, int]:
    """``u, v`` after ``periods`` drive periods and the number of flank crossings. Needs c > 0."""
    u, v, crossings, _ = extended_motion(values, u0, v0, periods)
    return float(u), float(v), crossings


def extended_motion(
    values: Mapping[str, float], u0: float, v0: float, periods: int
) -> tuple[np.longdouble, np.longdouble, int, np.ndarray]:
    """:func:`extended` without rounding at the end, and the derivatives of ``u, v`` by ``u0, v0``.

    The restoring force is continuous at a flank, and so are the derivatives.
    """
    regions, b = _regions(values), Real(values["b"])
    period = 2 * np.arctan2(Real(0), Real(-1)) / Real(values["omega"])
    u, v, crossings, matrix = Real(u0), Real(v0), 0, np.eye(2, dtype=Real)
    side = 1 if u > b else -1 if u < -b else 0
    for _ in range(periods):
        t = Real(0)
        while t < period:
            region, bounds = regions[side]
            at = region.start(t, u, v)
            elapsed = _exit(at, region, bounds, period - t)
            u, v = at(elapsed)
            matrix = region.transition(elapsed) @ matrix
            if elapsed >= period - t:
                break
            t += elapsed
            crossings += 1
            # The bisection ends beyond the flank.
            side = 1 if u > b else -1 if u < -b else 0
    return u, v, crossings, matrix


def field(values: Mapping[str, float], side: int | None = None) -> Callable:
    """``(u', u'')``; with ``side`` the linear region on this side applies everywhere."""
    mass, b, alpha = values["I"], values["b"], values["alpha"]
    c, k, mean, drive, omega = values["c"] / mass, values["k"] / mass, values["B0"], values["B1"], values["omega"]

    def spring(u: float) -> float:
        here = side if side is not None else (1 if u > b else -1 if u < -b else 0)
        return u - here * (1 - alpha) * b if here else alpha * u

    return lambda t, y: [y[1], mean + drive * math.cos(omega * t) - c * y[1] - k * spring(y[0])]


def scipy_plain(
    values: Mapping[str, float], u0: float, v0: float, periods: int, rtol: float, method: str = "DOP853"
) -> tuple[float, float]:
    """State after ``periods`` drive periods, integrated across the kinks."""
    end = 2 * math.pi / values["omega"] * periods
    solution = solve_ivp(field(values), (0, end), [u0, v0], method=method, rtol=rtol, atol=1e-3 * rtol)
    return float(solution.y[0, -1]), float(solution.y[1, -1])


def scipy_events(
    values: Mapping[str, float], u0: float, v0: float, periods: int, rtol: float, method: str = "DOP853"
) -> tuple[float, float]:
    """State after ``periods`` drive periods, with a separate integration of each region up to a terminal event."""
    b, end = values["b"], 2 * math.pi / values["omega"] * periods
    t, state = 0.0, [u0, v0]
    side = 1 if u0 > b else -1 if u0 < -b else 0

    def event(level: float, direction: int) -> Callable:
        def distance(_: float, y: np.ndarray) -> float:
            return y[0] - level

        distance.terminal, distance.direction = True, direction
        return distance

    exits = {1: [event(b, -1)], 0: [event(b, 1), event(-b, -1)], -1: [event(-b, 1)]}
    while t < end:
        solution = solve_ivp(
            field(values, side), (t, end), state, method=method, rtol=rtol, atol=1e-3 * rtol, events=exits[side]
        )
        t, state = float(solution.t[-1]), solution.y[:, -1].tolist()
        if solution.status == 1:
            passed = next(k for k, times in enumerate(solution.t_events) if len(times))
            side, state[0] = (0, side * b) if side else (1 - 2 * passed, (1 - 2 * passed) * b)
    return state[0], state[1]


def random_case(rng: np.random.Generator) -> tuple[dict[str, float], float, float, int]:
    """Random parameters over the whole range of the model, initial states and numbers of periods.

    alpha 0..2 (each of 0 and 1 in a tenth of the cases), k 1..1e6, b 0..1 (0 in 3 %), c 1e-3..1, some overdamped.
    """
    stiffness = 10 ** rng.uniform(0, 6) if rng.random() < 0.8 else 1.0
    alpha = rng.choice([0.0, 1.0, rng.uniform(0, 2)], p=[0.1, 0.1, 0.8])
    b = 0.0 if rng.random() < 0.03 else rng.uniform(0, 1) ** 2
    c = 10 ** rng.uniform(-3, 0)
    if rng.random() < 0.1:
        c = 2 * math.sqrt(stiffness) * 10 ** rng.uniform(-0.3, 0.5)
    values = {
        # Limit the frequency ratio: motions much faster than the drive would take the oracle too long.
        "omega": 0.25 * stiffness**0.2 * 10 ** rng.uniform(0, 1.2),
        "B0": rng.uniform(-0.1, 0.3),
        "B1": rng.uniform(0, 0.5),
        "b": b,
        "c": c,
        "alpha": float(alpha),
        "k": stiffness,
        "I": 1.0,
    }
    reach = b + 0.5 / math.sqrt(stiffness) if alpha == 0 else min(b, 0.5 / math.sqrt(alpha * stiffness))
    periods = 4 if stiffness < 1e3 else 1
    return values, rng.uniform(-1, 1) * (reach + 0.3 / math.sqrt(stiffness)), rng.uniform(-0.5, 0.5), periods
