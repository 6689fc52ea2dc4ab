"""Decay of coefficients, and extrapolation to the truncated ones."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas.interpolation import foreseen, needed, remainder


def test_a_tail_of_rounding_is_not_extrapolated():
    falling = 10.0 ** -np.arange(12.0)
    assert remainder(falling, 1e-9) == pytest.approx(1e-10 / 99, rel=1e-9)
    flat = np.concatenate([falling, np.full(6, 1e-13)])
    assert remainder(flat, 1e-9) == 1e-13 and remainder(flat, 1e-12) == np.inf


def test_foreseen_extrapolates_by_less_than_a_third():
    """The number is exact for geometric decay and not too small for faster decay.

    It is None for a kink, for noise, and for a limit that is far away.
    """
    geometric = 0.2 ** np.arange(17.0)
    assert foreseen(geometric, 0.2**20.5) == 21 == needed(0.2 ** np.arange(40.0), 0.2**20.5)
    assert foreseen(geometric, 0.2**30) is None
    assert foreseen(geometric, 0.2**10.5) == 11 == needed(geometric, 0.2**10.5)
    entire = np.cumprod(4 / np.arange(4.0, 44.0))
    assert (needed(entire, 1e-9), foreseen(entire[:17], 1e-9)) == (19, 20)
    assert (needed(entire, 1e-11), foreseen(entire[:17], 1e-11)) == (21, None)
    assert foreseen(1 / np.arange(1.0, 18.0) ** 2, 1e-4) is None
    assert foreseen(np.full(17, 1e-9), 1e-10) is None
