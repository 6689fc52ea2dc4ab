"""The chaos claims of Bugaru & Vasile 2022: exponents, sections and verdicts against independent computations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.document import section
from drivetrain_jax.analysis.lyapunov.section_measures import paper_estimator
from drivetrain_jax.systems import Flow
from tests.oracles.chaos_reference import scipy_spectrum, tripod_field

BETA = math.radians(9)
# Printed values of chi_n and the range of damping ratios for which the paper claims chaos, and the excitation frequency.
CLAIMS = {"input": (0.0026, (0.0016, 0.0073, 0.011), 3066.5), "output": (0.0027, (0.0016, 0.0064, 0.0104), 2792.0)}
# Constants of (29) at 9 degrees, chi_n = 0.0026, from ../shared/reference, for the independent computation.
_CONSTANTS = {
    "Omega": 9633.726700903984, "chi": 0.0026, "c1": 0.005213670937369757, "c2": 0.0016565396527480861,
    "A_TJ": 3.652758897391374e-05, "F_over_I": 8365.245060248115, "chi_T": 0.05,
}  # fmt: skip
_SPECTRUM = ("lyapunov_spectrum", "lyapunov_standard_error", "sum_rule_residual", "verdict")


def run(analysis: str, element: str, outputs: Sequence[str], rest: Mapping[str, Any], **options: Any) -> Any:
    """A scene of the tripod at beta = 9 deg."""
    scene = {"title": "validation", "system": "tripod", "analysis": analysis, "outputs": list(outputs)}
    fixed = {"element": element, "beta": BETA, **rest.get("fixed", {})}
    return dt.run({**scene, **rest, "fixed": fixed, "options": options})


def kinds(dataset: Any) -> list[str]:
    """Verdicts in words."""
    words = dataset.verdict.attrs["flag_meanings"].split()
    return [words[int(code)].replace("_", " ") for code in np.atleast_1d(dataset.verdict.values)]


def floquet_exponents(element: str, zetas: Sequence[float], chi: float, frequency: float) -> np.ndarray:
    """Exact exponents of the linear parametric part, shape ``(len(zetas), 2)``, falling."""
    rest = {"points": {"zeta": list(zetas)}, "fixed": {"chi_n": chi, "excitation_frequency": frequency}}
    exponents = run("floquet", element, ["floquet_exponent"], rest).floquet_exponent.values.real
    return -np.sort(-exponents, axis=-1)


def spectra_section() -> str:
    """Exponents at the paper's settings."""
    rows = []
    for element, (chi, zetas, frequency) in CLAIMS.items():
        rest = {"points": {"zeta": list(zetas)}, "fixed": {"chi_n": chi, "excitation_frequency": frequency}}
        ours = run("lyapunov", element, _SPECTRUM, rest, max_time=8.0, steps=24)
        exact = floquet_exponents(element, zetas, chi, frequency)
        for i, zeta in enumerate(zetas):
            spectrum, error = ours.lyapunov_spectrum.values[i], ours.lyapunov_standard_error.values[i]
            values = f"{_pair(spectrum, 6)} | {error.max():.2g} | {_pair(exact[i], 6)} | {kinds(ours)[i]}"
            rows.append(f"{element}, zeta {zeta:g} | chaotic | {values} | {abs(float(ours.sum_rule_residual[i])):.1e}")
    text = (
        "The published figures show the estimator (31)-(36), which is not a Lyapunov exponent "
        "([theory/lyapunov.md](../theory/lyapunov.md)). The true exponents are those of a linear damped oscillator with "
        "periodic stiffness; the torque shifts them by less than 1e-4."
    )
    head = " | published | ours / s^-1 | standard error | Floquet / s^-1 | our verdict | sum rule residual"
    return section("Lyapunov exponents at the paper's settings (Figs 17-24)", text, head, rows)


# Figures 17-24: element, damping ratio, published verdict. Figures 20 and 24 are the two that are not chaotic.
FIGURES = (
    ("17", "input", 0.0016, "chaotic"), ("18", "input", 0.0073, "chaotic"), ("19", "input", 0.011, "chaotic"),
    ("20", "input", 0.0114, "not chaotic"), ("21", "output", 0.0016, "chaotic"), ("22", "output", 0.0064, "chaotic"),
    ("23", "output", 0.0104, "chaotic"), ("24", "output", 0.0112, "not chaotic"),
)  # fmt: skip


def estimator_section() -> str:
    """The paper's rule and its criteria (37)-(39), applied to all of its figures and to three known motions."""
    rows, strobes = [], 307
    for figure, element, zeta, published in FIGURES:
        chi, _, frequency = CLAIMS[element]
        rest = {"fixed": {"zeta": zeta, "chi_n": chi, "excitation_frequency": frequency}}
        time = (strobes - 0.5) / frequency
        ours = run("lyapunov", element, ["paper_estimator"], rest, max_time=time, steps=24).paper_estimator.values
        exact = floquet_exponents(element, [zeta], chi, frequency)[0]
        name = f"Fig. {figure}: {element}, zeta {zeta:g}, {frequency:g} Hz"
        rows.append([name, published, *_criteria(ours), f"{_pair(exact)}, 0"])
    for name, flow, exact in _known_motions():
        found = np.asarray(jax.jit(lambda flow=flow: paper_estimator(flow, 48, 100.0, jnp.asarray(True)))())[:, 0]
        rows.append([name, "", *_criteria(found), exact])
    head = (
        " | published | (31)-(36) / s^-1 | (37): one is positive | (38): one is near 0 | (39): the sum is negative | "
        "true exponents / s^-1"
    )
    text = (
        "The paper's rule: on every interval a perturbation of 1e-5, proportional to the solution. It does not print the "
        f"interval (here one period of the excitation, {strobes} in all); the first one, from rest, has no perturbation "
        "and is left out. The values scale with the inverse of the interval. (38) never holds: no "
        "value is near 0. (37) holds for the damped oscillator alone."
    )
    return section("The criteria (37)-(39) on the paper's estimator", text, head, rows)


def _criteria(values: np.ndarray) -> list[str]:
    """The estimates, and whether (37)-(39) hold; values below a thousandth of the largest count as 0."""
    near = bool((abs(values) < 1e-3 * abs(values).max()).any())
    told = ("yes" if holds else "no" for holds in (values.max() > 0, near, values.sum() < 0))
    return [", ".join(f"{value:.6g}" for value in values), *told]


def _known_motions() -> tuple[tuple[str, Flow, str], ...]:
    """Motions with known exponents: name, flow and exponents."""

    def oscillator(angles: Any, y: Any) -> Any:
        return y[1], -0.2 * y[1] - y[0]

    def lorenz(angles: Any, y: Any) -> Any:
        return 10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]

    def cycle(angles: Any, y: Any) -> Any:
        square = 1 - y[0] ** 2 - y[1] ** 2
        return y[0] * square - y[1], y[1] * square + y[0]

    def start(*values: float) -> tuple[np.ndarray, ...]:
        return tuple(np.array([value]) for value in values)

    return (
        ("damped oscillator x'' + 0.2 x' + x = 0", Flow(oscillator, start(1.0, 0.5), period=1.0), "-0.1, -0.1"),
        ("Lorenz (chaotic)", Flow(lorenz, start(1.0, 1.0, 20.0), period=0.1), "0.9056, 0, -14.5723"),
        ("stable limit cycle r' = r (1 - r^2)", Flow(cycle, start(0.5, 0.0), period=1.0), "0, -2"),
    )


def independent_section() -> str:
    """Sum and values of the exponents of (29) by SciPy and by the package, over the same short time from rest."""
    strobes = 320
    scipy = scipy_spectrum(
        tripod_field(_CONSTANTS | {"zeta": 0.0073, "frequency": 3066.5}), np.zeros(2), 1 / 3066.5, strobes, 1e-11
    )
    rest = {"points": {"zeta": [0.0073]}, "fixed": {"chi_n": 0.0026, "excitation_frequency": 3066.5}}
    ours = run("lyapunov", "input", ["lyapunov_spectrum"], rest, max_time=(strobes - 0.5) / 3066.5, steps=12)
    sums = f"{float(ours.lyapunov_spectrum.sum()):.6f} | {scipy.sum():.6f}"
    row = f"sum of the exponents, zeta 0.0073 | {sums} | agree; windows differ by the discarded transient"
    return section("An independent computation", "", " | ours | SciPy DOP853, 1e-11, with QR | ", [row])


def controls_section(full: bool) -> str:
    """Settings whose verdict is known."""
    points = {"M_AEM": [0.0, 0.0, 0.0], "chi_n": [0.01, 0.025, 0.05]}
    rest = {"points": points, "fixed": {"zeta": 0.0016, "excitation_frequency": 3066.5}}
    ours = run("lyapunov", "input", _SPECTRUM, rest, max_time=1.2, steps=12)
    exact = [floquet_exponents("input", [0.0016], chi, 3066.5)[0, 0] for chi in points["chi_n"]]
    rows = [
        f"homogeneous, chi_n {chi:g} | Floquet {value:.4f} | {float(ours.lyapunov_spectrum[i, 0]):.4f} | {kinds(ours)[i]}"
        for i, (chi, value) in enumerate(zip(points["chi_n"], exact, strict=True))
    ]
    chaos = chaotic_control(128 if full else 64)
    value, error = (float(chaos[name][0, 0]) for name in ("lyapunov_spectrum", "lyapunov_standard_error"))
    found = f"{value:.0f} +- {error:.0f}, K {float(chaos.chaos_k01[0]):.3f} | {kinds(chaos)[0]}"
    rows.append(f"chi_n 0.3, zeta 0.03, torque x 8.4e4, chi_AEM 0.5 | 1218 +- 12, K 0.997 | {found}")
    text = (
        "The verdict detects instability and chaos where (29) has them. The last row is an unphysical control. The "
        "theory note gives -6.83, 6.43 and 28.39 for the first three. These are means over about 4000 strobes from "
        "the displacement (1, 0) at t = 0, with the initial alignment included; 4000 powers of the monodromy matrix "
        "by SciPy give -6.826, 6.434 and 28.399, and 20,000 give -6.604, 6.671 and 28.659. The limits are the "
        "Floquet exponents in the table."
    )
    return section("Positive controls", text, " | independent | ours / s^-1 | our verdict", rows)


def chaotic_control(steps: int) -> Any:
    """The bounded chaotic case of the note."""
    omega = _CONSTANTS["Omega"]
    fixed = {
        "zeta": 0.03, "chi_n": 0.3, "M_AEM": 8.4e4 * 2550.0, "chi_AEM": 0.5, "excitation_frequency": omega / math.pi,
        "motor_order": 0.618 * omega / (100 * math.pi),
    }  # fmt: skip
    rest = {"points": {"velocity0": [0.0]}, "fixed": fixed}
    return run("lyapunov", "input", (*_SPECTRUM, "chaos_k01"), rest, max_time=0.3, steps=steps)


def sections_section(full: bool) -> str:
    """The paragraph about the Poincare sections of Figs 25-30."""
    strobes = 50000 if full else 2000
    rows = []
    for element, (chi, zetas, frequency) in CLAIMS.items():
        rest = {"points": {"zeta": list(zetas)}, "fixed": {"chi_n": chi, "excitation_frequency": frequency}}
        outputs = ["torus_residual", "distinct_points", "chaos_k01"]
        ours = run("poincare", element, outputs, rest, strobes=strobes, discard=10000, steps=24)
        for i, zeta in enumerate(zetas):
            count = int(ours.distinct_points[i])
            residual, k01 = float(ours.torus_residual[i].max()), float(ours.chaos_k01[i])
            found = f"{residual:.1e} | {count or 'no repetition'} | {k01:.3f}"
            rows.append(f'{element}, zeta {zeta:g} | "diffuse structure", strange attractor | {found}')
    head = " | published | distance from a smooth curve / largest value | distinct points | K"
    text = f"{strobes} strobes after 10,000 discarded ones, 24 steps of order 8 per strobe."
    return section("Poincare sections (Figs 25-30)", text, head, rows)


def _pair(values: Sequence[float], digits: int = 4) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def sections(full: bool) -> tuple[str, ...]:
    """The chaos part of the tripod's page."""
    chaos = spectra_section(), estimator_section(), independent_section()
    return *chaos, controls_section(full), sections_section(full)
