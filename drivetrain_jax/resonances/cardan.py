"""Predicted parametric resonances of the cardan shaft; names and equation numbers as in ``systems/cardan.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivetrain_jax.resonances import Family, Resonances, Values


def natural_frequencies(mu: Any, gamma: Any) -> np.ndarray:
    """Undamped natural frequencies omega1 < omega2 at beta = 0, in units of sqrt(k1/J1), shape ``(..., 2)``; eq. (14).

    omega^2 = [b -+ sqrt(b^2 - 4 mu/gamma)]/2, b = 1 + mu (1 + 1/gamma).
    """
    mu, gamma = np.asarray(mu, float), np.asarray(gamma, float)
    b = 1 + mu * (1 + 1 / gamma)
    # b^2 - 4 mu/gamma as a sum of squares, and the smaller root from the product: no cancellation.
    upper = (b + np.sqrt((1 + mu - mu / gamma) ** 2 + 4 * mu**2 / gamma)) / 2
    return np.sqrt(np.stack([mu / gamma / upper, upper], axis=-1))


def resonance_speeds(values: Values, orders: int = 3) -> np.ndarray:
    """Speeds of parametric resonance, eq. (15), up to order ``orders`` of each family, shape ``(..., 6 orders)``.

    H: omega_i/(2k), S: omega_i/(2k-1), C+-: (omega2 +- omega1)/(2k), in the order of the labels of ``resonances``.
    """
    omega = natural_frequencies(values["mu"], values["gamma"])
    one, two = omega[..., 0], omega[..., 1]
    ks = range(1, orders + 1)
    harmonic = [w / (2 * k) for w in (one, two) for k in ks]
    subharmonic = [w / (2 * k - 1) for w in (one, two) for k in ks]
    combination = [w / (2 * k) for w in (two + one, two - one) for k in ks]
    return np.stack([*harmonic, *subharmonic, *combination], axis=-1)


# The forcing has only even harmonics of the speed: it meets natural frequencies at the harmonic speeds. Difference
# combinations make no tongues of parametric resonance (equal Krein signature).
_FAMILIES = (
    Family("H", "harmonic $H$", forced=True),
    Family("S", "subharmonic $S$", "dashed"),
    Family("C", "sum combination $C^+$", "dashdot"),
    Family("C-", "difference combination $C^-$", drawn=False),
)


def resonances(orders: int = 3) -> Resonances:
    """The predictions of :func:`resonance_speeds` with their labels (H12: first mode, order 2)."""
    kinds = {"H1": "+1", "H2": "+1", "S1": "-1", "S2": "-1", "C+": "pair", "C-": "pair"}
    return Resonances(
        axis="Omega",
        parameters=("mu", "gamma"),
        labels=tuple(f"{kind}{k}" for kind in kinds for k in range(1, orders + 1)),
        values=lambda values: resonance_speeds(values, orders),
        long_name="predicted parametric resonance",
        multipliers=tuple(multiplier for multiplier in kinds.values() for _ in range(orders)),
        up_to=resonances,
        families=_FAMILIES,
    )


RESONANCES = resonances()
