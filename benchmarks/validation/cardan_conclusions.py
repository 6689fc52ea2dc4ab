"""The statements of Soltan Rezaee & Ghazavi 2014 in numbers, and the forced orbit of the shaft."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.document import section
from drivetrain_jax.atlas.tips import find_tips
from tests.oracles.cardan_paper import natural_frequencies, predicted_speeds, printed_matrices, unstable_fraction
from tests.oracles.cardan_reference import BASE_CASE, spectral_radius, stacked_monodromy

SCENES = Path(__file__).parents[2] / "sweeps"
PRACTICAL = np.pi / 6


def found() -> dict[str, str]:
    """The numbers of the inventory."""
    fig3, fig4, fig6 = (_unstable(f"cardan_fig{number}") for number in (3, 4, 6))
    shares, independent = _shares_by_stiffness()
    by_speed = _quarters(fig3, "Omega")
    slow = np.asarray(fig3.Omega) <= 0.35
    first, sixth = fig3.values[:, slow], fig6.values[:, slow]
    change = 100 * (_quarters(fig4, "Omega") / by_speed - 1)
    speeds = predicted_speeds(natural_frequencies(20.0))
    return {
        "printed": f"{unstable_fraction(printed_matrices(1.0), 4)[0]:.3f}",
        "frequencies": ", ".join(f"{x:.7f}" for x in natural_frequencies()),
        "fig3": f"{float(fig3.mean()):.4f}",
        "fig4": f"{float(fig4.mean()):.4f}",
        "fig6": f"{float(fig6.mean()):.4f}",
        "stiff": _list(_quarters(fig6, "Omega")),
        "tips": _tips(),
        "upright": _list(_tongue("cardan_fig5", "alpha", (1.0, 10.0, 20.0))),
        "inclined": _list(_tongue("cardan_fig7", "mu", (0.5, 1.0, 2.0))),
        "peaks": ", ".join(f"{speeds[name]:.3f}" for name in ("S21", "C+1", "H21")),
        "angles": _list(_quarters(fig3, "beta")),
        "shares": _list(shares),
        "independent": _list(independent),
        "damping": ", ".join(f"{x:.1f} %" for x in change),
        "speeds": _list(by_speed),
        "overlap": f"{(first & sixth).sum() / (first | sixth).sum():.2f}",
    }


def orbit_section() -> str:
    """Stability of the forced orbit and of rest, and amplitude of the orbit."""
    scene = SCENES / "cardan_orbit_chart.toml"
    orbit = dt.run(scene, overrides={"outputs": ["orbit_spectral_radius", "orbit_amplitude", "orbit_count"]})
    axes = {name: {"values": orbit[name].values.tolist()} for name in ("beta", "Omega")}
    rest = dt.run({"system": "cardan", "analysis": "floquet", "outputs": ["verdict"], "axes": axes, "fixed": BASE_CASE})
    known = (orbit.outcome == 0).values
    moves, still = (orbit.orbit_spectral_radius > 1).values & known, (rest.verdict == 1).values & known
    largest = np.degrees(orbit.orbit_amplitude.max("shaft").where(~still).max(("beta", "Omega")))
    rows = [
        f"cells, of these computed | {known.size}, {known.sum()}",
        f"unstable about rest | {still.sum()}",
        f"several orbits found | {(orbit.orbit_count > 1).values.sum()}",
        f"no stable orbit found | {moves.sum()}",
        f"stable about rest, no stable orbit found | {(moves & ~still).sum()}",
        f"unstable about rest, a stable orbit found | {(~moves & still).sum()}",
        f"largest twist of the reported orbit in a cell that is stable about rest | {float(largest):.1f} degrees",
    ]
    text = (
        "`cardan_orbit_chart`, base case. The paper judges rest alone; the shaft twists by tens of degrees at speeds that "
        "rest calls stable. Near the speeds $\\omega_2/2k$ several orbits of the same period coexist. The reported orbit is "
        "the smallest stable one; the shaft may move along a larger one instead ([theory](../theory/cardan.md))."
    )
    return section("Chart of the forced orbit", text, " | ours", rows)


def _unstable(scene: str) -> Any:
    return dt.run(SCENES / f"{scene}.toml", overrides={"outputs": ["verdict"]}).verdict == 1


def _quarters(unstable: Any, along: str) -> np.ndarray:
    other = next(name for name in unstable.dims if name != along)
    return np.array([part.mean() for part in np.array_split(unstable.transpose(along, other).values, 4)])


def _tips() -> str:
    """The tips of the tongues below beta = 0.6, by speed."""
    axes = {"beta": {"start": 0.0, "stop": 0.6}, "Omega": {"start": 0.06, "stop": 2.0}}
    atlas = dt.open_atlas(dt.run({"system": "cardan", "analysis": "atlas", "axes": axes, "fixed": BASE_CASE}))
    tips = sorted(find_tips(atlas.stability.atlas, atlas.scene.system).tips, key=lambda tip: tip.point["Omega"])
    return ", ".join(f"{tip.name} {tip.point['beta']:.4f} at {tip.point['Omega']:.4f}" for tip in tips)


def _shares_by_stiffness() -> tuple[np.ndarray, list[float]]:
    """Unstable share of the practical range for each stiffness ratio, and by SciPy on a coarser grid."""
    chart = dt.run(SCENES / "cardan_stiffness.toml", overrides={"outputs": ["verdict"]})
    grid = np.meshgrid(np.linspace(0, PRACTICAL, 31), np.linspace(0.02, 2.0, 100), indexing="ij")
    points = {"beta": grid[0].ravel(), "Omega": grid[1].ravel()}
    independent = [
        float((spectral_radius(stacked_monodromy(BASE_CASE | points | {"mu": mu}, 1e-9, 1e-9)) > 1 + 1e-7).mean())
        for mu in chart.mu.values
    ]
    return (chart.verdict == 1).mean(("beta", "Omega")).values, independent


def _tongue(scene: str, axis: str, at: Sequence[float]) -> list[float]:
    """Middle of the unstable speeds around the resonance S21, for each value of ``axis``."""
    unstable = _unstable(scene)
    found = []
    for value in at:
        column = unstable.sel({axis: value}, method="nearest")
        fixed = BASE_CASE | {axis: float(column[axis])}
        expected = natural_frequencies(fixed["mu"], fixed["gamma"])[1]
        near = np.asarray(column.Omega)[column.values & (abs(np.asarray(column.Omega) - expected) < 0.2)]
        found.append(float(near.mean()))
    return found


def _list(values: Any) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
