"""The atlas of the floquet analysis of a system: what it interpolates, nodes from power series, and evaluation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jax import Array

from drivetrain_jax._machine import compiling, threads, usable_cores
from drivetrain_jax.analysis.floquet.effort import stable_steps, steps_needed
from drivetrain_jax.analysis.numerics.collocation import propagators_along
from drivetrain_jax.analysis.numerics.kernels import Words, compiler_options, predicted, split
from drivetrain_jax.atlas.construction import MAX_SOLVES, Axes, Domain, Function, construct
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, Series, Smoothness, System

# Ratio of the tolerance of direct solves to that of the atlas, and the smallest tolerance that rounding allows.
_SOLVES_SHARPER, _FINEST = 3e-2, 1e-13


def solve_rtol(tolerance: float) -> float:
    """``rtol`` of the analysis ``floquet_propagator`` for the solves of an atlas."""
    return max(_SOLVES_SHARPER * tolerance, _FINEST)


def floquet_domain(system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, Any]) -> Domain:
    """The box ``ranges`` (name to lower and upper value) of ``system`` with the coordinates that the system declares."""
    smooth = smoothness(system)
    names = tuple(ranges)
    return Domain(
        names,
        tuple(float(ranges[name][0]) for name in names),
        tuple(float(ranges[name][1]) for name in names),
        tuple(smooth.coordinate(name) for name in names),
        dict(fixed),
    )


def floquet_atlas(
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    tolerance: float,
    solve: Callable[[np.ndarray], np.ndarray],
    max_solves: int = MAX_SOLVES,
) -> Atlas:
    """An atlas of the propagator, or of ``T Phi S`` for a system with a :class:`~drivetrain_jax.systems.Balance`.

    ``solve(points)`` gives the variables of the analysis ``floquet_propagator`` with ``rtol = solve_rtol(tolerance)`` at
    points in parameters ``(N, d)``, in one array ``(N, 2 n n)``. Errors are relative to the size of the monodromy matrix.
    """
    return construct(*_function(system, ranges, fixed, tolerance, solve), tolerance, max_solves)


def numbers_per_solve(
    system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float]
) -> int:
    """Number of values per solve for :func:`floquet_atlas`: entries of the propagator, and their errors."""
    return 2 * _form(system, floquet_domain(system, ranges, fixed)).size ** 2


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
    box, ends = domain.box(), (np.array(domain.lower), np.array(domain.upper))
    panel = Panel(box.lower, box.upper, np.zeros((*[1] * len(ranges), _form(system, domain).size ** 2)), 0.0)
    zero = Atlas(domain.parameters, domain.coordinates, *ends, domain.fixed, (panel,), (), 0.0, 0)
    stability_atlas(zero, system, rtol).by_eigenvalues((ends[0] + ends[1])[None] / 2, tuple(outputs))


def stability_atlas(atlas: Atlas, system: type[System], rtol: float) -> StabilityAtlas:
    """Spectral radius, bound and verdict from an atlas of :func:`floquet_atlas`; ``rtol`` determines outcomes."""
    return StabilityAtlas(atlas, system.models["floquet"].build, rtol)


def smoothness(system: type[System]) -> Smoothness:
    """The declarations of the system for its atlas; empty for a system without one."""
    model = system.models.get("atlas")
    return (model and model.smooth) or Smoothness({})


def middle_of(domain: Domain) -> dict[str, Any]:
    """The values of all parameters in the middle of a domain."""
    middle = {name: (a + b) / 2 for name, a, b in zip(domain.parameters, domain.lower, domain.upper, strict=True)}
    return {**domain.fixed, **middle}


def _form(system: type[System], domain: Domain) -> LinearPeriodic:
    return system.models["floquet"].build(middle_of(domain)).reduced


def balanced_entries(system: type[System], domain: Domain, points: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """``T A S`` for entries of A ``(N, n n)`` at points in parameters, A itself without a balance."""
    if (balance := smoothness(system).balance) is None:
        return entries
    values = {**domain.fixed, **dict(zip(domain.parameters, points.T, strict=True))}
    left, right = (scales.reshape(len(scales), -1).T for scales in balance.scales(values, middle_of(domain)))
    matrices = entries.reshape(len(points), left.shape[1], -1)
    return (left[:, :, None] * matrices * right[:, None]).reshape(entries.shape)


def _function(
    system: type[System],
    ranges: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float],
    tolerance: float,
    solve: Callable[[np.ndarray], np.ndarray],
) -> tuple[Domain, Function]:
    """The domain, and the entries of the balanced propagator as functions of its coordinates."""
    domain = floquet_domain(system, ranges, fixed)
    form, balanced = _form(system, domain), partial(balanced_entries, system, domain)
    n, x = form.size, None if form.reversor is None else np.array(form.reversor)

    def solved(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = domain.points(at)
        values, errors = (balanced(points, part) for part in np.split(np.asarray(solve(points), float), 2, axis=1))
        return values, np.linalg.norm(errors, axis=1)

    def scale(values: np.ndarray) -> np.ndarray:
        if x is None:
            return np.linalg.norm(values, axis=1)
        phi = values.reshape(-1, n, n)
        z = x @ np.swapaxes(phi, 1, 2) @ x @ phi
        # |dZ| <= 2 |Phi| |dPhi|.
        return np.linalg.norm(z, axis=(1, 2)) / (2 * np.linalg.norm(values, axis=1))

    function = Function(solved, scale)
    if (nodes := series_nodes(system, domain, tolerance)) is None:
        return domain, function

    def start(axes: Axes) -> Callable[[], np.ndarray]:
        waiting = nodes.start(axes)
        at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return lambda: balanced(domain.points(at), waiting())

    return domain, Function(
        solved, scale, start, partial(_degrees, system, domain, tolerance) if smoothness(system).balance else None
    )


# Numbers of polynomials from the growth in complex coordinates.


# Truncation error relative to the tolerance, its least, and the most coordinates for which it is known beforehand: with
# more, there are five times as many nodes as a search finds sufficient.
_TRUNCATED, _ROUNDING, _FEW = 3e-4, 1e-15, 2
_TOO_MANY = 10_000
# Radii of the ellipses on which the growth is bounded, and arcs of half an ellipse.
_RADII, _ARCS = np.geomspace(1.03, 200, 120), 48


def _degrees(
    system: type[System], domain: Domain, tolerance: float, lower: np.ndarray, upper: np.ndarray
) -> tuple[list[int], float]:
    """Numbers of polynomials on a box, and the largest truncation error; infinite with more than ``_FEW`` coordinates."""
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
    columns = {**domain.fixed, **dict(zip(domain.parameters, domain.points(corners).T, strict=True))}
    determinant = system.models["floquet"].build(columns).reduced.log_determinant
    # The size of Phi falls with its determinant.
    size = math.exp(float(np.min(determinant())) / 8) if determinant else 1.0
    counts, error = polynomials_needed(system, domain, max(_TRUNCATED * tolerance * size, _ROUNDING), lower, upper)
    return counts, error if len(lower) <= _FEW else math.inf


def polynomials_needed(
    system: type[System], domain: Domain, target: float, lower: np.ndarray, upper: np.ndarray
) -> tuple[list[int], float]:
    """Numbers of polynomials with which each coordinate leaves out at most ``target`` on a box, and a bound of the sum.

    Interpolation at n Chebyshev nodes of a function bounded by M on the ellipse of radius r leaves out at most
    4 M r^(1-n)/(r-1). With several coordinates these errors add up, each times the Lebesgue constants of earlier ones.
    """
    smooth, d = smoothness(system), len(lower)
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True)))).T
    fixed = {name: smooth.coordinate(name).forward(value) for name, value in domain.fixed.items()}
    x = {**fixed, **dict(zip(domain.parameters, corners[..., None, None], strict=True))}
    counts, error, lebesgue = [], 0.0, 1.0
    for k, name in enumerate(domain.parameters):
        around = (upper[k] + lower[k]) / 2 + (upper[k] - lower[k]) / 2 * _ARCS_AROUND
        with np.errstate(all="ignore"):
            growth = smooth.balance.growth({**x, name: around}, middle_of(domain))  # pyright: ignore[reportOptionalMemberAccess]
        growth = np.broadcast_to(np.nan_to_num(growth, nan=np.inf), (2**d, *around.shape))
        largest = growth.max(axis=(0, 2)) + np.log(4 / (_RADII - 1))
        needed = 1 + (largest - math.log(target)) / np.log(_RADII)
        best = int(np.argmin(needed))
        if not needed[best] < _TOO_MANY:
            return [_TOO_MANY] * d, math.inf
        counts.append(max(math.ceil(needed[best]), 1))
        error += lebesgue * math.exp(largest[best] - (counts[-1] - 1) * math.log(_RADII[best]))
        lebesgue *= 1 + 2 / math.pi * math.log(counts[-1] + 1)
    return counts, error


def _ellipses() -> np.ndarray:
    """Corners of boxes around the arcs of ellipses with the foci -1 and 1, ``(radii, 4 arcs)``: the growth rises to one."""
    angles = np.linspace(0, math.pi, _ARCS + 1)
    real, imaginary = (np.outer(_RADII + sign / _RADII, part(angles)) / 2 for sign, part in ((1, np.cos), (-1, np.sin)))
    ends = slice(None, -1), slice(1, None)
    return np.concatenate([real[:, i] + 1j * imaginary[:, j] for i in ends for j in ends], axis=1)


_ARCS_AROUND = _ellipses()


# Nodes of an atlas from power series along one coordinate: a whole line costs as much as a few solves.


# Lines computed together, and divisors of the number of positions along them, so that few kernels serve all panels: the
# larger one for up to this number of lines, where more positions take less time than compiling another kernel.
_LANES, _POSITIONS, _MORE, _FEW_LINES = 16, 24, 144, 256
# Parts of the span per step of the explicit scheme at 1e-10, with a truncation error of 3e-14 of the propagator. Reduction
# in parts per decade of looser tolerance (four at most). Parts per step of decay.
_PARTS, _LEAST, _SPARED, _MOST_SPARED, _DECAY = 0.11, 3e-14, 0.0105, 4, 3.0
# Largest truncation error relative to the tolerance; a line above it is computed again with twice the parts.
_SHARPER, _MOST_PARTS = 1e-3, 4_000
# Tolerance below which rounding of the parts shows in their product. Many steps of decay have the same effect, because the
# product is then small.
_TOO_FINE, _STIFF = 5e-13, 50
# Tolerance at which steps are predicted.
_STEPS_AT = 1e-10

Key = tuple[Callable[..., FloquetModel], Series, tuple[str, ...], Words, tuple[tuple[str, tuple[int, ...]], ...]]


def series_nodes(system: type[System], domain: Domain, tolerance: float) -> SeriesNodes | None:
    """The source of nodes for ``domain``; None without a series of the system, or if the parts would be too inaccurate."""
    series = smoothness(system).series
    if series is None or series.parameter not in domain.parameters or tolerance < _TOO_FINE:
        return None
    corners = np.array(list(itertools.product(*zip(domain.lower, domain.upper, strict=True))))
    columns = {**domain.fixed, **dict(zip(domain.parameters, corners.T, strict=True))}
    decay = float(np.max(predicted(_stable_steps, (system.models["floquet"].build,), columns)))
    return SeriesNodes(system, domain, series, decay, tolerance) if decay <= _STIFF else None


def _stable_steps(build: Callable[..., FloquetModel], values: Any) -> Array:
    return stable_steps(build(values).reduced)


class SeriesNodes:
    """Propagators on grids of coordinates, in lines along the coordinate of the series."""

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

    def start(self, axes: Axes) -> Callable[[], np.ndarray]:
        """Start computing the grid of ``axes``; returns a function that waits for the values ``(N, n n)`` in C order.

        Values are NaN on lines along which the series does not converge.
        """
        count, x = len(axes[self.axis]), axes[self.axis]
        lines = math.prod(len(axis) for axis in axes) // count
        x = np.pad(x, (0, -count % (_MORE if count > _POSITIONS and lines <= _FEW_LINES else _POSITIONS)), mode="edge")
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
                propagators = np.empty((len(parts), *pending[0].result().shape[1:]))
                for chosen, future in zip(chunks, pending, strict=True):
                    propagators[chosen] = future.result()[: len(chosen)]
            finally:
                for future in pending:
                    future.cancel()
            counts = [len(axis) for k, axis in enumerate(axes) if k != self.axis]
            propagators = np.moveaxis(propagators[:, :count].reshape(*counts, count, -1), -2, self.axis)
            return propagators.reshape(-1, propagators.shape[-1])

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
        value = self._domain.coordinates[self.axis].inverse(np.array(end))
        while True:
            too_many = not parts <= _MOST_PARTS
            number = np.int64(1 if too_many else parts)
            phi, left_out = map(np.asarray, kernel(full, self._fixed, value, number, x / end))
            exact = (left_out <= self._left_out) & (not too_many)
            if too_many or exact.all():
                break
            parts = 2 * parts if np.isfinite(left_out).all() else math.inf
        return np.where(exact[:, None, None], np.transpose(phi.reshape(len(x), -1, _LANES), (2, 0, 1)), np.nan)


@lru_cache(maxsize=16)
def _kernel(key: Key, positions: int) -> Future[Any]:
    """:func:`propagators_along` for ``_LANES`` lines, compiled in a separate thread."""
    build, series, names, words, fixed = key

    def lines(columns: dict, numbers: dict, value: Array, parts: Array, x: Array) -> tuple[Array, Array]:
        form = build({**dict(words), **numbers, **columns, series.parameter: value}).reduced
        return propagators_along(form, _LANES, parts, x)

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, float)

    def compiled() -> Any:
        columns, numbers = {name: array(_LANES) for name in names}, {name: array(*shape) for name, shape in fixed}
        arguments = columns, numbers, array(), jax.ShapeDtypeStruct((), np.int64), array(positions)
        with compiling:
            return (
                jax.jit(lines, compiler_options=compiler_options(_LANES, short_loops=True)).lower(*arguments).compile()
            )

    return threads(2, "series").submit(compiled)
