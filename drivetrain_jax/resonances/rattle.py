"""Predicted end of the motion without separation of rattling gears; names as in ``systems/rattle.py``."""

from __future__ import annotations

import numpy as np

from drivetrain_jax.resonances import Resonances, Values


def rattle_threshold(values: Values) -> np.ndarray:
    """Amplitude ``B1`` at which the orbit without separation ceases to exist, shape ``(..., 1)``; NaN if there is none.

    ``B1 = (|B0| - alpha b k/I) sqrt((1 - r^2)^2 + (2 zeta r)^2)``, ``r = omega/sqrt(k/I)``, ``zeta = c/(2 sqrt(k I))``,
    for a mean drive that holds the teeth in contact (either flank). Rattle can coexist with that orbit below it.
    """
    mean, b, c, alpha, k, mass, omega = (
        np.asarray(values[name], float) for name in ("B0", "b", "c", "alpha", "k", "I", "omega")
    )
    margin = np.abs(mean) - alpha * b * k / mass
    r, zeta = omega / np.sqrt(k / mass), c / (2 * np.sqrt(k * mass))
    threshold = margin * np.hypot(1 - r**2, 2 * zeta * r)
    return np.where(margin > 0, threshold, np.nan)[..., None]


THRESHOLD = Resonances(
    "B1",
    ("omega", "B0", "b", "c", "alpha", "k", "I"),
    ("no separation ends",),
    rattle_threshold,
    "amplitude at which the orbit without separation ends",
    # An unbalance adds to the amplitude B1 of the drive.
    without=("unbalance",),
)
