"""Resonances that systems predict. This package does not import jax, because figures of stored results need none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Family:
    """Resonances whose labels begin with ``prefix``, as figures draw them.

    ``name`` stands in the legend, ``line`` is ``solid``, ``dashed`` or ``dashdot``. Resonances that make no tongue are not
    ``drawn``. The periodic forcing excites a ``forced`` family: figures of forced responses show it.
    """

    prefix: str
    name: str
    line: str = "solid"
    drawn: bool = True
    forced: bool = False


@dataclass(frozen=True)
class Resonances:
    """Predicted values of the parameter ``axis``, drawn over charts.

    ``values(parameters)`` maps the values of ``parameters`` (scalars or arrays of shape ``(...)``) to an array of shape
    ``(..., len(labels))``. ``multipliers`` gives for each label the multiplier that meets the unit circle there, ``+1``,
    ``-1`` or ``pair``, if known. ``up_to(k)`` returns the same predictions for the orders 1 to k. ``families`` say how
    figures draw them; the family of a label is the one with the longest prefix. Nothing is predicted for a result that has
    one of the parameters ``without``.
    """

    axis: str
    parameters: tuple[str, ...]
    labels: tuple[str, ...]
    values: Callable[[Values], np.ndarray]
    long_name: str
    multipliers: tuple[str, ...] = ()
    up_to: Callable[[int], Resonances] | None = None
    families: tuple[Family, ...] = ()
    without: tuple[str, ...] = ()
