"""Speeds at which orders of the excitation meet the modes of one point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivetrain_jax._wording import aligned
from drivetrain_jax.resonances import FREQUENCIES, Orders, in_hertz, operating_range, orders_of
from drivetrain_jax.runs.scene import Scene


@dataclass(frozen=True)
class OrderCrossings:
    """The ``orders`` with their ``speeds`` (modes, orders) [rpm], and the operating range [rpm] if one is given."""

    orders: Orders
    speeds: np.ndarray
    operating: tuple[float, float] | None

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The speeds of all modes by the name of the order."""
        return dict(zip(self.orders.per_turn, self.speeds.T, strict=True))

    def lines(self) -> list[str]:
        """The speeds as a table, and those within the operating range as sentences."""
        head = ["mode", *(f"{name} [rpm]" for name in self.columns)]
        modes = [
            [str(k), *(f"{x:.6g}" if np.isfinite(x) else "-" for x in row)] for k, row in enumerate(self.speeds, 1)
        ]
        lines = [f"  speed of the {self.orders.shaft} at which an order meets the mode", *aligned([head, *modes])]
        if self.operating:
            low, high = self.operating
            within = self.orders.within(self.speeds, low, high)
            lines += [f"  from {low:g} to {high:g} rpm: {sentence}" for sentence in within]
        return lines


def order_crossings(scene: Scene, parameters: Mapping[str, Any], values: Mapping[str, Any]) -> OrderCrossings | None:
    """The crossings of the frequencies among the results ``values`` of one point; None without frequencies or orders."""
    name = next((name for name in FREQUENCIES if name in values), None)
    orders = orders_of(scene.system.name, {**parameters, **scene.data})
    if name is None or orders is None:
        return None
    frequency = in_hertz(values[name], scene.analysis.variable(name).units)
    return OrderCrossings(orders, orders.speeds(frequency), operating_range(scene.request.options))
