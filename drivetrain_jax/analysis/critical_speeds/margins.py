"""Separation margins of critical speeds against a range of operating speeds. Needs no jax."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# Amplification factor below which a critical speed counts as critically damped (API 617, API 684).
_DAMPED = 2.5
# Margins in percent: of a speed below the range as the factor grows, and what one above it needs more.
_LARGEST, _ABOVE = 17.0, 10.0


class Margins(NamedTuple):
    """``actual`` and ``required`` margin [1] of every critical speed, and whether it is ``kept``."""

    actual: np.ndarray
    required: np.ndarray
    kept: np.ndarray


def required_margin(amplification: Any, above: Any) -> np.ndarray:
    """Margin [1] that API 617 requires of a critical speed with this ``amplification`` factor.

    ``17 (1 - 1/(AF - 1.5))`` percent below the operating speeds, 10 more ``above`` them, none for AF < 2.5. The models of
    this package have no damping of the supports: the factor comes from a measurement or a damped model.

    >>> print(required_margin([2.0, 2.5, 10.0], above=True).round(4))
    [0.   0.1  0.25]
    """
    factor, above = np.asarray(amplification, float), np.asarray(above)
    percent = _LARGEST * (1 - 1 / np.maximum(factor - 1.5, 1.0)) + np.where(above, _ABOVE, 0.0)
    return np.where(factor < _DAMPED, 0.0, percent / 100)


def separation_margins(speed: Any, lowest: float, highest: float, required: Any) -> Margins:
    """Margins of critical speeds ``speed`` from the operating speeds ``lowest`` to ``highest``, all in one unit.

    ``actual`` is the distance to the nearer end of the range over this end, and 0 within. ``required`` [1] is a number, one
    for each speed, or :func:`required_margin`.

    >>> found = separation_margins([2500.0, 3646.0, 8088.0], 3000.0, 4500.0, required=0.2)
    >>> print(found.actual.round(4), found.kept)
    [0.1667 0.     0.7973] [False False  True]
    """
    speed = np.asarray(speed, float)
    if not 0 < lowest <= highest:
        raise ValueError(f"lowest = {lowest:g}: allowed is 0 < lowest <= highest = {highest:g}")
    below, above = (lowest - speed) / lowest, (speed - highest) / highest
    actual = np.maximum(np.maximum(below, above), 0.0)
    required = np.broadcast_to(np.asarray(required, float), actual.shape)
    inside = (speed >= lowest) & (speed <= highest)
    return Margins(actual, required, (actual >= required) & ~inside)
