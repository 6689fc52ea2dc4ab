"""Panels and proved verdicts against ball arithmetic, which shares no code with their proof; it needs python-flint."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivetrain_jax.atlas.floquet import smoothness
from drivetrain_jax.atlas.panels import Atlas, position
from drivetrain_jax.systems import System

_STABLE, _UNSTABLE, _UNDECIDED = 0, 1, 2
# Largest ratio of an error to its bound, which excludes the rounding of the evaluation here.
_MOST = 1.1


def contradictions(atlas: Atlas, system: type[System], points: np.ndarray, verdicts: np.ndarray) -> int:
    """The number of ``points`` ``(N, d)`` where a panel is wrong by more than its proved bound, or its verdict is wrong."""
    enclosure, x = smoothness(system).enclosure, atlas.to_coordinates(points)
    middle = {**atlas.fixed, **dict(zip(atlas.parameters, (atlas.lower + atlas.upper) / 2, strict=True))}
    wrong = 0
    for point, at, number, stated in zip(points, x, atlas.find(x), verdicts, strict=True):
        if number < 0:
            continue
        values = {**atlas.fixed, **dict(zip(atlas.parameters, point.tolist(), strict=True))}
        phi, panel = enclosure.balls(values, middle), atlas.panels[number]  # pyright: ignore[reportOptionalMemberAccess, reportOptionalCall]
        own = panel.coefficients
        for t, n in zip(position(panel, at), panel.degrees, strict=True):
            own = np.tensordot(np.cos(np.arange(n) * np.arccos(t)), own, axes=(0, 0))
        apart = sum((phi[k // 4, k % 4] - entry) ** 2 for k, entry in enumerate(own.tolist())).sqrt()  # pyright: ignore[reportAttributeAccessIssue]
        undamped = not enclosure.log_determinant(values)  # pyright: ignore[reportOptionalMemberAccess]
        wrong += bool(apart > _MOST * panel.proved_error) or {int(stated), _verdict(phi, undamped)} == {
            _STABLE,
            _UNSTABLE,
        }
    return wrong


def _verdict(phi: Any, undamped: bool) -> int:
    """The verdict of eq. (20) of docs/theory/atlas.md by the signs of balls."""
    swap = type(phi)(4, 4, [int((k // 4 - k % 4) % 4 == 2) for k in range(16)])
    d, e3, e2, e1 = (
        sign * x for sign, x in zip((1, -1, 1, -1), (swap * phi.transpose() * swap * phi).charpoly(), strict=False)
    )
    last = 0 if undamped else (e3 - e1 * d) / (1 - d)
    pair = e1 * e1 / 4 - e2 + 2 if undamped else 1 + d - e2 + (e1 - e3) / (1 - d) * last
    signs = 1 - e1 + e2 - e3 + d, 1 + e1 + e2 + e3 + d, pair
    if any(x < 0 for x in signs):
        return _UNSTABLE
    inside = abs(e1) < 4 if undamped else abs(last) < 1 + d
    return _STABLE if inside and all(x > 0 for x in signs) else _UNDECIDED
