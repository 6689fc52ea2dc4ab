"""Real numbers of 31 digits with bounds of their rounding errors, for NumPy arrays (ball arithmetic, Johansson 2017).

A ball is an unevaluated sum ``high + low`` of two doubles (Dekker 1971) with a radius: the exact number differs from the
sum by at most the radius. A sign is decided where the ball excludes zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

# Bound of the rounding error of one operation, relative to the operands (7 2^-106, Joldes et al. 2017).
_UNIT = 2.0**-103
_SPLITTER = 2.0**27 + 1
# Factor that covers the rounding of a radius itself.
_OUTWARD = 1 + 2.0**-40
# Parts of pi, of pi/2 and of ln 2; the third part is below the radius of a ball.
_PI = (3.141592653589793, 1.2246467991473532e-16)
_LOG_2 = (0.6931471805599453, 2.3190468138462996e-17)


def _two_sum(a: Any, b: Any) -> tuple[Any, Any]:
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _quick_two_sum(a: Any, b: Any) -> tuple[Any, Any]:
    total = a + b
    return total, b - (total - a)


def _split(a: Any) -> tuple[Any, Any]:
    scaled = _SPLITTER * a
    high = scaled - (scaled - a)
    return high, a - high


def _two_product(a: Any, b: Any) -> tuple[Any, Any]:
    product = a * b
    (a1, a2), (b1, b2) = _split(a), _split(b)
    return product, ((a1 * b1 - product) + a1 * b2 + a2 * b1) + a2 * b2


class Ball:
    """Arrays of balls; doubles and integers below 2^53 are exact."""

    # NumPy leaves operations with arrays to this class.
    __array_ufunc__ = None
    __slots__ = ("high", "low", "radius")

    def __init__(self, high: Any, low: Any = 0.0, radius: Any = 0.0) -> None:
        self.high, self.low, self.radius = high, low, radius

    def __add__(self, other: Any) -> Ball:
        other = ball(other)
        high, low = _two_sum(self.high, other.high)
        size = np.abs(self.high) + np.abs(other.high)
        return Ball(
            *_quick_two_sum(high, low + (self.low + other.low)), (self.radius + other.radius + _UNIT * size) * _OUTWARD
        )

    def __neg__(self) -> Ball:
        return Ball(-self.high, -self.low, self.radius)

    def __sub__(self, other: Any) -> Ball:
        return self + -ball(other)

    def __rsub__(self, other: Any) -> Ball:
        return -self + other

    def __mul__(self, other: Any) -> Ball:
        other = ball(other)
        high, low = _two_product(self.high, other.high)
        high, low = _quick_two_sum(high, low + (self.high * other.low + self.low * other.high))
        a, b = np.abs(self.high), np.abs(other.high)
        # Factors (1 + 2^-40) also cover the low parts, at most 2^-53 of the high ones.
        radius = a * other.radius + self.radius * (b + other.radius) + _UNIT * np.abs(high)
        return Ball(high, low, radius * _OUTWARD)

    def __truediv__(self, other: Any) -> Ball:
        other = ball(other)
        first = self.high / other.high
        rest = Ball(self.high, self.low) - Ball(other.high, other.low) * first
        second = rest.high / other.high
        rest = rest - Ball(other.high, other.low) * second
        high, low = _quick_two_sum(*_quick_two_sum(first, second + rest.high / other.high))
        size, least = np.abs(high), np.abs(other.high) / _OUTWARD - other.radius
        radius = np.where(least > 0, (self.radius + size * other.radius) / least + 8 * _UNIT * size, np.inf)
        return Ball(high, low, radius * _OUTWARD)

    def __rtruediv__(self, other: Any) -> Ball:
        return ball(other) / self

    __radd__, __rmul__ = __add__, __mul__

    @property
    def decided(self) -> np.ndarray:
        """True where zero is excluded, and the sign of ``high`` is that of the number."""
        return np.abs(self.high) > self.radius * _OUTWARD


def ball(value: Any) -> Ball:
    """``value`` as a ball: an exact double, or a ball unchanged."""
    return value if isinstance(value, Ball) else Ball(value)


def _constant(value: Fraction) -> Ball:
    high = float(value)
    low = float(value - Fraction(high))
    return Ball(high, low, _UNIT * abs(high))


def choose(condition: np.ndarray, yes: Ball, no: Ball) -> Ball:
    """``numpy.where`` for balls."""
    return Ball(*(np.where(condition, getattr(yes, part), getattr(no, part)) for part in Ball.__slots__))


def series(x: Ball, coefficients: Sequence[Fraction], remainder: Any = 0.0) -> Ball:
    """The polynomial with these coefficients, constant first; ``remainder`` widens the ball."""
    total = _constant(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + _constant(coefficient)
    return Ball(total.high, total.low, total.radius + remainder)


def sqrt(x: Ball) -> Ball:
    """The square root of positive balls, by Newton's step from the double."""
    guess = np.sqrt(x.high)
    root = (Ball(x.high, x.low) / guess + guess) * 0.5
    # The step leaves an error of eps^2 guess/8; the derivative of the root is at most 1/guess where x > 0 is decided.
    radius = np.where(x.decided, root.radius + 2.0**-100 * guess + x.radius / guess, np.inf)
    return Ball(root.high, root.low, radius)


def _reduced(x: Ball, unit: Ball) -> tuple[np.ndarray, Ball]:
    number = np.rint(x.high / unit.high)
    return number, x - unit * number


def _sine_and_cosine(x: Ball) -> tuple[Ball, Ball]:
    half_pi = Ball(_PI[0] / 2, _PI[1] / 2, 2.0**-106)
    quarter, rest = _reduced(x, half_pi)
    square = rest * rest
    # |rest| < 0.8: the next terms are below 0.8^32/32!.
    s = rest * series(square, [Fraction((-1) ** k, math.factorial(2 * k + 1)) for k in range(16)], 1e-37)
    c = series(square, [Fraction((-1) ** k, math.factorial(2 * k)) for k in range(16)], 1e-37)
    turn = np.mod(quarter, 4)
    odd = np.mod(turn, 2) == 1
    sine, cosine = choose(odd, c, s), choose(odd, s, c)
    return choose(turn >= 2, -sine, sine), choose((turn == 1) | (turn == 2), -cosine, cosine)


def sin(x: Any) -> Ball:
    """The sine of balls below 1e3."""
    return _sine_and_cosine(ball(x))[0]


def cos(x: Any) -> Ball:
    """The cosine of balls below 1e3."""
    return _sine_and_cosine(ball(x))[1]


def exp(x: Any) -> Ball:
    """The exponential of balls between -600 and 600."""
    number, rest = _reduced(ball(x), Ball(*_LOG_2, 2.0**-108))
    # |rest| < 0.35: the next term is below 0.35^25/25!.
    root = series(rest, [Fraction(1, math.factorial(k)) for k in range(25)], 1e-36)
    scale = np.exp2(number)
    return Ball(root.high * scale, root.low * scale, root.radius * scale)


PI = Ball(*_PI, 2.0**-105)


def negative_pivots(matrix: list[list[Ball]]) -> tuple[np.ndarray, np.ndarray]:
    """The number of negative eigenvalues of symmetric matrices, and flags where it is decided; Sylvester's law of inertia.

    The entries of ``matrix`` are arrays of balls, of which the upper triangle is used and overwritten.
    """
    size = len(matrix)
    count, decided = 0, True
    for a in range(size):
        pivot = matrix[a][a]
        count, decided = count + (pivot.high < 0), decided & pivot.decided
        filled = [b for b in range(a + 1, size) if np.any(matrix[a][b].high)]
        for b in filled:
            factor = matrix[a][b] / pivot
            for c in filled:
                if c >= b:
                    matrix[b][c] = matrix[b][c] - factor * matrix[a][c]
    return np.asarray(count), np.asarray(decided)
