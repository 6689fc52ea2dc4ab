"""Growth or decay of small disturbances in time and per turn, from the spectral radius over one period. Needs no jax."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Growth(NamedTuple):
    """``rate`` [1/s], negative for decay; ``per_turn``, the factor of the amplitude per turn of the shaft;
    ``time_to_double`` and ``time_to_halve`` [s] and ``turns_to_double`` and ``turns_to_halve``, infinite for the other case.
    """

    rate: np.ndarray
    per_turn: np.ndarray
    time_to_double: np.ndarray
    time_to_halve: np.ndarray
    turns_to_double: np.ndarray
    turns_to_halve: np.ndarray


def growth(spectral_radius: Any, period: Any, turn: Any) -> Growth:
    """The growth that a ``spectral_radius`` over one ``period`` [s] means; a ``turn`` of the shaft takes so long [s].

    ``rate = ln(spectral_radius)/period`` is the largest real part of the Floquet exponents. The equations of a cardan shaft
    have two periods in a turn.

    >>> found = growth(1.02, period=0.02, turn=0.04)
    >>> print(found.rate.round(4), found.time_to_double.round(4), found.turns_to_double.round(2))
    0.9901 0.7001 17.5
    """
    radius, period, turn = np.broadcast_arrays(*(np.asarray(x, float) for x in (spectral_radius, period, turn)))
    with np.errstate(divide="ignore"):
        rate = np.log(radius) / period
        # Not `way > 0`: NaN stays NaN.
        double, halve = (np.where(way <= 0, np.inf, np.log(2) / np.abs(way)) for way in (rate, -rate))
    return Growth(rate, np.exp(rate * turn), double, halve, double / turn, halve / turn)
