"""Orders of an excitation: multiples of the speed of a shaft, and the speeds at which they meet natural frequencies."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError

# Natural frequencies below this part of the largest one, or below these Hz, belong to rigid motions, which no order meets.
_RIGID, _SLOWEST = 1e-6, 1e-6
# Results that are natural frequencies, and Hz for one of their units.
FREQUENCIES = ("natural_frequency", "critical_speed", "angular_frequency")
_IN_HERTZ = {"Hz": 1.0, "rpm": 1 / 60, "rad/s": 1 / (2 * np.pi)}


def in_hertz(values: Any, units: str) -> np.ndarray:
    """Frequencies in Hz."""
    return np.asarray(values, float) * _IN_HERTZ[units]


@dataclass(frozen=True)
class Orders:
    """Excitations by name, each with its periods ``per_turn`` of the ``shaft``."""

    shaft: str
    per_turn: Mapping[str, float]

    def speeds(self, frequency: Any) -> np.ndarray:
        """Speeds [rpm] at which the orders meet each ``frequency`` [Hz], shape ``(..., orders)``; NaN at rigid motions.

        >>> Orders("carrier", {"mesh": 72.0}).speeds([0.0, 720.0]).ravel().tolist()
        [nan, 600.0]
        """
        frequency = np.asarray(frequency, float)
        largest = np.max(frequency, initial=0.0, where=frequency < np.inf)
        elastic = np.isfinite(frequency) & (frequency > max(_RIGID * largest, _SLOWEST))
        return np.where(elastic, frequency, np.nan)[..., None] * 60 / np.array(list(self.per_turn.values()))

    def within(self, speeds: np.ndarray, low: float, high: float, unit: str = "rpm") -> list[str]:
        """Sentences about the operating range [``low``, ``high``]: one for each order that meets a mode there.

        ``speeds`` (modes, orders) are those of :meth:`speeds`, in ``unit`` as the range is.
        """
        said = []
        for name, column in zip(self.per_turn, speeds.T, strict=True):
            met = [
                f"mode {k + 1} at {column[k]:.6g} {unit}" for k in np.flatnonzero((column >= low) & (column <= high))
            ]
            said += [f"{name} meets {', '.join(met)}"] if met else []
        return said or ["no order meets a natural frequency"]


def orders_of(system: str, values: Mapping[str, Any]) -> Orders | None:
    """The orders that excite ``system``, from its parameters and physical data ``values``; None if they are not known."""
    if system == "bicardan":
        # A joint under an angle and a torque bends the shaft twice a turn.
        return Orders("shaft", {"order 1": 1.0, "order 2 (joints)": 2.0})
    mesh, angles = values.get("carrier_order"), values.get("planet_angle")
    if system == "planetary" and isinstance(mesh, (int, float)) and angles:
        meshes = {f"mesh order {k}": float(k * mesh) for k in (1, 2, 3)}
        return Orders("carrier", {**meshes, "planet pass": float(len(angles))})
    return None


def stored_orders(attrs: Mapping[str, Any]) -> Orders | None:
    """The orders of a result with these attributes."""
    known = json.loads(attrs.get("physical_data", "{}")) | json.loads(attrs.get("fixed_parameters", "{}"))
    return orders_of(str(attrs.get("system")), {n: e["value"] for n, e in known.items() if isinstance(e, dict)})


def operating_range(options: Mapping[str, Any]) -> tuple[float, float] | None:
    """Lowest and highest operating speed [rpm] of the options of an analysis; None if they are not given.

    Raises :class:`InputError` for a range that does not rise.
    """
    low, high = (options.get(f"operating_{end}", 0.0) for end in ("min", "max"))
    if high < low:
        raise InputError(f"options.operating_max = {high:g}: allowed is a speed of at least operating_min = {low:g}")
    return (low, high) if high > 0 else None
