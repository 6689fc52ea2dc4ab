"""Stability from an atlas of the propagator: spectral radius with its bound and verdict, on grids and at points.

Most cells of a grid and most points are decided in closed form (``charts``, ``points``). If the bound is too wide or gives
no verdict, the eigenvalues of Z decide, and the test of Schur and Cohn where the interval of rho contains 1. Without
damping the verdict is :func:`~drivetrain_jax.atlas.charts.verdict`. All other results, and all results of systems without
a closed form, come from the eigenvalues.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.analysis.floquet import quartic
from drivetrain_jax.analysis.floquet.direct import Monodromy, assemble
from drivetrain_jax.analysis.floquet.multipliers import PolynomialError, characteristic_polynomial
from drivetrain_jax.analysis.floquet.results import VARIABLES, results
from drivetrain_jax.analysis.numerics.kernels import compiler_options, options_for_few
from drivetrain_jax.analysis.numerics.linear_algebra import eigenvalues
from drivetrain_jax.atlas import charts
from drivetrain_jax.atlas.charts import Build
from drivetrain_jax.atlas.evaluation import Tile, tiles
from drivetrain_jax.atlas.interpolation import evaluate
from drivetrain_jax.atlas.panels import Atlas, position
from drivetrain_jax.atlas.points import LANES, Expansion, evaluated_cells, point_kernel
from drivetrain_jax.systems import FloquetModel, LinearPeriodic

DEFAULT_OUTPUTS = ("spectral_radius", "spectral_radius_error", "verdict")
_FAST = frozenset(DEFAULT_OUTPUTS)
# Points per call of the kernel of eigenvalues, and up to which it is not optimised: compiling takes longer.
_BLOCK, _FEW = 1024, 8192
# Held during a call: a kernel requested while another thread compiles it would be compiled twice.
_JUDGING = Lock()


@dataclass(frozen=True)
class StabilityAtlas:
    """An atlas of the propagator of the reduced form of ``build(values)``, and the results that follow from it.

    ``rtol`` is the target that determines outcomes. ``keep(kernel, options, name)`` returns a kernel that does the same, and
    may keep its compiled code for later processes.
    """

    atlas: Atlas
    build: Build
    rtol: float
    keep: Callable[[Any, Mapping[str, Any], str], Any] = lambda kernel, _, __: kernel

    def slice(self, values: Mapping[str, float]) -> StabilityAtlas:
        """The atlas of the remaining parameters; raises as :meth:`Atlas.slice`."""
        return replace(self, atlas=self.atlas.slice(values))

    def ordered(self, parameters: Sequence[str]) -> StabilityAtlas:
        """The atlas with the parameters in this order."""
        return replace(self, atlas=self.atlas.ordered(parameters))

    def at(self, points: np.ndarray, outputs: Sequence[str] = DEFAULT_OUTPUTS) -> dict[str, np.ndarray]:
        """Results by name at points ``(N, d)`` in the order of ``atlas.parameters``, points first, and ``outcome``.

        Points that no panel covers are NaN, undecided, and have the outcome ``LOST``: solve them directly.
        """
        points = np.atleast_2d(np.asarray(points, float))
        if not (self.closed_form and _FAST.issuperset(outputs) and self.atlas.panels):
            return self.by_eigenvalues(points, outputs)
        x, results = self.atlas.to_coordinates(points), self.blank((len(points),), outputs)
        undamped, few = self._may_be_undamped(points.T), len(points) <= LANES
        options = options_for_few() if few else compiler_options()
        kernel = self.keep(point_kernel(self.build, undamped, few), options, f"points {undamped}")
        unsure = [np.empty(0, int)]
        for index, cells in evaluated_cells(self._expansion, points, x, self.atlas, kernel, self.rtol):
            for name, values in results.items():
                values[index] = cells[name]
            unsure.append(index[cells["unsure"]])
        again = np.concatenate(unsure)
        for name, values in self.by_eigenvalues(points[again], outputs).items():
            results[name][again] = values
        return results

    def by_eigenvalues(
        self, points: np.ndarray, outputs: Sequence[str], *, many: bool = False
    ) -> dict[str, np.ndarray]:
        """As :meth:`at`, but all points by the eigenvalues of Z; ``many`` takes the kernel of many points for few."""
        few = len(points) <= _FEW and not many
        x, results = self.atlas.to_coordinates(points), self.blank((len(points),), outputs)
        number = self.atlas.find(x)
        for k, panel in enumerate(self.atlas.panels):
            mine = np.flatnonzero(number == k)
            phi = evaluate(panel.coefficients, position(panel, x[mine])).T
            for start in range(0, len(mine), _BLOCK):
                part, lanes = mine[start : start + _BLOCK], phi[:, start : start + _BLOCK]
                lanes = np.pad(lanes, ((0, 0), (0, _BLOCK - len(part))), mode="edge")
                for name, value in self._exact_results(k, points[part], lanes, tuple(outputs), few).items():
                    results[name][part] = value[: len(part)]
        return results

    def blank(self, shape: tuple[int, ...], outputs: Sequence[str] = DEFAULT_OUTPUTS) -> dict[str, np.ndarray]:
        """Results by name, and ``outcome``, of unknown points."""
        results = self._empty(shape, outputs)
        for name, values in results.items():
            values[...] = _nothing(name, values)
        return results

    def _empty(self, shape: tuple[int, ...], outputs: Sequence[str]) -> dict[str, np.ndarray]:
        variables = {v.name: v for v in VARIABLES}
        inner = {name: (self._multipliers,) * len(variables[name].dims) for name in outputs}
        results = {name: np.empty((*shape, *inner[name]), variables[name].dtype) for name in outputs}
        return results | {OUTCOME.name: np.empty(shape, np.int8)}

    def on_grid(
        self,
        axes: Sequence[np.ndarray],
        outputs: Sequence[str] = DEFAULT_OUTPUTS,
        out: Mapping[str, np.ndarray] | None = None,
        *,
        rows: int | None = None,
    ) -> dict[str, np.ndarray]:
        """Results by name, and ``outcome``, on the grid of ``axes``, one per parameter of the atlas in its order.

        The results are written to ``out`` if it is given. The last two axes should be the longest, because their cells are
        computed together. Cells that no panel covers are marked as in :meth:`at`. For a part of a chart, ``rows`` is the
        length of the chart's last axis but one, so that all parts share their kernels.
        """
        axes = [np.asarray(axis, float) for axis in axes]
        shape = tuple(len(axis) for axis in axes)
        results = self._empty(shape, outputs) if out is None else dict(out)
        if self.closed_form and _FAST.issuperset(outputs) and len(axes) > 1:
            self._tile(results, axes, rows)
            return results
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        for name, value in self.at(points, outputs).items():
            results[name][...] = value.reshape(results[name].shape)
        return results

    def _tile(self, results: dict[str, np.ndarray], axes: list[np.ndarray], rows: int | None) -> None:
        """Fill ``results`` in closed form; the axes may be in any order."""
        # Tiles are blocks of neighbours, so axes must rise in the coordinates of the atlas.
        orders = [np.argsort(c.forward(a), kind="stable") for c, a in zip(self.atlas.coordinates, axes, strict=True)]
        rising = [axis[order] for axis, order in zip(axes, orders, strict=True)]
        steps = [set(np.diff(order)) for order in orders]
        if all(len(step) < 2 for step in steps):
            turned = tuple(slice(None, None, -1 if step == {-1} else 1) for step in steps)
            self._fill({name: values[turned] for name, values in results.items()}, rising, rows)
            return
        in_order = {name: values.copy() for name, values in results.items()}
        self._fill(in_order, rising, rows)
        for name, values in in_order.items():
            results[name][np.ix_(*orders)] = values

    @property
    def _multipliers(self) -> int:
        # The shape of the panels gives the number without building the form.
        return round(self.atlas.panels[0].coefficients.shape[-1] ** 0.5) if self.atlas.panels else self.form.size

    @cached_property
    def _expansion(self) -> Expansion:
        return Expansion(self.atlas)

    @cached_property
    def form(self) -> LinearPeriodic:
        """The reduced form in the middle of the domain."""
        middle = dict(zip(self.atlas.parameters, (self.atlas.lower + self.atlas.upper) / 2, strict=True))
        return self.build({**self.atlas.fixed, **middle}).reduced

    @cached_property
    def closed_form(self) -> bool:
        """True if cells are decided by the closed form of four states with a reversor."""
        return self.form.exchanges_halves and self.form.log_determinant is not None

    def _fill(self, results: dict[str, np.ndarray], axes: list[np.ndarray], rows: int | None) -> None:
        """Fill ``results`` tile by tile, then compute cells again for which the closed form is not accurate enough."""
        names, undamped = self.atlas.parameters, self._may_be_undamped(np.ix_(*axes))
        # Mark the cells that no tile covers by the outcome alone: blanking all arrays takes a tenth of the time of a chart.
        results[OUTCOME.name][...] = Outcome.LOST
        coordinates = [c.forward(axis) for c, axis in zip(self.atlas.coordinates, axes, strict=True)]

        kinds = ("undamped",) * 2 if undamped else ("sparse", "dense")
        # Before the threads start: each of them would compile a kernel of its own.
        kernels = [
            self.keep(charts.tile_kernel(self.build, names, kind), compiler_options(), f"tile {names} {kind}")
            for kind in kinds
        ]
        cut = tiles(self.atlas, coordinates, (charts.ROWS, charts.COLUMNS), rows=rows, dense=not undamped)
        again = [
            _store(results, tile, cells)
            for tile, cells in charts.evaluated_tiles(cut, axes, names, self.atlas.fixed, kernels, self.rtol)
        ]
        unsure = np.concatenate([np.empty((0, len(axes)), int), *again])
        for part in (unsure[i : i + (1 << 18)] for i in range(0, len(unsure), 1 << 18)):
            points = np.stack([axis[part[:, k]] for k, axis in enumerate(axes)], axis=-1)
            for name, value in self.by_eigenvalues(points, [name for name in results if name != OUTCOME.name]).items():
                results[name][tuple(part.T)] = value
        if (lost := results[OUTCOME.name] == Outcome.LOST).any():
            for name, values in results.items():
                values[lost] = _nothing(name, values)

    def _may_be_undamped(self, columns: Iterable[np.ndarray]) -> bool:
        """True if the system is Hamiltonian in any cell; ``columns`` are broadcast against each other."""
        model = self.build({**self.atlas.fixed, **dict(zip(self.atlas.parameters, columns, strict=True))})
        return model.hamiltonian is not None and bool(np.any(model.hamiltonian()))

    def _exact_results(
        self, number: int, points: np.ndarray, phi: np.ndarray, outputs: tuple[str, ...], few: bool
    ) -> dict[str, np.ndarray]:
        """Results of lanes ``phi`` ``(m, N)``, of which the first are those of ``points``."""
        columns = np.pad(points, ((0, phi.shape[1] - len(points)), (0, 0)), mode="edge")
        values = {name: columns[:, k] for k, name in enumerate(self.atlas.parameters)}
        name = f"eigenvalues {outputs} {self.rtol} {self.closed_form}"
        options = options_for_few() if few else compiler_options(march=True)
        kernel = self.keep(_point_kernel(self.build, outputs, self.rtol, self.closed_form, few), options, name)
        with _JUDGING:
            results = kernel(phi, self.atlas.panels[number].value_error, values, self.atlas.fixed)
        return {name: np.moveaxis(np.asarray(value), -1, 0) for name, value in results.items()}


def _nothing(name: str, values: np.ndarray) -> float | int:
    """The value of a missing result."""
    return Outcome.LOST if name == OUTCOME.name else charts.UNDECIDED if values.dtype == np.int8 else np.nan


def _store(results: Mapping[str, np.ndarray], tile: Tile, cells: charts.Cells) -> np.ndarray:
    """Store the results of a tile; returns the cells to compute again, as positions along each axis ``(N, d)``."""
    place = tuple(slice(i[0], i[-1] + 1) for i in tile.index)
    for name, values in results.items():
        part = values[place]
        part[...] = cells[name].reshape(part.shape)
    if not cells["unsure"].any():
        return np.empty((0, len(place)), int)
    return np.argwhere(cells["unsure"].reshape([len(i) for i in tile.index])) + [i[0] for i in tile.index]


@lru_cache(maxsize=16)
def _point_kernel(build: Build, outputs: tuple[str, ...], rtol: float, closed_form: bool, few: bool) -> Any:
    """The kernel of scattered points, by eigenvalues from Phi; all atlases share it, because compiling takes seconds."""

    def kernel(phi, error, values, fixed):
        model = build({**fixed, **values})
        if not (closed_form and _FAST & set(outputs)):
            return _by_eigenvalues(phi, model, error, outputs, rtol)
        results = _by_eigenvalues(phi, model, error, tuple({*outputs, *DEFAULT_OUTPUTS}), rtol)
        results |= _sharper(phi, model, error, results)
        return {name: results[name] for name in (*outputs, "outcome")}

    return jax.jit(kernel, compiler_options=options_for_few() if few else compiler_options(march=True))


def _sharper(phi: Array, model: FloquetModel, error_of_phi: Array, results: dict[str, Array]) -> dict[str, Array]:
    """Results with more verdicts, and with the exact results of Hamiltonian lanes.

    Where the interval of rho contains 1, there is a verdict if no multiplier can cross the unit circle (Schur-Cohn).
    """
    parts, log_d = quartic.blocks(phi), jnp.broadcast_to(model.reduced.log_determinant(), phi.shape[1:])  # pyright: ignore[reportOptionalCall]
    rho, error, verdict = (results[name] for name in DEFAULT_OUTPUTS)
    settled = quartic.nothing_crosses(quartic.coefficients(parts, log_d, error_of_phi), log_d)
    verdict = jnp.where((verdict == charts.UNDECIDED) & settled, jnp.where(rho < 1, 0, 1), verdict).astype(jnp.int8)
    if model.hamiltonian is not None:
        rho, error, verdict = charts.exactly(charts.exact_verdict(model, parts, error_of_phi), rho, error, verdict)
    return dict(zip(DEFAULT_OUTPUTS, (rho, error, verdict), strict=True))


def _by_eigenvalues(
    phi: Array, model: FloquetModel, error: Array, outputs: tuple[str, ...], rtol: float
) -> dict[str, Array]:
    """Results of the floquet analysis for lanes of ``Phi``, its entries by rows ``(n n, N)``, by eigenvalues of Z.

    ``error`` bounds the norm of the error of ``Phi``.
    """
    form, n = model.reduced, model.reduced.size
    matrix = phi.reshape(n, n, -1)
    z = assemble(form.ends(), matrix)
    a, slopes = characteristic_polynomial(z)
    spectrum = eigenvalues(z)
    rho = jnp.max(jnp.hypot(*spectrum), axis=0)
    changed = error if form.halves == 1 else (2 * jnp.sqrt(jnp.sum(phi**2, axis=0)) + error) * error
    # The exact determinant has no error.
    known = n if form.log_determinant is None else n - 1
    relative = reduce(jnp.maximum, (n**0.5 * slopes[k] * changed / rho ** (k + 1) for k in range(known)))
    residual = jnp.zeros_like(rho)
    if form.log_determinant is not None:
        residual = ((-1) ** n * a[-1] - jnp.exp(form.log_determinant())) / rho**n
        relative = jnp.maximum(relative, jnp.abs(residual))
    halves = form.halves
    rounding = 4 * np.finfo(float).eps * jnp.sum(matrix**2, axis=(0, 1)) ** (halves / 2) / rho
    sizes = jnp.stack([(relative + rounding) * rho**k for k in range(1, n + 1)])
    error_of_z = PolynomialError(sizes, jnp.zeros_like(rho))
    monodromy = Monodromy(z, jnp.zeros_like(rho), error_of_z, relative <= 10 * rtol, residual)
    return results(monodromy, outputs, rtol, model, spectrum=spectrum)
