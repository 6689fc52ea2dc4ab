"""The atlas of the floquet analysis of a system: quantity, tolerance of the solves, and evaluation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax import Array

from drivetrain_jax._machine import usable_cores
from drivetrain_jax._threads import threads
from drivetrain_jax.analysis.floquet.effort import stable_steps, steps_needed
from drivetrain_jax.analysis.floquet.power_series import propagators_along
from drivetrain_jax.analysis.numerics.kernels import Words, compiler_options, predicted, split
from drivetrain_jax.atlas.construction import MAX_SOLVES, Domain, Rounds, construct
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.atlas.quantity import floquet_quantity
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, Series, Smoothness, System

# Nodes of an atlas from power series along one coordinate: a whole line costs as much as a few solves.


# Lines computed together, and divisor of the number of positions along them, so that few kernels serve all panels.
_LANES, _POSITIONS = 16, 48
# Parts of the span per step of the explicit scheme at 1e-10, with a truncation error of 3e-14 of the propagator. Reduction
# in parts per decade of looser tolerance (four at most). Parts per step of decay.
_PARTS, _LEAST, _SPARED, _MOST_SPARED, _DECAY = 0.11, 3e-14, 0.0105, 4, 3.0
# Largest truncation error relative to the tolerance; a line above it is computed again with twice the parts.
_SHARPER, _MOST_PARTS = 1e-2, 4_000
# Tolerance below which rounding of the parts shows in their product. Many steps of decay have the same effect, because the
# product is then small.
_TOO_FINE, _STIFF = 5e-13, 50
# Settings at which steps are predicted, and the angle of one step.
_STEPS_AT, _RADIANS = 1e-10, 0.155

Key = tuple[Callable[..., FloquetModel], Series, tuple[str, ...], Words, tuple[tuple[str, tuple[int, ...]], ...]]


def series_nodes(system: type[System], domain: Domain, tolerance: float) -> SeriesNodes | None:
    """The source of nodes for ``domain``; None without a series of the system, or if the parts would be too inaccurate."""
    smooth = system.models["atlas"].smooth
    series = smooth.series if smooth else None
    if series is None or series.parameter not in domain.parameters or tolerance < _TOO_FINE:
        return None
    corners = np.array(list(itertools.product(*zip(domain.lower, domain.upper, strict=True))))
    columns = {**domain.fixed, **dict(zip(domain.parameters, corners.T, strict=True))}
    decay = float(np.max(predicted(_stable_steps, (system.models["floquet"].build,), columns)))
    return SeriesNodes(system, domain, series, decay, tolerance) if decay <= _STIFF else None


def _stable_steps(build: Callable[..., FloquetModel], values: Any) -> Array:
    return stable_steps(build(values).reduced)


class SeriesNodes:
    """Propagators on grids of coordinates, as a source of nodes for :func:`construct`."""

    positions = _POSITIONS

    def __init__(self, system: type[System], domain: Domain, series: Series, decay: float, tolerance: float) -> None:
        self._system, self._domain, self._series = system, domain, series
        self.axis = domain.parameters.index(series.parameter)
        target = max(_SHARPER * tolerance, _LEAST)
        # Limit of the last kept term; the truncated terms are far smaller.
        self._left_out = 10 * target
        self._parts = _PARTS - _SPARED * min(math.log10(target / _LEAST), _MOST_SPARED)
        self._least = 1 + math.ceil(_DECAY * decay)
        words, numbers = split(domain.fixed)
        self._fixed = {name: np.asarray(value, float) for name, value in numbers.items()}
        names = tuple(name for name in domain.parameters if name != series.parameter)
        shapes = tuple((name, value.shape) for name, value in self._fixed.items())
        self._key = (system.models["floquet"].build, series, names, words, shapes)

    def radians(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """About half the angle through which propagators turn on a line between two corners, from its number of steps.

        Infinite if the line needs too many steps.
        """
        pairs = [np.array(pair) for pair in zip(lower, upper, strict=True)]
        end = max(pairs[self.axis], key=abs)
        _, steps = self._lines([pair if k != self.axis else np.array([end]) for k, pair in enumerate(pairs)])
        most = float(np.max(steps))
        if not self._parts * most <= _MOST_PARTS:
            return math.inf
        return _RADIANS * most * float(np.ptp(pairs[self.axis])) / (2 * abs(end)) if end else 0.0

    def start(self, axes: Sequence[np.ndarray]) -> Callable[[], np.ndarray]:
        """Start computing the grid of ``axes``; returns a function that waits for the values ``(N, n n)``.

        Points are in C order. Values are NaN on lines along which the series does not converge.
        """
        x = axes[self.axis]
        end = max(x, key=abs)
        columns, steps = self._lines([axis if k != self.axis else np.array([end]) for k, axis in enumerate(axes)])
        parts = np.maximum(np.ceil(self._parts * steps), self._least)
        order = np.argsort(-parts, kind="stable")
        chunks = [order[i : i + _LANES] for i in range(0, len(order), _LANES)]
        # Requested before the threads start: each of them would compile it again.
        kernel, pool = _kernel(self._key, len(x)), threads(usable_cores(), "tile")
        pending = [
            pool.submit(self._along, kernel, {n: c[chosen] for n, c in columns.items()}, end, parts[chosen[0]], x)  # pyright: ignore[reportArgumentType]
            for chosen in chunks
        ]

        def values() -> np.ndarray:
            try:
                found = np.empty((len(parts), *pending[0].result().shape[1:]))
                for chosen, future in zip(chunks, pending, strict=True):
                    found[chosen] = future.result()[: len(chosen)]
            finally:
                for future in pending:
                    future.cancel()
            counts = [len(axis) for k, axis in enumerate(axes) if k != self.axis]
            return np.moveaxis(found.reshape(*counts, *found.shape[1:]), -2, self.axis).reshape(-1, found.shape[-1])

        return values

    def _lines(self, axes: Sequence[np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The parameters of all lines on a grid, except the one of the series, and the number of steps of each line."""
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        columns = dict(zip(self._domain.parameters, self._domain.points(grid).T, strict=True))
        steps = steps_needed(self._system, {**self._domain.fixed, **columns}, _STEPS_AT)
        return {name: column for name, column in columns.items() if name != self._series.parameter}, steps

    def _along(
        self, compiled: Future[Any], columns: Mapping[str, np.ndarray], end: float, parts: float, x: np.ndarray
    ) -> np.ndarray:
        """Values on up to ``_LANES`` lines, ``(_LANES, P, n n)``; ``end`` is the largest coordinate ``x``."""
        kernel = compiled.result()
        full = {name: np.pad(column, (0, _LANES - len(column)), mode="edge") for name, column in columns.items()}
        with np.errstate(divide="ignore"):
            ends = self._domain.coordinates[self.axis].inverse(np.array([0.0, end]))
        while True:
            too_many = not parts <= _MOST_PARTS
            number = np.int64(1 if too_many else parts)
            phi, left_out = map(np.asarray, kernel(full, self._fixed, ends, number, x / end if end else x))
            exact = (left_out <= self._left_out) & (not too_many)
            if too_many or exact.all():
                break
            parts = 2 * parts if np.isfinite(left_out).all() else math.inf
        return np.where(exact[:, None, None], np.transpose(phi.reshape(len(x), -1, _LANES), (2, 0, 1)), np.nan)


@lru_cache(maxsize=16)
def _kernel(key: Key, positions: int) -> Future[Any]:
    """:func:`propagators_along` for ``_LANES`` lines, compiled in a separate thread."""
    build, series, names, words, fixed = key

    def lines(columns: dict, numbers: dict, ends: Array, parts: Array, x: Array) -> tuple[Array, Array]:
        given = {**dict(words), **numbers, **columns}

        def form(value: Array) -> LinearPeriodic:
            return build({**given, series.parameter: value}).reduced

        return propagators_along(form, ends, series.first, _LANES, parts, x)

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, float)

    def compiled() -> Any:
        columns, numbers = {name: array(_LANES) for name in names}, {name: array(*shape) for name, shape in fixed}
        arguments = columns, numbers, array(2), jax.ShapeDtypeStruct((), np.int64), array(positions)
        return jax.jit(lines, compiler_options=compiler_options(_LANES, short_loops=True)).lower(*arguments).compile()

    return threads(2, "series").submit(compiled)


# Ratio of the tolerance of direct solves to that of the atlas, and the smallest tolerance that rounding allows.
_SOLVES_SHARPER, _FINEST = 3e-2, 1e-13


def solve_rtol(tolerance: float) -> float:
    """``rtol`` of the analysis ``floquet_propagator`` for the solves of an atlas."""
    return max(_SOLVES_SHARPER * tolerance, _FINEST)


def floquet_domain(system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, Any]) -> Domain:
    """The box ``ranges`` (name to lower and upper value) of ``system`` with the coordinates that the system declares."""
    smooth = system.models["atlas"].smooth or Smoothness({})
    names = tuple(ranges)
    return Domain(
        names,
        tuple(float(ranges[name][0]) for name in names),
        tuple(float(ranges[name][1]) for name in names),
        tuple(smooth.coordinate(name) for name in names),
        dict(fixed),
    )


def floquet_rounds(
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    tolerance: float,
    max_solves: int = MAX_SOLVES,
) -> Rounds:
    """The construction of an atlas of the propagator, as :func:`~drivetrain_jax.atlas.construct`.

    It requests the variables of the analysis ``floquet_propagator``, in one array, with ``rtol = solve_rtol(tolerance)``.
    """
    domain = floquet_domain(system, ranges, fixed)
    quantity = floquet_quantity(_form(system, domain))
    return construct(domain, quantity, tolerance, source=series_nodes(system, domain, tolerance), max_solves=max_solves)


def numbers_per_solve(
    system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float]
) -> int:
    """Number of values per solve for :func:`floquet_rounds`: entries of the propagator, and their errors."""
    return 2 * floquet_quantity(_form(system, floquet_domain(system, ranges, fixed))).size


def prepare_judging(
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    rtol: float,
    outputs: Sequence[str],
) -> None:
    """Compile the kernel that decides single cells of :func:`stability_atlas`, by evaluating a zero atlas.

    This takes seconds, in which other cores can compile and run the solves for the real atlas.
    """
    domain = floquet_domain(system, ranges, fixed)
    middle = [(a + b) / 2 for a, b in zip(domain.lower, domain.upper, strict=True)]
    quantity = floquet_quantity(_form(system, domain))
    nothing = np.zeros((1, quantity.size))
    box = domain.box()
    panel = Panel(
        box.lower, box.upper, nothing.reshape(*[1] * len(middle), -1), 0.0, np.zeros_like(quantity.derived(nothing)[0])
    )
    zero = Atlas(
        parameters=domain.parameters,
        coordinates=domain.coordinates,
        lower=np.array(domain.lower),
        upper=np.array(domain.upper),
        fixed=domain.fixed,
        panels=(panel,),
        gaps=(),
        tolerance=0.0,
        solves=0,
    )
    stability_atlas(zero, system, rtol).by_eigenvalues(np.array([middle]), tuple(outputs))


def _form(system: type[System], domain: Domain) -> LinearPeriodic:
    middle = {name: (a + b) / 2 for name, a, b in zip(domain.parameters, domain.lower, domain.upper, strict=True)}
    return system.models["floquet"].build({**domain.fixed, **middle}).reduced


def stability_atlas(atlas: Atlas, system: type[System], rtol: float) -> StabilityAtlas:
    """Spectral radius, bound and verdict from an atlas of :func:`floquet_rounds`; ``rtol`` determines outcomes."""
    return StabilityAtlas(atlas, system.models["floquet"].build, rtol)
