"""Numbers of natural frequencies below a frequency, certified by ball arithmetic, for arrays of gears and of shafts.

A function returns the numbers and flags where rounding cannot have changed them. Independent of the package: stiffness
matrices from the equations of motion (gears), Wittrick & Williams 1971 with the dynamic stiffness of segments (shafts).
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import factorial
from typing import Any

import numpy as np

from tests.oracles import ball_arithmetic
from tests.oracles.ball_arithmetic import PI, Ball, ball, choose, cos, exp, negative_pivots, series, sin, sqrt
from tests.oracles.planetary_reference import matrices

# Phase of a segment up to which power series replace differences of functions, and number of their terms.
_SHORT, _TERMS = 2.0, 13
Count = tuple[np.ndarray, np.ndarray]


def gear_frequencies_below(frequency: Ball, gear: Mapping[str, Any], planets_first: bool = True) -> Count:
    """Numbers of natural frequencies of gears below ``frequency`` [Hz].

    ``gear`` has arrays by name, ``planet_angle`` as a list of arrays. Elimination of the planets first takes a third of the
    time, but its pivots are undecided next to a frequency of a planet alone.
    """
    angles = [ball(angle) for angle in gear["planet_angle"]]
    others = {name: ball(x) for name, x in gear.items() if name != "planet_angle"}
    mass, stiffness = matrices({"planet_angle": angles, **others}, ball_arithmetic)
    planets = range(9, len(mass))
    order = [*planets, *range(9)] if planets_first else [*range(9), *planets]
    shifted = [[stiffness[row][column] for column in order] for row in order]
    square = 4 * PI * PI * frequency * frequency
    for place, dof in enumerate(order):
        shifted[place][place] = shifted[place][place] - square * mass[dof]
    return negative_pivots(shifted)


def _powers(z: Ball, first: int, factor: int, leading: int) -> Ball:
    """``leading sum factor^k z^(4 k + first)/(4 k + first)!`` up to the phase 2."""
    square = z * z
    terms = [Fraction(leading * factor**k, factorial(4 * k + first)) for k in range(_TERMS)]
    total = series(square * square, terms, 1e-40)
    for _ in range(first):
        total = total * z
    return total


def _frequency_functions(z: Ball) -> list[Ball]:
    """``1 - cos ch, cos sh + sin ch, sin sh, sin ch - cos sh, sin + sh, ch - cos, sh - sin`` of z."""
    short = z.high <= _SHORT
    small, large = choose(short, z, Ball(1.0)), choose(short, Ball(_SHORT), z)
    c, s, up = cos(large), sin(large), exp(large)
    ch, sh = (up + 1 / up) * 0.5, (up - 1 / up) * 0.5
    long = (1 - c * ch, c * sh + s * ch, s * sh, s * ch - c * sh, s + sh, ch - c, sh - s)
    kinds = ((4, -4, 4), (1, -4, 2), (2, -4, 2), (3, -4, 4), (1, 1, 2), (2, 1, 2), (3, 1, 2))
    return [choose(short, _powers(small, *kind), far) for kind, far in zip(kinds, long, strict=True)]


def _segment(q: Ball, length: Ball, EI: Ball, rhoA: Ball) -> tuple[list[list[Ball]], np.ndarray, np.ndarray]:
    """The dynamic stiffness of a segment, its number of clamped frequencies below ``p = q^2``, and where it is decided."""
    z = q * sqrt(sqrt(rhoA / EI)) * length
    d, sums, product, differences, S, T, U = _frequency_functions(z)
    a = z / length
    k = EI * a / d
    force, moment = k * a * a, k * a
    ww, wt, tt, wW, wT, tT = force * sums, moment * product, k * differences, -force * S, moment * T, k * U
    turns = z / PI
    half_waves = np.floor(turns.high)
    clear = d.decided & (turns - np.rint(turns.high)).decided
    own = half_waves - (1 - np.where(half_waves % 2 == 0, 1, -1) * np.sign(d.high)) / 2
    return [[ww, wt, wW, wT], [wt, tt, -wT, tT], [wW, -wT, ww, -wt], [wT, tT, -wt, tt]], own, clear


def shaft_frequencies_below(frequency: Ball, shaft: Mapping[str, Any]) -> Count:
    """Numbers of natural angular frequencies of stepped shafts below ``frequency`` [rad/s].

    ``shaft`` has ``length``, ``EI``, ``rhoA`` as lists of arrays, one a segment, and arrays ``k_A`` and ``k_D``.
    """
    segments = len(shaft["length"])
    q = sqrt(frequency)
    total: list[list[Any]] = [[Ball(0.0)] * (2 * segments + 2) for _ in range(2 * segments + 2)]
    count, decided = 0, True
    for i in range(segments):
        stiffness, own, clear = _segment(q, *(ball(shaft[name][i]) for name in ("length", "EI", "rhoA")))
        count, decided = count + own, decided & clear
        for a in range(4):
            for b in range(4):
                total[2 * i + a][2 * i + b] = total[2 * i + a][2 * i + b] + stiffness[a][b]
    total[0][0] = total[0][0] + shaft["k_A"]
    total[-2][-2] = total[-2][-2] + shaft["k_D"]
    pivots, clear = negative_pivots(total)
    return count + pivots, decided & clear
