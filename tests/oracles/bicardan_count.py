"""Number of natural frequencies of a stepped shaft below a frequency, to hundreds of digits (Wittrick & Williams 1971).

The dynamic stiffness of every Bernoulli-Euler segment, in mpmath, is summed to that of the shaft. The count is that of its
negative pivots and of the clamped frequencies of the segments. It shares nothing with the analysis but the theorem.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mpmath
from mpmath import mpf

DIGITS = 250


def _segment(q: Any, length: Any, EI: Any, rhoA: Any) -> tuple[list[list[Any]], int]:
    """The dynamic stiffness of a segment at ``p = q^2``, and its number of clamped frequencies below."""
    z = q * mpmath.root(rhoA / EI, 4) * length
    if z == 0:
        k, own = EI / length**3, 0
        ww, wt, tt, wW, wT, tT = 12 * k, 6 * length * k, 4 * length**2 * k, -12 * k, 6 * length * k, 2 * length**2 * k
    else:
        a, c, s, up = z / length, mpmath.cos(z), mpmath.sin(z), mpmath.exp(z)
        ch, sh = (up + 1 / up) / 2, (up - 1 / up) / 2
        d = 1 - c * ch
        k = EI * a / d
        ww, wt, tt = k * a**2 * (c * sh + s * ch), k * a * s * sh, k * (s * ch - c * sh)
        wW, wT, tT = -k * a**2 * (s + sh), k * a * (ch - c), k * (sh - s)
        half_waves = int(mpmath.floor(z / mpmath.pi))
        own = half_waves - int((1 - (-1) ** half_waves * mpmath.sign(d)) / 2)
    return [[ww, wt, wW, wT], [wt, tt, -wT, tT], [wW, -wT, ww, -wt], [wT, tT, -wt, tt]], own


def _negative_pivots(matrix: Any) -> int:
    count = 0
    for a in range(matrix.rows):
        count += matrix[a, a] < 0
        for b in range(a + 1, matrix.rows):
            factor = matrix[b, a] / matrix[a, a]
            for c in range(a + 1, matrix.rows if factor else 0):
                matrix[b, c] -= factor * matrix[a, c]
    return count


def frequencies_below(p: Any, shaft: Mapping[str, Any]) -> int:
    """Number of natural angular frequencies below ``p`` > 0; ``shaft`` has the parameters of the system but shear and
    rotary inertia of segments."""
    segments = len(shaft["length"])
    joints = segments - 1
    # Rotations in front of and behind a joint with a finite stiffness are separate.
    springs = {i + 1: k for i, k in enumerate(shaft.get("k_hinge", ())) if mpmath.isfinite(k)}
    first = [2 * i + sum(joint < i for joint in springs) for i in range(segments + 1)]
    ahead = [n + 1 for n in first]
    behind = [n + 1 + (i in springs) for i, n in enumerate(first)]
    with mpmath.workdps(DIGITS):
        p = mpf(p)
        total, count = mpmath.zeros(behind[-1] + 1), 0
        for i in range(segments):
            stiffness, own = _segment(mpmath.sqrt(p), *(mpf(shaft[name][i]) for name in ("length", "EI", "rhoA")))
            places, count = (first[i], behind[i], first[i + 1], ahead[i + 1]), count + own
            for a in range(4):
                for b in range(4):
                    total[places[a], places[b]] += stiffness[a][b]
        none = (0.0,) * joints
        for held, loads, places in (("k", "m", first), ("k_rot", "I", ahead)):
            stiffness, mass = (
                (shaft.get(f"{x}_A", 0.0), *shaft.get(f"{x}_joint", none), shaft.get(f"{x}_D", 0.0))
                for x in (held, loads)
            )
            for i, place in enumerate(places):
                total[place, place] += mpf(stiffness[i]) - p * p * mpf(mass[i])
        for joint, k in springs.items():
            for a, b, sign in ((ahead, ahead, 1), (behind, behind, 1), (ahead, behind, -1), (behind, ahead, -1)):
                total[a[joint], b[joint]] += sign * mpf(k)
        return count + _negative_pivots(total)
