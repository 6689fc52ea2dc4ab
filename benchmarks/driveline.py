"""Contenders on a truck's driveline: three joints, six inertias, speeds from 300 to 3300 rpm, on one core.

The joints have the phases 0, 90 and 0 degrees, so that half a period is enough for everybody. The result is the spectral
radius, with its bound for the package. Errors are relative to heyoka at tolerance 1e-15, which is itself compared with
SciPy's DOP853 (head of the CSV).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.cardan import HEYOKA
from benchmarks.measure import Job, Judged, Method, Study, judged, points_job
from tests.oracles.cardan_reference import spectral_radius
from tests.oracles.driveline_reference import multipliers

REGION, COUNT, CHECKED = "three joints, six inertias", 30_000, 2
CHAIN: dict[str, Any] = {
    "k": [3e5, 8e4, 5e4, 6e4, 4e4, 9e4], "c": [20.0, 8.0, 5.0, 5.0, 4.0, 9.0], "J": [12.0, 0.8, 0.3, 0.25, 0.2, 1.5],
    "beta": [0.0, 0.1, 0.12, 0.08, 0.0, 0.0], "phase": [0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0], "ratio": [1.0] * 6,
}  # fmt: skip
SPEEDS = np.linspace(300, 3300, COUNT) * math.pi / 30
_OUTPUTS = ("spectral_radius", "spectral_radius_error", "verdict")


class HeyokaChain:
    """Fundamental matrices over half a period by ``heyoka.taylor_adaptive_batch``, in lanes of similar speeds.

    Twelve columns of the rotations x and rates v of eq. (A), J v' = -T_i + h_{i+1} T_{i+1}, and the rigid rotations before
    the joints, which all columns share.
    """

    def __init__(self, tolerance: float, batch: int = 8) -> None:
        import heyoka as hy

        self.batch, n = batch, len(CHAIN["k"])
        joints = [i for i, b in enumerate(CHAIN["beta"]) if b]
        turned = dict(zip(joints[1:], hy.make_vars(*(f"p{i}" for i in joints[1:])), strict=True))
        ratio, slope, equations, rate = {}, {}, [], 1.0
        for i in joints:
            phi = turned.get(i, hy.time) + CHAIN["phase"][i]
            c, s2 = math.cos(CHAIN["beta"][i]), math.sin(CHAIN["beta"][i]) ** 2
            h = c / (1.0 - s2 * hy.sin(phi) * hy.sin(phi))
            ratio[i], slope[i] = h, h * h * (s2 / c) * (2.0 * hy.sin(phi) * hy.cos(phi)) * rate
            rate = rate * h
            after = [k for k in joints if k > i]
            equations += [(turned[after[0]], rate)] if after else []
        for column in range(2 * n):
            x = hy.make_vars(*(f"x{i}_{column}" for i in range(n)))
            v = hy.make_vars(*(f"v{i}_{column}" for i in range(n)))
            torques: list[Any] = []
            for i in range(n):
                before, rate_before = (x[i - 1], v[i - 1]) if i else (0.0, 0.0)
                h, dh = ratio.get(i, 1.0), slope.get(i, 0.0)
                twist = x[i] - h * before if i else x[i]
                twisting = v[i] - h * rate_before - dh * before if i else v[i]
                torques.append(CHAIN["k"][i] * hy.par[0] * twist + CHAIN["c"][i] * hy.par[1] * twisting)
            for i in range(n):
                onward = ratio.get(i + 1, 1.0) * torques[i + 1] if i + 1 < n else 0.0
                equations += [(x[i], v[i]), (v[i], (onward - torques[i]) * (1 / CHAIN["J"][i]))]
        self.shared, self.n = len(turned), n
        self.integrator = hy.taylor_adaptive_batch(
            equations, np.zeros((self.shared + 4 * n * n, batch)), tol=tolerance, compact_mode=True, force_avx512=True
        )

    def radii(self, speeds: np.ndarray) -> np.ndarray:
        """Spectral radii; the number of speeds is a multiple of the lanes."""
        n, states = self.n, []
        start = np.concatenate(
            [np.zeros(self.shared), np.eye(2 * n)[:, np.arange(2 * n).reshape(2, n).T.ravel()].ravel()]
        )
        for part in speeds.reshape(-1, self.batch):
            self.integrator.state[:] = start[:, None]
            self.integrator.pars[:] = [1 / part**2, 1 / part]
            self.integrator.set_time(0.0)
            self.integrator.propagate_until(math.pi / 2)
            states.append(self.integrator.state[self.shared :].T.copy())
        # Axes: speed, component, column, x or v; to matrices of (x, v) in units of mass.
        phi = np.concatenate(states).reshape(-1, 2 * n, n, 2).transpose(0, 3, 2, 1).reshape(-1, 2 * n, 2 * n)
        mass = np.tile(np.sqrt(CHAIN["J"]), 2)
        phi = phi * mass[:, None] / mass
        start, end = (self._damping(end) / speeds[:, None, None] for end in (0.0, math.pi / 2))
        unit, none = np.broadcast_to(np.eye(n), start.shape), np.zeros_like(start)
        left, right = np.block([[none, unit], [unit, -start]]), np.block([[end, unit], [unit, none]])
        return spectral_radius(left @ phi.swapaxes(1, 2) @ right @ phi)

    def _damping(self, tau: float) -> np.ndarray:
        """``J^(-1/2) N^T c N J^(-1/2)`` at an end of the half period, where all rigid rotations are ``tau``."""
        n_matrix = np.eye(self.n)
        for i in range(1, self.n):
            c, phi = math.cos(CHAIN["beta"][i]), tau + CHAIN["phase"][i]
            n_matrix[i, i - 1] = -c / (1 - (1 - c * c) * math.sin(phi) ** 2)
        root = np.sqrt(CHAIN["J"])
        return n_matrix.T @ np.diag(CHAIN["c"]) @ n_matrix / root[:, None] / root


heyoka_chain = cache(HeyokaChain)


def direct(region: str, rtol: float) -> Job:
    """The package."""
    options = {"method": "direct", "rtol": rtol}
    return points_job("driveline", "floquet", _OUTPUTS, {"speed": SPEEDS}, fixed=CHAIN, options=options)


def heyoka(region: str, tolerance: float) -> Job:
    """heyoka's batch Taylor integrator."""
    return partial(heyoka_chain(tolerance).radii, SPEEDS)


@cache
def exact() -> np.ndarray:
    """Spectral radii by heyoka at 1e-15."""
    return heyoka_chain(1e-15).radii(SPEEDS)


def error(region: str, setting: Any, result: Any) -> Judged:
    """The largest relative error."""
    radii = result["spectral_radius"] if isinstance(result, Mapping) else result
    return judged(np.max(np.abs(radii / exact() - 1)))


def _two_references(regions: Any) -> list[str]:
    chosen = range(0, COUNT, COUNT // CHECKED)
    other = [np.abs(multipliers(CHAIN | {"speed": float(SPEEDS[i])}, math.pi)).max() for i in chosen]
    return [
        f"SciPy, Lagrange multipliers: differs from the reference by {np.abs(other / exact()[list(chosen)] - 1).max():.0e}"
    ]


STUDY = Study(
    "driveline", (REGION,) if HEYOKA else (), (REGION,) if HEYOKA else (),
    (
        Method("package, direct", direct, COUNT, (1e-6, 1e-8, 1e-10), (1e-8,)),
        Method("heyoka batch", heyoka, COUNT, (1e-7, 1e-9, 1e-11), (1e-9,), "tolerance={:g}"),
    ),
    error, _two_references,
)  # fmt: skip
