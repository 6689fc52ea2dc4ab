"""The cardan shaft: Soltan Rezaee & Ghazavi 2014 against this package."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.cardan_conclusions import found, orbit_section
from benchmarks.validation.document import Page, inventory, section
from tests.oracles.cardan_orbit_reference import linear_response, nonlinear_orbit
from tests.oracles.cardan_paper import (
    PRINTED_FREQUENCIES,
    PRINTED_SPEEDS,
    base_chart,
    natural_frequencies,
    predicted_speeds,
    printed_matrices,
    unstable_fraction,
)
from tests.oracles.cardan_reference import (
    BASE_CASE,
    damping_and_stiffness,
    monodromy,
    spectral_radius,
    stacked_monodromy,
)

HEAD = " | published | ours | independent | why they differ"


def package_chart(outputs: Sequence[str], **fixed: float) -> Any:
    """The base chart, 151 x 200, by the package."""
    axes = {"beta": {"start": 0.0, "stop": 1.5, "num": 151}, "Omega": {"start": 0.01, "stop": 2.0, "num": 200}}
    return dt.run(_scene("floquet", outputs, {"axes": axes, "fixed": BASE_CASE | fixed}))


def package_points(analysis: str, outputs: Sequence[str], points: Mapping[str, Sequence[float]], **fixed: float) -> Any:
    """The listed points, the other parameters as in the base case, by the package."""
    rest = {name: value for name, value in (BASE_CASE | fixed).items() if name not in points}
    return dt.run(_scene(analysis, outputs, {"points": {k: list(v) for k, v in points.items()}, "fixed": rest}))


def _scene(analysis: str, outputs: Sequence[str], rest: Mapping[str, Any]) -> dict[str, Any]:
    return {"title": "validation", "system": "cardan", "analysis": analysis, "outputs": list(outputs), **rest}


def frequencies_section() -> str:
    """Natural frequencies and Tables 1-2."""
    from drivetrain_jax import resonances

    exact, independent = resonances.natural_frequencies(1.0, 100.0), natural_frequencies()
    why = "the paper's own (25) does not give its (26)"
    rows = [
        f"omega{i + 1} | {printed:.3f} | {exact[i]:.12f} | {independent[i]:.12f} | " + why
        for i, printed in enumerate(PRINTED_FREQUENCIES)
    ]
    ours, rounded = predicted_speeds(exact), predicted_speeds(PRINTED_FREQUENCIES)
    speeds = [
        f"{name} | {printed:.3f} | {ours[name]:.6f} | {rounded[name]:.4f} | "
        + _speed_reason(printed, rounded[name], ours[name])
        for name, printed in PRINTED_SPEEDS.items()
    ]
    head = " | published | ours | {} | why they differ"
    independent = head.format("independent: eigenvalues of the stiffness matrix")
    predicted = head.format("from the printed 0.072 and 1.422")
    return "\n".join([
        section("Natural frequencies, eqs (25)-(26)", "", independent, rows),
        section("Tables 1 and 2: predicted resonance speeds", "", predicted, speeds),
    ])  # fmt: skip


def _speed_reason(printed: float, from_printed: float, exact: float) -> str:
    if abs(from_printed - printed) < 0.00051:
        return (
            "follows from the printed frequencies, not from the exact ones"
            if abs(exact - printed) > 0.00051
            else "agree in the printed digits"
        )
    if abs(exact - printed) < 0.00051:
        return "agrees with the exact frequency, not with the printed one"
    return "its last digit follows from neither set of frequencies"


def equations_section(stride: int) -> str:
    """Unstable fraction of the base chart with the checked and the printed equations; stability criterion."""
    chart = package_chart(["spectral_radius", "floquet_multiplier", "verdict"])
    unstable = (chart.verdict == 1).values
    outside = np.abs(chart.floquet_multiplier.values) > 1
    kept = (outside & (chart.floquet_multiplier.values.real > 0)).any(axis=-1) & unstable
    cells = base_chart(stride)["beta"].size
    fraction, dropped = unstable_fraction(damping_and_stiffness, stride)
    printed, sign_only = (unstable_fraction(printed_matrices(sign), stride)[0] for sign in (1.0, -1.0))
    share = 1 - kept.sum() / unstable.sum()
    rows = [
        f"checked E and P | - | {unstable.mean():.4f} | {fraction:.4f} | linearisation of the paper's (1), (5), (6)",
        f"E and P as printed in (15) | - | - | {printed:.4f} | unstable almost everywhere, against Figs 2-3, so the authors "
        "did not compute with (15)",
        f"only the sign of P21 corrected | - | - | {sign_only:.4f} | without eta'' and with eta' in place of 2 eta' the "
        "chart is empty",
        f"share of the unstable cells that 'or Re(sigma) <= 0' calls stable | - | {share:.3f} | {dropped:.3f} | a clause "
        "for exponents; the multipliers of every S tongue are negative",
    ]
    text = (
        "Unstable fraction of the base chart (zeta 0.001, alpha = mu = 1, gamma = 100; beta 0..1.5, Omega 0.01..2). Ours: "
        f"151 x 200 cells. Independent: {cells} of them by SciPy's DOP853 in the paper's own coordinates."
    )
    return section("Equations and stability criterion", text, HEAD, rows)


def trends_section() -> str:
    """Statements of the paper about damping, stiffness and narrow tongues."""
    from drivetrain_jax import resonances

    alpha20 = float((package_chart(["verdict"], alpha=20.0).verdict == 1).mean())
    speeds = predicted_speeds(resonances.natural_frequencies(20.0, 100.0))
    peaks = ", ".join(f"{speeds[name]:.3f}" for name in ("S21", "C+1", "H21"))
    rows = [
        f'Fig. 4, alpha = 20: unstable fraction | "slightly smaller" | {alpha20:.4f} |  | agree (base case: first table)',
        f"Fig. 6, mu = 20: S21, C+1, H21 | peaks above Omega = 2 | {peaks} |  | agree; the text calls the figure's ratio a "
        "damping ratio",
        *_destabilising_rows(),
        _narrow_tongue_row(),
    ]
    return section("Trends", "", HEAD, rows)


def _destabilising_rows() -> list[str]:
    zetas = [0.0, 0.001, 0.01]
    points = {"beta": [1.14] * 3, "Omega": [0.6695] * 3, "zeta": zetas}
    ds = package_points("floquet", ["spectral_radius", "verdict"], points)
    names = ds.verdict.attrs["flag_meanings"].split()
    rows = []
    for zeta, rho, code in zip(zetas, ds.spectral_radius.values, ds.verdict.values, strict=True):
        independent = spectral_radius(monodromy(BASE_CASE | {"beta": 1.14, "Omega": 0.6695, "zeta": zeta}))
        why = "bounded without damping" if zeta == 0 else "damping destabilises here, against the paper's conclusion"
        found = f"{rho:.10f}, {names[code]} | {independent:.10f}"
        rows.append(f'rho at (1.14, 0.6695), zeta = {zeta:g} | "damping stabilises" | {found} | {why}')
    return rows


def _narrow_tongue_row() -> str:
    beta, omega = np.linspace(0.0225, 0.0255, 13), np.linspace(0.0706, 0.07065, 21)
    grid = [values.ravel() for values in np.meshgrid(beta, omega, indexing="ij")]
    ds = package_points("floquet", ["verdict"], {"beta": grid[0], "Omega": grid[1]})
    rho = spectral_radius(stacked_monodromy({"beta": grid[0], "Omega": grid[1], **BASE_CASE}, 1e-11, 1e-11))
    found = " | ".join(f"{grid[0][unstable].min():.5f}" for unstable in (ds.verdict.values == 1, rho > 1))
    why = "the paper's spacing of 0.01 steps over the tip; grid here: 0.00025 x 2.5e-6"
    return f"smallest unstable beta of the tongue S11 | not visible | {found} | {why}"


def forced_section() -> str:
    """Forced response, and the forced orbit that it approximates; the paper analyses only the homogeneous equation."""
    cases = ((0.8, 1.3), (0.5236, 1.416), (0.5, 0.72))
    points = {"beta": [b for b, _ in cases], "Omega": [o for _, o in cases]}
    about_zero = package_points("floquet", ["spectral_radius"], points).spectral_radius.values
    outputs = ["amplitude", "orbit_state", "orbit_amplitude", "orbit_spectral_radius", "orbit_count"]
    ours = package_points("forced", outputs, points)
    rows = []
    for i, (beta, omega) in enumerate(cases):
        p = BASE_CASE | {"beta": beta, "Omega": omega}
        # Two digits decide which one of several orbits Newton's method finds.
        near = np.round(ours.orbit_state[i].values, 2)
        linear, (_, amplitude, rho) = linear_response(p)[1], nonlinear_orbit(p, near)
        at = f"({beta:g}, {omega:g})"
        rows += [
            f"{at} rho about theta = 0 | {about_zero[i]:.8f} | {spectral_radius(monodromy(p)):.8f}",
            f"{at} nonlinear orbits found | {int(ours.orbit_count[i])} | ",
            f"{at} rho about the nonlinear orbit | {float(ours.orbit_spectral_radius[i]):.8f} | {rho:.8f}",
            f"{at} linear amplitudes / rad | {_pair(ours.amplitude[i].values)} | {_pair(linear)}",
            f"{at} amplitudes of the orbit / rad | {_pair(ours.orbit_amplitude[i].values)} | {_pair(amplitude)}",
        ]
    text = (
        "The paper keeps the forcing (0, -eta')^T in (15), but judges stability by the homogeneous part, about "
        "theta = 0. The shaft moves along a forced periodic orbit instead. Where several orbits coexist, the values are "
        "those of the smallest stable one, or of the smallest one if none is stable. The paper publishes no values here."
    )
    return section("Forced response and the true orbit", text, " | ours | independent (SciPy shooting)", rows)


def _pair(values: Sequence[float]) -> str:
    return f"{values[0]:.5f}, {values[1]:.5f}"


def page(full: bool) -> Page:
    """The page; ``full`` compares the equations on all cells instead of every second row and column."""
    return Page(
        "Validation of the cardan shaft",
        "Soltan Rezaee & Ghazavi 2014 against this package; the corrected equations are derived in "
        "[theory/cardan.md](../theory/cardan.md).",
        (frequencies_section(), equations_section(1 if full else 2), trends_section(), forced_section(), orbit_section(),
         inventory("cardan", **found())),
    )  # fmt: skip
