"""Convert an atlas to plain arrays and words, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivetrain_jax.atlas.panels import Atlas, Gap, Panel
from drivetrain_jax.systems import Coordinate

Arrays = dict[str, np.ndarray]


def to_arrays(atlas: Atlas) -> Arrays:
    """Arrays by name. With p panels, g gaps, d parameters, m values and k derived numbers:

    ``lower``, ``upper`` (d,): the domain in parameters; ``panel_lower``, ``panel_upper``, ``panel_degrees`` (p, d),
    ``value_error`` (p,), ``derived_error`` (p, k); ``gap_lower``, ``gap_upper`` (g, d), ``gap_reason`` (g,);
    ``coefficients`` (c, m): the kept ones, in C order, panel after panel; ``kept``: the bits that mark them
    (``numpy.packbits`` of all panels together).
    """
    d = len(atlas.parameters)
    flat = [p.coefficients.reshape(-1, p.coefficients.shape[-1]) for p in atlas.panels]
    kept = [np.any(c != 0, axis=1) for c in flat]
    m = flat[0].shape[1] if flat else 0

    def table(boxes: tuple, name: str) -> np.ndarray:
        return np.array([getattr(box, name) for box in boxes], float).reshape(len(boxes), d)

    return {
        "lower": atlas.lower,
        "upper": atlas.upper,
        "panel_lower": table(atlas.panels, "lower"),
        "panel_upper": table(atlas.panels, "upper"),
        "panel_degrees": np.array([p.degrees for p in atlas.panels], np.int32).reshape(-1, d),
        "value_error": np.array([p.value_error for p in atlas.panels]),
        "derived_error": np.array([p.derived_error for p in atlas.panels]) if flat else np.empty((0, 0)),
        "gap_lower": table(atlas.gaps, "lower"),
        "gap_upper": table(atlas.gaps, "upper"),
        "gap_reason": np.array([gap.reason for gap in atlas.gaps], dtype=object),
        "coefficients": np.concatenate([c[k] for c, k in zip(flat, kept, strict=True)]) if flat else np.empty((0, m)),
        "kept": np.packbits(np.concatenate(kept)) if flat else np.empty(0, np.uint8),
    }


def from_arrays(
    arrays: Mapping[str, Any],
    parameters: tuple[str, ...],
    coordinates: tuple[Coordinate, ...],
    fixed: Mapping[str, Any],
    tolerance: float,
    solves: int,
) -> Atlas:
    """The atlas from the arrays of :func:`to_arrays`, with its words and numbers given separately."""
    degrees = np.asarray(arrays["panel_degrees"])
    sizes = np.prod(degrees, axis=1, dtype=int)
    kept = np.unpackbits(np.asarray(arrays["kept"]), count=int(sizes.sum())).astype(bool)
    coefficients = np.asarray(arrays["coefficients"], float)
    panels, first, used = [], 0, 0
    for k, size in enumerate(sizes):
        mask = kept[first : first + size]
        dense = np.zeros((size, coefficients.shape[1]))
        count = int(mask.sum())
        dense[mask] = coefficients[used : used + count]
        first, used = first + size, used + count
        panels.append(
            Panel(
                np.asarray(arrays["panel_lower"][k]),
                np.asarray(arrays["panel_upper"][k]),
                dense.reshape(*degrees[k], -1),
                float(arrays["value_error"][k]),
                np.asarray(arrays["derived_error"][k]),
            )
        )
    gaps = [
        Gap(np.asarray(lower), np.asarray(upper), str(reason))
        for lower, upper, reason in zip(arrays["gap_lower"], arrays["gap_upper"], arrays["gap_reason"], strict=True)
    ]
    lower, upper = np.asarray(arrays["lower"], float), np.asarray(arrays["upper"], float)
    return Atlas(
        parameters, coordinates, lower, upper, dict(fixed), tuple(panels), tuple(gaps), float(tolerance), int(solves)
    )
