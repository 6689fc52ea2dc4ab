"""The conclusions of Soltan Rezaee & Ghazavi 2014, and where each of its equations, figures and tables is computed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.document import markdown
from tests.oracles.cardan_reference import BASE_CASE, spectral_radius, stacked_monodromy

SCENES = Path(__file__).parents[2] / "sweeps"
PRACTICAL = np.pi / 6
# Number, where it is computed, what was found.
EQUATIONS = (
    ("(1), (2), (5)", "`Cardan.vector_field`", "agree"),
    ("(3), (4), (6), (7)", "the speed ratio in `Cardan.vector_field`", "agree"),
    ("(8)-(11)", "the Jacobian of the vector field", "agree; by automatic differentiation in the tests"),
    ("(12), (13)", "`Cardan.vector_field`", "(12) prints k1 for k2 in its last term"),
    ("(14)", "parameters `Omega`, `zeta`", "both printed definitions contradict (15), see theory"),
    ("(15)", "`Cardan.floquet_model`, `Cardan.forced_model`", "eta'' and a factor 2 are missing, a sign is wrong"),
    ("(16)-(21)", "`dt.floquet`", "agree"),
    ("(22)", "`dt.floquet`", "agree; the clause 'or Re(sigma) <= 0' belongs to exponents"),
    ("(23), (24)", "`.drivetrain.resonances()`", "agree"),
    ("(25)", "`.drivetrain.resonances()`", "agree"),
    ("(26)", "table of natural frequencies", "not the values of (25)"),
    ("Fig. 1", "the model, theory/cardan.md", "agree"),
    ("Fig. 2", "`cardan_fig2a`, `cardan_fig2b`", "agree; the published chart has no numbers"),
    ("Figs 3, 4, 6", "`cardan_fig3`, `cardan_fig4`, `cardan_fig6`", "agree"),
    ("Figs 5, 7", "`cardan_fig5`, `cardan_fig7`", "agree: tongues upright over alpha, inclined over mu"),
    ("Tables 1, 2", "`cardan_table1`, `cardan_table2`", "most entries follow from the printed (26)"),
)


def index_section() -> str:
    """Where every equation, figure and table is computed."""
    return "## Every equation, figure and table\n\n" + markdown(["published", "computed by", "result"], EQUATIONS)


def conclusions_section() -> str:
    """Statements of sections 6 and 7 of the paper, each with the numbers of a scene."""
    fig3, fig4, fig6 = (_unstable(f"cardan_fig{number}") for number in (3, 4, 6))
    shares, independent = _shares_by_stiffness()
    by_speed, by_angle = _quarters(fig3, "Omega"), _quarters(fig3, "beta")
    slow = np.asarray(fig3.Omega) <= 0.35
    first, sixth = fig3.values[:, slow], fig6.values[:, slow]
    overlap = (first & sixth).sum() / (first | sixth).sum()
    change = 100 * (_quarters(fig4, "Omega") / by_speed - 1)
    damped, inclined = _tongue("cardan_fig5", "alpha", (1.0, 10.0, 20.0)), _tongue("cardan_fig7", "mu", (0.5, 1.0, 2.0))
    rows = [
        [
            "a larger joint angle is less stable", "`cardan_fig3`",
            f"unstable share by quarters of beta: {_list(by_angle)}", "agrees",
        ],
        [
            "a higher speed is generally less stable, with stable speeds in between", "`cardan_fig3`",
            f"unstable share by quarters of Omega: {_list(by_speed)}", "agrees up to the third quarter",
        ],
        [
            "a stiffer driven shaft is less stable", "`cardan_stiffness`",
            f"unstable share up to 30 degrees at mu = 0.25, 1, 2, 5, 10, 20: {_list(shares)} "
            f"(SciPy on a coarser grid: {_list(independent)})",
            "false at mu = 20: the tongues leave the chart upwards",
        ],
        [
            "more damping of the driven shaft is slightly more stable", "`cardan_fig3`, `cardan_fig4`",
            f"unstable share {float(fig3.mean()):.4f} and {float(fig4.mean()):.4f}", "agrees",
        ],
        [
            "this is clearer at higher speeds", "`cardan_fig3`, `cardan_fig4`",
            f"change from alpha = 1 to 20 by quarters of rising Omega: {', '.join(f'{x:.1f} %' for x in change)}",
            "the opposite",
        ],
        [
            "Figs 3 and 6 start alike, because tongues are upright at low speed", "`cardan_fig3`, `cardan_fig6`",
            f"common part of both unstable sets for Omega <= 0.35: {overlap:.2f}", "false",
        ],
        [
            "the damping ratio does not move the tongues (Fig. 5)", "`cardan_fig5`",
            f"middle of the tongue S21 at alpha = 1, 10, 20: {_list(damped)}", "agrees",
        ],
        [
            "the stiffness ratio moves them to higher speeds (Fig. 7)", "`cardan_fig7`",
            f"middle of the tongue S21 at mu = 0.5, 1, 2: {_list(inclined)}", "agrees",
        ],
    ]  # fmt: skip
    text = "Sections 6 and 7 and the abstract. The scenes are in `sweeps/`.\n"
    return f"## Conclusions\n\n{text}\n" + markdown(["the paper says", "scene", "ours", "result"], rows)


def orbit_section() -> str:
    """The stability of the forced orbit beside that of rest, and the amplitude."""
    scene = SCENES / "cardan_orbit_chart.toml"
    orbit = dt.run(scene)
    axes = {name: {"values": orbit[name].values.tolist()} for name in ("beta", "Omega")}
    rest = dt.run({"system": "cardan", "analysis": "floquet", "outputs": ["verdict"], "axes": axes, "fixed": BASE_CASE})
    known = (orbit.outcome == 0).values
    moves, still = (orbit.orbit_spectral_radius > 1).values & known, (rest.verdict == 1).values & known
    largest = np.degrees(orbit.orbit_amplitude.max("shaft").where(~still).max(("beta", "Omega")))
    rows = [
        ["cells, of these computed", f"{known.size}, {known.sum()}"],
        ["unstable about rest", f"{still.sum()}"],
        ["unstable about the orbit", f"{moves.sum()}"],
        ["stable about rest, unstable about the orbit", f"{(moves & ~still).sum()}"],
        ["unstable about rest, stable about the orbit", f"{(~moves & still).sum()}"],
        ["largest twist in a cell that is stable about rest", f"{float(largest):.1f} degrees"],
    ]
    text = (
        "`cardan_orbit_chart`, base case. The paper judges rest alone; the shaft twists by tens of degrees at speeds that "
        "rest calls stable. `amplitude` and `orbit_amplitude` of the analysis `forced` say how far.\n"
    )
    return f"## Chart of the forced orbit\n\n{text}\n" + markdown(["", "ours"], rows)


def _unstable(scene: str) -> Any:
    return dt.run(SCENES / f"{scene}.toml", overrides={"outputs": ["verdict"]}).verdict == 1


def _quarters(unstable: Any, along: str) -> np.ndarray:
    other = next(name for name in unstable.dims if name != along)
    return np.array([part.mean() for part in np.array_split(unstable.transpose(along, other).values, 4)])


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
        expected = float(np.sqrt(_natural_square(fixed["mu"], fixed["gamma"])))
        near = np.asarray(column.Omega)[column.values & (abs(np.asarray(column.Omega) - expected) < 0.2)]
        found.append(float(near.mean()))
    return found


def _natural_square(mu: float, gamma: float) -> float:
    trace = 1 + mu * (1 + 1 / gamma)
    return (trace + np.sqrt(trace**2 - 4 * mu / gamma)) / 2


def _list(values: Any) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
