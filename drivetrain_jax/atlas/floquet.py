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

from drivetrain_jax._machine import compiling, in_threads, threads
from drivetrain_jax.analysis.floquet.effort import panels_needed, stable_steps, steps_needed
from drivetrain_jax.analysis.numerics.collocation import propagators_along
from drivetrain_jax.analysis.numerics.kernels import Words, compiler_options, predicted, split
from drivetrain_jax.atlas.construction import FIRST_GIVEN, MAX_SOLVES, Axes, Domain, Function, construct
from drivetrain_jax.atlas.panels import Atlas, Panel
from drivetrain_jax.atlas.stability import StabilityAtlas
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, Smoothness, System

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
    """An atlas of the propagator, or of ``T Phi S`` for a system with a ``balance``.

    ``solve(points)`` gives the variables of the analysis ``floquet_propagator`` with ``rtol = solve_rtol(tolerance)`` at
    points in parameters ``(N, d)``, in one array ``(N, 2 n n)``. Errors are relative to the size of the monodromy matrix.
    """
    return construct(*_function(system, ranges, fixed, tolerance, solve), tolerance, max_solves)


def numbers_per_solve(
    system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, float]
) -> int:
    """Number of values per solve for :func:`floquet_atlas`: entries of the propagator, and their errors."""
    return 2 * _form(system, floquet_domain(system, ranges, fixed)).size ** 2


def method_of_solves(
    system: type[System], ranges: Mapping[str, tuple[float, float]], fixed: Mapping[str, Any], tolerance: float
) -> str:
    """The method of the solves of an atlas: ``direct`` at nodes; if power series give the nodes, ``few`` or ``small``."""
    domain = floquet_domain(system, ranges, fixed)
    if _series_decay(system, domain, tolerance) > _STIFF:
        return "direct"
    return "small" if panels_needed(system, _corners(domain), _STEPS_AT).max() <= _CHEAP else "few"


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
    stability_atlas(zero, system, rtol).by_eigenvalues((ends[0] + ends[1])[None] / 2, tuple(outputs), many=True)


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
    left, right = (scales.reshape(len(scales), -1).T for scales in balance(values, middle_of(domain)))
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

    nodes = series_nodes(system, domain, tolerance)

    def grid(axes: Axes) -> np.ndarray:
        at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return balanced(domain.points(at), nodes.grid(axes))  # pyright: ignore[reportOptionalMemberAccess]

    return domain, Function(solved, scale, grid if nodes else None)


# Nodes of an atlas from power series along one coordinate: a whole line costs as much as a few solves.


# Lines computed together, and divisors of the number of positions along them, so that few kernels serve all panels: the
# larger one for up to this number of lines, where more positions take less time than compiling another kernel.
_LANES, _POSITIONS, _MORE, _FEW_LINES = 16, FIRST_GIVEN, 144, 256
# Parts of the span per step of the explicit scheme at 1e-10, with a truncation error of 3e-14 of the propagator. Reduction
# in parts per decade of looser tolerance (four at most). Parts per step of decay.
_PARTS, _LEAST, _SPARED, _MOST_SPARED, _DECAY = 0.11, 3e-14, 0.0105, 4, 3.0
# Largest truncation error relative to the tolerance; a line above it is computed again with twice the parts.
_SHARPER, _MOST_PARTS = 1e-3, 4_000
# Tolerance below which rounding of the parts shows in their product. Many steps of decay have the same effect, because the
# product is then small.
_TOO_FINE, _STIFF = 5e-13, 50
# Tolerance at which steps are predicted, and the number of panels up to which a small program solves held-out points.
_STEPS_AT, _CHEAP = 1e-10, 256

Key = tuple[Callable[..., FloquetModel], str, tuple[str, ...], Words, tuple[tuple[str, tuple[int, ...]], ...]]


def series_nodes(system: type[System], domain: Domain, tolerance: float) -> SeriesNodes | None:
    """The source of nodes for ``domain``; None without a series of the system, or if the parts would be too inaccurate."""
    decay = _series_decay(system, domain, tolerance)
    return SeriesNodes(system, domain, decay, tolerance) if decay <= _STIFF else None


def _series_decay(system: type[System], domain: Domain, tolerance: float) -> float:
    """Most steps of decay in a domain; infinite without a series along it, or for a tolerance too fine for one."""
    if smoothness(system).series not in domain.parameters or tolerance < _TOO_FINE:
        return math.inf
    return float(np.max(predicted(_stable_steps, (system.models["floquet"].build,), _corners(domain))))


def _corners(domain: Domain) -> dict[str, Any]:
    """The parameters at all corners of a domain."""
    corners = np.array(list(itertools.product(*zip(domain.lower, domain.upper, strict=True))))
    return {**domain.fixed, **dict(zip(domain.parameters, corners.T, strict=True))}


def _stable_steps(build: Callable[..., FloquetModel], values: Any) -> Array:
    return stable_steps(build(values).reduced)


class SeriesNodes:
    """Propagators on grids of coordinates, in lines along the coordinate of the series."""

    def __init__(self, system: type[System], domain: Domain, decay: float, tolerance: float) -> None:
        self._system, self._domain, self._series = system, domain, smoothness(system).series
        self.axis = domain.parameters.index(self._series)
        target = max(_SHARPER * tolerance, _LEAST)
        # Limit of the last kept term; the truncated terms are far smaller.
        self._left_out = 10 * target
        self._parts = _PARTS - _SPARED * min(math.log10(target / _LEAST), _MOST_SPARED)
        self._least = 1 + math.ceil(_DECAY * decay)
        words, numbers = split(domain.fixed)
        self._fixed = {name: np.asarray(value, float) for name, value in numbers.items()}
        names = tuple(name for name in domain.parameters if name != self._series)
        shapes = tuple((name, value.shape) for name, value in self._fixed.items())
        self._key = (system.models["floquet"].build, self._series, names, words, shapes)
        # While held-out points are solved.
        _kernel(self._key, FIRST_GIVEN)

    def grid(self, axes: Axes) -> np.ndarray:
        """Values ``(N, n n)`` on the grid of ``axes`` in C order, NaN on lines along which the series does not converge."""
        count, x = len(axes[self.axis]), axes[self.axis]
        lines = math.prod(len(axis) for axis in axes) // count
        x = np.pad(x, (0, -count % (_MORE if count > _POSITIONS and lines <= _FEW_LINES else _POSITIONS)), mode="edge")
        end = max(x, key=abs)
        columns, steps = self._lines([axis if k != self.axis else np.array([end]) for k, axis in enumerate(axes)])
        parts = np.maximum(np.ceil(self._parts * steps), self._least)
        order = np.argsort(-parts, kind="stable")
        chunks = [order[i : i + _LANES] for i in range(0, len(order), _LANES)]
        # Requested before the threads start: each of them would compile it again.
        kernel = _kernel(self._key, len(x))

        def along(chosen: np.ndarray) -> np.ndarray:
            return self._along(kernel, {n: c[chosen] for n, c in columns.items()}, end, float(parts[chosen[0]]), x)

        computed = np.concatenate([values[: len(chosen)] for chosen, values in in_threads(chunks, along)])
        propagators = np.empty((len(parts), count, computed.shape[-1]))
        propagators[order] = computed[:, :count]
        counts = [len(axis) for k, axis in enumerate(axes) if k != self.axis]
        return np.moveaxis(propagators.reshape(*counts, count, -1), -2, self.axis).reshape(-1, computed.shape[-1])

    def _lines(self, axes: Sequence[np.ndarray]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The parameters of all lines on a grid, except the one of the series, and the number of steps of each line."""
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        columns = dict(zip(self._domain.parameters, self._domain.points(grid).T, strict=True))
        steps = steps_needed(self._system, {**self._domain.fixed, **columns}, _STEPS_AT)
        return {name: column for name, column in columns.items() if name != self._series}, steps

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
        form = build({**dict(words), **numbers, **columns, series: value}).reduced
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
