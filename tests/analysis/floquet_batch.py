"""The solvers of the floquet analysis over many points, jitted once for all tolerances, as a short form of the engine."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from drivetrain_jax.analysis import Request, Solver, get_analysis
from drivetrain_jax.systems import System, get_system

ANALYSIS, CARDAN = get_analysis("floquet"), get_system("cardan")
# All results of cardan: exponents need a time in seconds, which it does not have.
EVERYTHING = tuple(v.name for v in ANALYSIS.variables if v.name != "floquet_exponent")
BASE = dict(CARDAN.presets["base"])
STABLE, UNSTABLE, UNDECIDED = 0, 1, 2


def request(method: str, rtol: float, outputs=EVERYTHING, **options) -> Request:
    defaults = {option.name: option.default for option in ANALYSIS.options} | {"rtol": rtol} | options
    return Request(tuple(outputs), method, {name: defaults[name] for name in ANALYSIS.methods[method]})


class FloquetBatch:
    """Results by name for arrays of parameters, with the points as first axis, by falling cost of their solver."""

    def __init__(self, method="direct", system: System = CARDAN, outputs=EVERYTHING, chunk=(64, 8, 64, 64), **options):
        self.method, self.system, self.outputs, self.options = method, system, outputs, options
        self.chunk = chunk
        self.names = system.models["floquet"].parameters
        self.compiled: dict[int, object] = {}

    def solvers(self, rtol: float) -> tuple[Solver, ...]:
        solvers = ANALYSIS.solvers(self.system, request(self.method, rtol, self.outputs, **self.options))
        return tuple(solver for solver in solvers if not solver.single)

    def kernel(self, index: int):
        def batch(values, effort, rtol):
            results = self.solvers(rtol)[index].solve(values, effort)
            return {name: jnp.moveaxis(x, -1, 0) for name, x in results.items()}

        return self.compiled.setdefault(index, jax.jit(batch))

    def __call__(self, columns: Mapping[str, object], rtol: float = 1e-10) -> dict[str, np.ndarray]:
        given = np.broadcast_arrays(*(np.atleast_1d(np.asarray(columns[name], float)) for name in self.names))
        points = dict(zip(self.names, (x.reshape(-1) for x in given), strict=True))
        solvers = self.solvers(rtol)
        efforts = np.stack([np.asarray(solver.effort(points), float) for solver in solvers])
        choice = np.argmin(efforts * np.array([[solver.unit_cost] for solver in solvers]), axis=0)
        found: dict[str, np.ndarray] = {}
        for index in range(len(solvers)):
            mine = np.flatnonzero(choice == index)
            mine = mine[np.argsort(efforts[index, mine], kind="stable")]
            size = self.chunk[index]
            for part in (mine[i : i + size] for i in range(0, mine.size, size)):
                padded = {name: np.pad(x[part], (0, size - part.size), mode="edge") for name, x in points.items()}
                results = self.kernel(index)(padded, np.int64(efforts[index, part].max()), rtol)
                for name, x in results.items():
                    x = np.asarray(x)
                    found.setdefault(name, np.empty((choice.size, *x.shape[1:]), x.dtype))[part] = x[: part.size]
        return found
