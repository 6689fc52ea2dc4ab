"""An atlas of another smooth function: the Krylov determinant of the bicardanic shaft over frequency and support stiffness.

    python -m benchmarks.krylov_atlas

The determinant Psi(q, k) (docs/theory/bicardan.md), q = sqrt(p), grows like exp(phase), phase = q sum of
l (rhoA/EI)^(1/4). Psi exp(-phase) is a smooth function of the phase and of ln k, where k is the stiffness of both supports.
The determinant comes from the compound form, because the plain product of transfer matrices loses a factor exp(phase) in
accuracy. The construction is that of the Floquet analysis, and contains nothing about shafts. The zeros of the atlas along
the phase are the natural frequencies for any k.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from drivetrain_jax.analysis.critical_speeds.compound import planes
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots
from drivetrain_jax.analysis.critical_speeds.segments import Scales
from drivetrain_jax.atlas import Atlas, Domain, Quantity, construct, run, values_at
from drivetrain_jax.systems import Coordinate, Shaft, get_system

TOLERANCE = 1e-11
RANGES = {"phase": (1.0, 32.0), "k": (1e5, 1e10)}
_PRESET = get_system("bicardan").presets["paper_fitted"]


def domain(ranges: Mapping[str, tuple[float, float]] = RANGES) -> Domain:
    """The domain of the atlas: the phase, and the stiffness by its logarithm."""
    same = Coordinate("phase", np.asarray, np.asarray, lambda x: np.ones_like(np.asarray(x, float)))
    logarithm = Coordinate("ln k", np.log, np.exp, lambda k: 1 / np.asarray(k))
    lower, upper = zip(*ranges.values(), strict=True)
    return Domain(tuple(ranges), lower, upper, (same, logarithm), {})


def shaft(k: jax.Array) -> Shaft:
    """The paper's shaft on two supports of stiffness ``k`` ``(N,)``, N/m."""
    lists = {name: jnp.asarray(_PRESET[name])[:, None] for name in ("length", "EI", "rhoA")}
    return Shaft(**lists, k=jnp.stack([k, 0 * k, 0 * k, k]))


def total_length() -> float:
    """The sum of l (rhoA/EI)^(1/4) over the segments, the phase divided by q."""
    length, stiffness, mass = (np.array(_PRESET[name]) for name in ("length", "EI", "rhoA"))
    return float(np.sum(length * (mass / stiffness) ** 0.25))


@jax.jit
def _scaled(phase: jax.Array, k: jax.Array) -> jax.Array:
    bar, q = shaft(k), phase / total_length()
    _, (_, u1, _, _, u4), _, growth = planes(bar, q)
    support = k / (q**3 * Scales.of(bar).e3[-1])
    return (u4[-1] + support * u1[-1]) / (1 + support) * jnp.exp(growth[-1] - phase)


def determinant(points: np.ndarray) -> np.ndarray:
    """Psi exp(-phase) at points (phase, k), ``(N, 2) -> (N, 1)``."""
    size = -(-len(points) // 512) * 512
    padded = np.pad(points, ((0, size - len(points)), (0, 0)), mode="edge")
    return np.asarray(_scaled(padded[:, 0], padded[:, 1]))[: len(points), None]


def phases(atlas: Atlas, k: float) -> np.ndarray:
    """Zeros of the atlas along the phase at one stiffness."""
    line = np.linspace(atlas.lower[0], atlas.upper[0], 2001)

    def value(phase: float) -> float:
        return float(values_at(atlas, np.array([[phase, k]]))[0][0, 0])

    values = values_at(atlas, np.stack([line, np.full(line.shape, k)], axis=-1))[0][:, 0]
    return np.array([brentq(value, line[i], line[i + 1], xtol=1e-14) for i in np.flatnonzero(np.diff(values > 0))])


def natural_frequencies(atlas: Atlas, k: float) -> np.ndarray:
    """Angular frequencies in rad/s from the zeros of the atlas."""
    return (phases(atlas, k) / total_length()) ** 2


def main() -> None:
    """Build the atlas, and print its size, its errors and its natural frequencies."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    atlas = run(construct(domain(), Quantity(1), TOLERANCE), determinant)
    rng = np.random.default_rng(0)
    (low, high), (soft, hard) = RANGES.values()
    points = np.stack(
        [rng.uniform(low, high, 10_000), np.exp(rng.uniform(np.log(soft), np.log(hard), 10_000))], axis=-1
    )
    exact, (found, bound) = determinant(points), values_at(atlas, points)
    error = np.abs(found - exact)[:, 0]
    degrees = ", ".join("x".join(map(str, panel.degrees)) for panel in atlas.panels)
    print(f"{atlas.solves} evaluations, panels {degrees}, gaps {len(atlas.gaps)}")
    print(f"10,000 random points: largest error {error.max():.1e} (values to {np.abs(exact).max():.2g})")
    print(f"largest error over its bound {np.max(error / bound):.2g}")
    for k in (1e5, 2e7, 1e10):
        found = natural_frequencies(atlas, k)
        expected = np.asarray(find_roots(shaft(jnp.array([k])), len(found)).q)[:, 0] ** 2
        print(
            f"k = {k:.0e} N/m: {len(found)} frequencies, largest relative error {np.abs(found / expected - 1).max():.1e}"
        )


if __name__ == "__main__":
    main()
