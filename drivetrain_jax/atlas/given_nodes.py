"""The panel of a box whose nodes come from a cheap source in lines; only held-out points are solved.

With one or two coordinates the tensor starts with enough nodes for most boxes, and grows until its coefficients have
fallen. With more coordinates there are many lines, so the edges are probed first.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from drivetrain_jax.atlas import decay
from drivetrain_jax.atlas.box import BoxRefinement, NodeSource, Refinement
from drivetrain_jax.atlas.fitting import HELD_OUT, MAX_NUMBERS, accept_panel, grown, known_checks, scattered, unresolved
from drivetrain_jax.atlas.interpolation import analysis_matrix, coefficients, envelope, slabs

# Number of lines at the start, and of lines that probe the need of a coordinate.
_LINES, _PROBES = 32, 64
# Further nodes beyond those that the edges need, because edges do not show everything. Further nodes along lines beyond one
# per radian, in units of the cube root of the radians.
_SPARE, _BEYOND = 2, 10.0
# Most boxes along a line: cutting a box into more of them does not pay.
_MOST_BOXES = 100
_MAX_GROWTHS = 8


def fit_given(refinement: BoxRefinement, source: NodeSource) -> Refinement:
    """A panel with nodes from ``source`` that agrees with solves, or the halves or gap of the box instead."""
    d, most = len(refinement.box.lower), MAX_NUMBERS // refinement.settings.quantity.size
    most_along, checks = refinement.settings.max_nodes, None
    radians = source.radians(refinement.box.lower, refinement.box.upper)
    if not radians < _MOST_BOXES * most_along:
        return refinement.give_up("too many nodes would be needed")
    if radians > most_along:
        return refinement.split(source.axis, "not resolved")
    # Along lines cos(r x) and sin(r x) have coefficients J_n(r), which fall beyond n = r.
    along = min(round(radians + _BEYOND * np.cbrt(radians)), most_along)
    degrees = [max(along, 1) if k == source.axis else _LINES for k in range(d)]
    if d > 2:
        degrees = _probed(refinement, source, _suited(degrees, source))
    for _ in range(_MAX_GROWTHS + 1):
        largest = int(np.argmax(degrees))
        if degrees[largest] > most_along or np.prod(degrees, dtype=float) > most:
            return refinement.split(largest, "not resolved")
        degrees = _suited(degrees, source)
        waiting = source.start(refinement.box.axes(degrees))
        if checks is None:
            # Held-out points are solved while the source computes the nodes.
            solved = yield from refinement.solve(_held_out(d))
            if not np.isfinite(solved).all():
                return refinement.failed(solved)
            checks = known_checks(refinement)
        values = waiting()
        if not np.isfinite(values).all():
            return refinement.trouble("no values at the nodes")
        tensor = coefficients(values, degrees)
        panel, tails, limit = accept_panel(refinement, tensor, values, checks, spare=1.0)
        if panel is not None:
            return (panel,)
        if tails.max() <= 1:
            return refinement.give_up("the nodes are not what is solved")
        degrees = _resized(tensor, tails, limit)
    return unresolved(refinement, tails)


def _held_out(d: int) -> np.ndarray:
    """The corners of [-1, 1]^d, where propagators are largest, and scattered points."""
    corners = np.array(list(product((-1.0, 1.0), repeat=d)))
    return np.concatenate([corners, scattered(HELD_OUT - len(corners), d)])


def _suited(degrees: list[int], source: NodeSource) -> list[int]:
    """``degrees``, rounded up where more nodes cost nothing."""
    return [-(-n // source.positions) * source.positions if k == source.axis else n for k, n in enumerate(degrees)]


def _probed(refinement: BoxRefinement, source: NodeSource, degrees: list[int]) -> list[int]:
    """Number of nodes that each coordinate needs along the edges of the box; ``degrees`` if values are missing."""
    box, d = refinement.box, len(refinement.box.lower)
    ends = [np.array(pair) for pair in zip(box.lower, box.upper, strict=True)]
    counts = [degrees[k] if k == source.axis else _PROBES for k in range(d)]
    along = box.axes(counts)
    found = [1] * d
    started = []
    for k in set(range(d)) - {source.axis}:
        axes = [along[j] if j in (k, source.axis) else ends[j] for j in range(d)]
        started.append((k, [len(axis) for axis in axes], source.start(axes)))
    for k, shape, waiting in started:
        values = waiting()
        if not np.isfinite(values).all():
            return degrees
        limit = refinement.settings.limit(values) / 2
        tensor = values.reshape(*shape, -1)
        for axis in (k, source.axis):
            sizes = slabs(np.tensordot(analysis_matrix(shape[axis]), tensor, axes=(1, axis)), 0)
            needed = _needed(sizes, limit) if sizes[-3:].max() <= limit else decay.extrapolated(sizes, limit)
            found[axis] = max(found[axis], needed + _SPARE)
    return found


def _resized(tensor: np.ndarray, tails: np.ndarray, limit: float) -> list[int]:
    """Numbers of nodes: larger where the tail is too large, only as large as needed elsewhere."""
    more = zip(tensor.shape, grown(tensor, tails, limit), tails, strict=False)
    return [
        count if tail > 1 else min(n, _needed(slabs(tensor, k), limit) + _SPARE)
        for k, (n, count, tail) in enumerate(more)
    ]


def _needed(sizes: np.ndarray, limit: float) -> int:
    """Number of polynomials whose truncated coefficients are all below ``limit``."""
    return int(np.count_nonzero(envelope(sizes) > limit))
