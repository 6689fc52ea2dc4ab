"""heyoka.py's batch Taylor integrator on the cardan shaft, in the fastest forms that we found.

    python -m benchmarks.peers            # formulations, batch sizes and tolerances: results/heyoka.csv, damping.csv

It integrates three forms. All integrate the four columns of the fundamental matrix as 16 state variables
(theta1, theta1', theta2, omega2) per column, where omega2 = theta2' + (eta theta1)' is the absolute speed of the
second disk. In these variables the equations, damping included, need three products of power series a column and no eta'';
no other form that we found needs so few.

    full  the period [0, pi] in tau
    half  [0, pi/2] in tau and Z ~ N0 Phi^T N1 Phi, N = T^T X T with the reversor X of docs/theory/cardan.md
    chi   half, in the clock tan(chi) = sqrt(cos beta) tan(tau): fewer steps near pi/2, but six products a column

Points are grouped so that the lanes of a batch need similar numbers of steps.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import heyoka as hy
import numpy as np

from benchmarks.engine_job import columns_scene, engine_job
from benchmarks.timing import chart, interleaved, median, parser, results_folder, table, take, write_csv
from tests.oracles.cardan_reference import BASE_CASE, from_half_period, spectral_radius

FORMS = ("full", "half", "chi")
# Number of heyoka's runtime parameters: cos and sin^2 of beta, 1/Omega^2, 2 zeta/Omega, alpha, mu, 1/gamma; in chi also
# r and the scale of the clock.
_PARAMETERS = {"full": 7, "half": 7, "chi": 9}


class HeyokaBatch:
    """Monodromy matrices by ``heyoka.taylor_adaptive_batch``; compiled on construction or taken from its cache."""

    def __init__(self, form: str = "half", tolerance: float = 1e-9, batch: int = 8) -> None:
        self.form, self.batch = form, batch
        self.integrator = hy.taylor_adaptive_batch(
            _equations(form),
            np.zeros((16, batch)),
            tol=tolerance,
            compact_mode=False,
            high_accuracy=False,
            force_avx512=True,  # without it LLVM prefers 256-bit registers
        )

    def monodromy(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Matrices similar to the monodromy matrices, shape ``(N, 4, 4)``, of columns of shape ``(N,)``."""
        order = _similar_effort(columns)
        size = order.size
        padded = np.concatenate([order, np.repeat(order[-1:], -size % self.batch)])
        phi = self._propagate(_runtime_parameters(take(columns, padded), self.form))
        out = np.empty((size, 4, 4))
        out[order] = self._monodromy(phi.reshape(4, 4, -1)[..., :size], take(columns, order))
        return out

    def _propagate(self, parameters: np.ndarray) -> np.ndarray:
        integrator, width = self.integrator, self.batch
        end = np.pi if self.form == "full" else np.pi / 2
        start = np.repeat(np.eye(4).reshape(16, 1), width, axis=1)
        state, runtime = integrator.state, integrator.pars
        out = np.empty((16, parameters.shape[1]))
        for first in range(0, parameters.shape[1], width):
            lanes = slice(first, first + width)
            state[:], runtime[:] = start, parameters[:, lanes]
            integrator.set_time(0.0)
            integrator.propagate_until(end)
            out[:, lanes] = state
        return out

    def _monodromy(self, phi: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        # phi[j, i] is component i of column j.
        return np.moveaxis(phi, (0, 1), (2, 1)) if self.form == "full" else from_half_period(phi, columns)


def prepare_worker(form: str, tolerance: float, batch: int) -> None:
    """Compile one integrator for the process that runs :func:`radius_in_worker`."""
    global _worker
    _worker = HeyokaBatch(form, tolerance, batch)


def radius_in_worker(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Spectral radii of ``columns``, shape ``(N,)``."""
    return spectral_radius(_worker.monodromy(columns))


def monodromy_in_worker(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """NaNs of shape ``(N,)`` after the same matrices, without eigenvalues, to measure the cost of the eigenvalues."""
    return np.full(len(_worker.monodromy(columns)), np.nan)


def _equations(form: str) -> list[tuple[Any, Any]]:
    c, s2, stiffness, damping, alpha, mu, inverse_gamma = (hy.par[i] for i in range(7))
    t = hy.time
    if form == "chi":
        r, scale = hy.par[7], hy.par[8]
        plus = 1.0 / (1.0 + r * hy.cos(2.0 * t))
        minus = 1.0 - r * hy.cos(2.0 * t)
        eta, deta, w = minus * plus, 4.0 * r * hy.sin(2.0 * t) * plus * plus, scale / minus
    else:
        sine = hy.sin(t)
        eta = c / (1.0 - s2 * sine * sine)
        deta, w = eta * eta * (s2 / c) * (2.0 * sine * hy.cos(t)), None

    def timed(x: Any) -> Any:
        return x if w is None else w * x

    equations = []
    for j in range(4):
        theta1, rate1, theta2, speed2 = hy.make_vars(*(f"{name}{j}" for name in ("a", "b", "c", "d")))
        d1 = timed(rate1)
        d2 = timed(speed2) - deta * theta1 - eta * d1
        torque = stiffness * mu * timed(theta2) + damping * alpha * d2
        equations += [
            (theta1, d1),
            (rate1, eta * torque - damping * d1 - stiffness * timed(theta1)),
            (theta2, d2),
            (speed2, -inverse_gamma * torque),
        ]
    return equations


def _runtime_parameters(p: Mapping[str, np.ndarray], form: str) -> np.ndarray:
    c, r = np.cos(p["beta"]), np.tan(p["beta"] / 2) ** 2
    scale = 2 * np.sqrt(c) / (1 + c)
    rows = (
        c,
        np.sin(p["beta"]) ** 2,
        1 / p["Omega"] ** 2,
        2 * p["zeta"] / p["Omega"],
        p["alpha"],
        p["mu"],
        1 / p["gamma"],
        r,
        scale,
    )
    return np.stack(rows[: _PARAMETERS[form]])


def _similar_effort(p: Mapping[str, np.ndarray]) -> np.ndarray:
    # Bands of beta (the poles of eta set the step) sorted by the phase of the fast mode over the half period: clearly
    # faster than sorting by the phase alone, hardly slower than sorting by the measured numbers of steps.
    sine = np.sin(p["beta"])
    phase = (1 + np.sqrt(p["mu"]) * np.where(sine > 0, np.arctanh(np.abs(sine)), 0.0)) / p["Omega"]
    return np.lexsort((phase, np.floor(np.abs(p["beta"]) / 0.1)))


def against_damping(quick: bool) -> list[dict[str, Any]]:
    """Microseconds a point of heyoka and of ``direct`` at a few dampings on one core, and the difference of their radii."""
    rows, size = [], 256
    heyoka = HeyokaBatch("half", 1e-9, 8)
    for zeta in (0.1, 10.0) if quick else (0.1, 10.0, 100.0, 1000.0):
        near = np.linspace(0.995, 1.005, size)
        columns = {name: np.full(size, value) for name, value in BASE_CASE.items()}
        columns |= {"beta": near, "Omega": 0.1 * near, "zeta": np.full(size, zeta)}
        scene = columns_scene(
            "cardan", "floquet", ["spectral_radius"], columns, options={"method": "direct", "rtol": 1e-9}
        )
        direct = engine_job(scene)
        jobs = {
            "package, direct, rtol=1e-9": lambda job=direct: job()["spectral_radius"],
            "heyoka batch, tolerance=1e-9": lambda c=columns: spectral_radius(heyoka.monodromy(c)),
        }
        found = {name: job() for name, job in jobs.items()}
        seconds = interleaved(jobs, 1 if zeta > 100 else 3)
        ours, theirs = found.values()
        apart = float(np.nanmax(np.abs(ours / theirs - 1)))
        rows += [{"zeta": zeta, "method": name, "us_per_point": 1e6 * median(seconds[name]) / size, "difference": apart}
                 for name in jobs]  # fmt: skip
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure rate and error of every form, batch size and tolerance on random cells of the chart, and against damping.

    All methods run on one core.
    """
    options = parser(__doc__).parse_args(arguments)
    rng = np.random.default_rng(0)
    columns = take(chart(30_000), rng.choice(30_000 - 1, 1024 if options.quick else 8192, replace=False))
    reference = spectral_radius(HeyokaBatch("half", 1e-15).monodromy(columns))
    cases = [(form, 1e-9, batch) for form in FORMS for batch in ((8,) if options.quick else (4, 8, 16))]
    cases += [("half", tolerance, 8) for tolerance in (1e-7, 1e-8, 1e-10, 1e-12)]
    rows = []
    for form, tolerance, batch in cases:
        solver = HeyokaBatch(form, tolerance, batch)
        solver.monodromy(take(columns, slice(0, 256)))
        wall, cpu = time.perf_counter(), time.thread_time()
        z = solver.monodromy(columns)
        wall, cpu = time.perf_counter() - wall, time.thread_time() - cpu
        error = np.abs(spectral_radius(z) / reference - 1)
        rows.append(
            {"form": form, "tolerance": tolerance, "batch": batch, "taylor_order": solver.integrator.order}
            | {"monodromies_per_s": round(len(z) / wall), "monodromies_per_cpu_s": round(len(z) / cpu)}
            | {"max_error": float(error.max()), "median_error": float(np.median(error))}
        )
    note = "one core; relative error of rho against tolerance 1e-15; eigenvalues not timed"
    folder, damping = results_folder(options), against_damping(options.quick)
    write_csv(folder / "heyoka.csv", rows, [note])
    write_csv(folder / "damping.csv", damping, ["one core; medians of 3 runs in turns, above zeta = 100 one"])
    print(table(rows), table(damping), sep="\n\n")


if __name__ == "__main__":
    main()
