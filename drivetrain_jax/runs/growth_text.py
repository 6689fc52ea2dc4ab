"""Growth or decay of small disturbances in an answer: per second and per turn, where physical data give the speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivetrain_jax.analysis.floquet.growth import growth
from drivetrain_jax.runs.atlas_question import AtlasQuery


def growth_at(asked: AtlasQuery, results: Mapping[str, Any]) -> dict[str, float]:
    """The growth that ``spectral_radius`` means at the point of the question; empty without a speed in rpm."""
    system = asked.atlas.scene.system
    speed = system.roles.get("speed", "")
    known = asked.physical({speed: {**asked.atlas.fixed, **asked.values}[speed]}) if system.periods_per_turn else {}
    turns = next((found["value"] for found in known.values() if found["units"] == "rpm"), None)
    if turns is None or "spectral_radius" not in results:
        return {}
    turn = 60 / turns
    found = growth(results["spectral_radius"], turn / system.periods_per_turn, turn)
    return {name: float(value) for name, value in found._asdict().items() if np.isfinite(value)}


def growth_lines(found: Mapping[str, float]) -> list[str]:
    """The growth as text."""
    if not found:
        return []
    word = "growth" if found["rate"] > 0 else "decay"
    way = "double" if "time_to_double" in found else "halve" if "time_to_halve" in found else ""
    ends = f"; {way}s in {found[f'time_to_{way}']:.4g} s, {found[f'turns_to_{way}']:.4g} turns" if way else ""
    return [f"  {word:<24} {abs(found['rate']):.4g} 1/s, by a factor {found['per_turn']:.6g} per turn{ends}"]
