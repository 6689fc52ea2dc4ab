"""The outcome of points that are not computed yet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.store.schema import Labelled

# Code of these points, which no finished result contains.
PENDING = len(Outcome)


def with_pending(result: Labelled) -> Labelled:
    """``result`` with the meaning of the code ``PENDING`` added."""
    outcome = result.data[OUTCOME.name]
    meanings = f"{outcome.attrs['flag_meanings']} pending"
    codes = np.arange(PENDING + 1, dtype=OUTCOME.dtype)
    entry = replace(outcome, attrs={**outcome.attrs, "flag_values": codes, "flag_meanings": meanings})
    return replace(result, data={**result.data, OUTCOME.name: entry})
