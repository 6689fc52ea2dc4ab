"""Follow the line f_h = 0 of a tongue from its tip down to the foot, to identify its resonance."""

from __future__ import annotations

import numpy as np

from drivetrain_jax.atlas.patches import Patches

# Steps down the ridge, Newton steps on each, and the largest shift of the ridge in one step relative to the domain.
_STEPS = 40
_NEWTON = 3
_LARGEST_SHIFT = 0.02


def ridge_roots(patches: Patches, tips: np.ndarray, horizontal: int, bottom: float) -> np.ndarray:
    """Coordinate h of the foot of each ridge where the other coordinate is ``bottom``, ``(N,)``; NaN if the ridge is lost.

    ``patches`` hold the function whose tips are ``tips`` ``(N, 2)`` in coordinates.
    """
    h, v = horizontal, 1 - horizontal
    slope = patches.derivative(h)
    curvature = slope.derivative(h)
    width = patches.upper[:, h].max() - patches.lower[:, h].min()
    x = tips.copy()
    for step in range(_STEPS):
        x[:, v] = tips[:, v] + (bottom - tips[:, v]) * (step + 1) / _STEPS
        before = x[:, h].copy()
        for _ in range(_NEWTON if len(x) else 0):
            place = patches.locate(x)
            x[:, h] -= slope.at(*place) / curvature.at(*place)
        x[~(np.abs(x[:, h] - before) <= _LARGEST_SHIFT * width), h] = np.nan
    return x[:, h]
