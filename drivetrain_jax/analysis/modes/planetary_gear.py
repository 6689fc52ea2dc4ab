"""Draw a planetary gear at rest (dashed) and displaced in a mode (solid)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from drivetrain_jax.view.style import FRAME_GREY

# Radii relative to the radius of the carrier, from the paper's base radii 77.4, 100.3, 275 and 176.8 mm.
SUN, PLANET, RING, CARRIER = 77.4 / 176.8, 100.3 / 176.8, 275 / 176.8, 1.0
_LARGEST = 0.28
# Largest radius of a planet relative to half the distance of neighbours, so that planets at rest do not touch.
_CLEAR = 0.94
BODY_COLOURS = {"ring": "#7a7a7a", "carrier": "#2f7d4f", "sun": "#c8553d", "planet": "#1f4e79"}
_CIRCLE = np.linspace(0, 2 * np.pi, 73)


def displacements(shape: Mapping[str, float], planets: int) -> tuple[np.ndarray, np.ndarray]:
    """``[x, y, u]`` of carrier, ring and sun (3, 3) and ``[xi, eta, u]`` of the planets (N, 3) of one mode shape.

    The largest translation or rim movement is scaled to 0.28 of the carrier's radius. Bodies without translations stay in
    place, and the centres of the planets move with the carrier.
    """
    central = [[shape.get(f"x_{body}", 0.0), shape.get(f"y_{body}", 0.0), shape[f"u_{body}"]] for body in "crs"]
    moved = [
        [shape.get(f"xi_{i}", 0.0), shape.get(f"eta_{i}", shape["u_c"]), shape[f"u_{i}"]] for i in range(1, planets + 1)
    ]
    scale = _LARGEST / max(np.abs(central).max(), np.abs(moved).max(), 1e-300)
    return scale * np.array(central), scale * np.array(moved)


def drawn_radii(angles: Sequence[float]) -> tuple[float, float, float]:
    """Radii of sun, planets and ring: the paper's ratio, or smaller planets where neighbours at ``angles`` would overlap."""
    turned = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(np.append(turned, turned[0] + 2 * np.pi))
    planet = min(PLANET, _CLEAR * CARRIER * np.sin(min(gaps.min(), np.pi) / 2))
    return (SUN, PLANET, RING) if planet == PLANET else (CARRIER - planet, planet, CARRIER + planet)


def draw_gear(axes: Axes, shape: Mapping[str, float], angles: Sequence[float]) -> None:
    """Draw the bodies at rest and displaced; a radius on each shows its rotation. Axes are scaled equally and hidden."""
    (carrier, ring, sun), planets = displacements(shape, len(angles))
    sun_radius, planet_radius, ring_radius = drawn_radii(angles)
    _body(axes, np.zeros(2), ring, ring_radius, BODY_COLOURS["ring"], mark=False)
    for angle in np.arange(3) * 2 * np.pi / 3 + np.pi / 6:
        _tick(axes, ring, ring_radius, angle)
    _carrier(axes, carrier, angles)
    _body(axes, np.zeros(2), sun, sun_radius, BODY_COLOURS["sun"])
    for angle, (radial, tangential, rotation) in zip(angles, planets, strict=True):
        outward, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        move = (*(radial * outward + tangential * along), rotation)
        _body(axes, CARRIER * outward, move, planet_radius, BODY_COLOURS["planet"], angle)
    axes.set(aspect="equal", xlim=(-1.9, 1.9), ylim=(-1.9, 1.9))
    axes.axis("off")


def _body(
    axes: Axes,
    centre: np.ndarray,
    move: Sequence[float],
    radius: float,
    colour: str,
    angle: float = 0.0,
    mark: bool = True,
) -> None:
    """Draw a disk at ``centre`` displaced by ``move`` (x, y, u), with a radius at ``angle``."""
    rim = radius * np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    axes.plot(*(centre[:, None] + rim), color=FRAME_GREY, linewidth=0.4, linestyle=(0, (3, 2)))
    moved = centre + np.asarray(move[:2])
    axes.plot(*(moved[:, None] + rim), color=colour, linewidth=1.1)
    if mark:
        turned = angle + move[2] / radius
        axes.plot(
            *np.stack([moved, moved + radius * np.array([np.cos(turned), np.sin(turned)])], axis=1),
            color=colour,
            linewidth=0.9,
        )


def _tick(axes: Axes, move: Sequence[float], radius: float, angle: float) -> None:
    """Draw a mark across the rim that shows the rotation of a body with a hidden centre."""
    turned = angle + move[2] / radius
    along = np.array([np.cos(turned), np.sin(turned)])
    ends = np.stack([np.asarray(move[:2]) + r * along for r in (radius, 1.08 * radius)], axis=1)
    axes.plot(*ends, color=BODY_COLOURS["ring"], linewidth=1.1)


def _carrier(axes: Axes, move: Sequence[float], angles: Sequence[float]) -> None:
    """Draw the carrier as a star of arms to its planets."""
    centre = np.asarray(move[:2])
    for angle in angles:
        for start, turned, style in (
            (np.zeros(2), angle, {"color": FRAME_GREY, "linewidth": 0.4, "linestyle": (0, (3, 2))}),
            (centre, angle + move[2] / CARRIER, {"color": BODY_COLOURS["carrier"], "linewidth": 1.1}),
        ):
            end = start + CARRIER * np.array([np.cos(turned), np.sin(turned)])
            axes.plot(*np.stack([start, end], axis=1), **style)
