"""The kind of a motion, by a rule that a diffuse picture or a single number cannot satisfy.

The verdict is undecided if the steps do not resolve the motion. A chaotic motion meets all of these conditions: it is
bounded, its field can be chaotic, the largest exponent exceeds three standard errors and agrees for two step sizes, the
exponents sum to the mean divergence, and the 0-1 test gives K > 0.9. Exponents of phases are ignored.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.analysis.lyapunov.growth_record import SEGMENTS, STANDARD_ERRORS, SUM_RULE, significant, zero_floor

CHAOTIC_K = 0.9
# Least logarithmic growth that counts as exponential, over the averaged three quarters of the time: twice that of growth in
# proportion to time, as at a double multiplier, which is a factor of four.
TELLING = 2 * math.log(4)


class Verdict(IntEnum):
    """Kinds of motion. Fixed point, periodic and quasi-periodic describe the section of a forced system, whose fixed points
    have the period of the strobe, and the motion itself of an unforced system."""

    FIXED_POINT = 0
    PERIODIC = 1
    QUASI_PERIODIC = 2
    PARAMETRICALLY_UNSTABLE = 3
    CHAOTIC = 4
    UNDECIDED = 5


class Evidence(NamedTuple):
    """Input of the verdict; ``m`` exponents without phases, in falling order.

    ``spectrum``, ``error`` (m, ...): exponents and standard errors; ``coarse``, ``coarse_error`` (...): the largest exponent
    with twice the step, and its error; ``sum_residual``: residual of the sum rule; ``k01``: K of the 0-1 test;
    ``bounded``: true if the motion stays bounded; ``following``: see :func:`follows`; ``multiple``: strobes of the motion's
    orbit, 0 if none is found; ``aperiodic``: true if the clocks have no common period; ``returns``: true if the motion comes
    close to itself again and again without repeating, as on a torus; ``resolved``: see :func:`~.resolution.resolved`;
    ``roomy``: true if the field can be chaotic.
    """

    spectrum: Array
    error: Array
    coarse: Array
    coarse_error: Array
    sum_residual: Array
    k01: Array
    bounded: Array
    following: Array
    multiple: Array
    aperiodic: Array
    returns: Array
    resolved: Array
    roomy: Array


def follows(size: Array, used: Array, span: Array, largest: Array) -> Array:
    """Flags where the motion grew or shrank about as fast as its largest exponent, or stayed at rest.

    ``size`` (SEGMENTS, ...): largest component in each segment. A chaotic attractor also has a positive exponent, but its
    size does not grow. A change so small that it may be in proportion to time does not count.
    """
    index = jnp.arange(SEGMENTS).reshape(-1, *(1,) * used.ndim)
    last = jnp.maximum(used - 1, 0)
    begin, end = (jnp.sum(jnp.where(index == i, size, 0.0), axis=0) for i in (used // 4, last))
    time = (last - used // 4) * span
    ratio = jnp.log(jnp.where((begin > 0) & (end > 0), end / jnp.where(begin > 0, begin, 1.0), 1.0))
    at_rest = jnp.max(size, axis=0) == 0
    predicted = largest * time
    return (at_rest | (ratio * jnp.sign(predicted) > 0.5 * abs(predicted))) & (abs(predicted) > TELLING)


def judge(evidence: Evidence, autonomous: bool) -> Array:
    """The verdict, int8 of shape (...)."""
    regular = _autonomous(evidence) if autonomous else _forced(evidence)
    regular = jnp.where(evidence.bounded, regular, Verdict.UNDECIDED)
    positive = significant(evidence.spectrum, evidence.error)
    verdict = jnp.where(positive, jnp.where(_chaotic(evidence), Verdict.CHAOTIC, Verdict.UNDECIDED), regular)
    verdict = jnp.where(_unstable(evidence), Verdict.PARAMETRICALLY_UNSTABLE, verdict)
    sound = evidence.resolved & jnp.all(jnp.isfinite(evidence.spectrum), axis=0)
    return jnp.where(sound, verdict, Verdict.UNDECIDED).astype(jnp.int8)


def _unstable(evidence: Evidence) -> Array:
    """Flags of motions that grow by a positive exponent; a torque may also drive a stable system beyond the bounds."""
    left = ~evidence.bounded & (evidence.spectrum[0] > 0)
    return left | (significant(evidence.spectrum, evidence.error) & evidence.following)


def _chaotic(evidence: Evidence) -> Array:
    """Flags where all conditions of chaos hold, for motions whose largest exponent is positive."""
    chaotic = evidence.bounded & evidence.roomy & (evidence.k01 > CHAOTIC_K)
    chaotic &= evidence.coarse > STANDARD_ERRORS * evidence.coarse_error
    return chaotic & (evidence.sum_residual <= SUM_RULE * jnp.max(jnp.abs(evidence.spectrum), axis=0))


def _forced(evidence: Evidence) -> Array:
    """Kind of an attracting motion, from its orbit, or from clocks that never repeat.

    A motion with a frequency of its own has one zero exponent. It is a torus if it also returns, which a decay slower than
    exponential does not.
    """
    zeros = _zeros(evidence)
    decays = evidence.spectrum[0] < -STANDARD_ERRORS * evidence.error[0] - zero_floor(evidence.spectrum)
    kind = jnp.where(evidence.aperiodic, Verdict.QUASI_PERIODIC, Verdict.UNDECIDED)
    kind = jnp.where(evidence.multiple > 1, Verdict.PERIODIC, kind)
    kind = jnp.where(evidence.multiple == 1, Verdict.FIXED_POINT, kind)
    torus = zeros[0] & (jnp.sum(zeros, axis=0) == 1) & evidence.returns & (evidence.k01 < 1 - CHAOTIC_K)
    kind = jnp.where(decays, kind, Verdict.UNDECIDED)
    return jnp.where(torus, Verdict.QUASI_PERIODIC, kind)


def _zeros(evidence: Evidence) -> Array:
    """Flags of exponents that are zero within their errors, (m, ...)."""
    return jnp.abs(evidence.spectrum) <= STANDARD_ERRORS * evidence.error + zero_floor(evidence.spectrum)


def _autonomous(evidence: Evidence) -> Array:
    """Kind of an unforced motion by its zero exponents: none at rest, one of a periodic motion, more of a torus.

    A plane has no torus: a motion in a plane with two zero exponents is degenerate, or drifts too slowly to decide.
    """
    zeros = _zeros(evidence)
    count = jnp.sum(zeros, axis=0)
    torus = jnp.where(evidence.roomy, Verdict.QUASI_PERIODIC, Verdict.UNDECIDED)
    kind = jnp.where(count == 0, Verdict.FIXED_POINT, jnp.where(count == 1, Verdict.PERIODIC, torus))
    sound = ~jnp.isnan(evidence.spectrum[0]) & (~zeros[0] | (evidence.k01 < 1 - CHAOTIC_K))
    return jnp.where(sound, kind, Verdict.UNDECIDED)
