"""The double-tripod driveshaft: Bugaru & Vasile 2022 against this package."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import root

import drivetrain_jax as dt
from benchmarks.validation import tripod_chaos
from benchmarks.validation.document import Page, inventory, section, table
from drivetrain_jax import Tripod, floquet
from tests.oracles import tripod_reference as oracle

NINE_DEGREES = math.radians(9)
REFERENCE = Path(__file__).parents[2] / "tests" / "reference" / "tripod.json"
# Figs 11-16: equation, damping and the stated chi_n.
HISTORIES = (
    ("25", 0.0016, 0.0026), ("25", 0.0073, 0.0026), ("25", 0.0129, 0.0026),
    ("26", 0.0016, 0.0027), ("26", 0.0064, 0.0027), ("26", 0.0112, 0.0027),
)  # fmt: skip
_NAMES = ("input", "output")
LOWEST_DAMPING = 0.0016
# Element, excitation frequency, damping, chi_n.
FLOQUET = (
    ("input", 3066.5, 0.0016, 0.0026), ("input", 3066.5, 0.0073, 0.0026),
    ("input", 3066.5, 0.0114, 0.0026), ("output", 2792.0, 0.0016, 0.0027),
)  # fmt: skip


def run(analysis: str, outputs: Sequence[str], fixed: dict[str, Any], **rest: Any) -> Any:
    """One scene of the package at 9 degrees."""
    scene = {"title": "validation", "system": "tripod", "analysis": analysis, "outputs": list(outputs)}
    return dt.run(scene | {"fixed": {"beta": NINE_DEGREES} | fixed} | rest)


def constants_section() -> str:
    """Figs 9-10 and Tables 1-3."""
    rows = [
        *_constants_of("input", 1, "9632", "0.0026", "3066 Hz x pi = 9632.1"),
        *_constants_of("output", 3, "8767", "0.0027", "2792 Hz x 3.14 = 8766.9"),
    ]
    frequencies = run("parameters", ["midshaft_frequency"], {"element": "input"}).midshaft_frequency.values
    speed = math.sqrt(oracle.G / oracle.RHO)
    for k, (found, printed) in enumerate(zip(frequencies, (1669.2, 3338.4, 5007.6, 6676.8, 8346.0), strict=True), 1):
        expected = k * speed / (2 * oracle.LENGTH)
        rows.append(f"nu_{k} / Hz | {printed:g} | {found:.6f} | {expected:.6f} | multiples of a rounded 1669.2")
    head = " | published | ours | independent: moments of area | why they differ"
    return section("Constants: Figs 9-10, Tables 1-3", "", head, rows)


def _constants_of(name: str, k: int, printed: str, chi: str, product: str) -> list[str]:
    """Rows of one element, from the printed values of Omega and chi_n."""
    outputs = ["natural_angular_frequency", "torsional_stiffness", "chi_n"]
    ours, plain = run("parameters", outputs, {"element": name}), oracle.shaft(name)
    omega, stiffness, chi_n = (float(ours[output]) for output in outputs)
    formula = float(run("parameters", ["chi_n"], {"element": name, "chi_source": "printed_formula"}).chi_n)
    frequency = "3066.5" if k == 1 else "2792"
    return [
        f"Omega{k} at 9 deg / rad/s | {printed} | {omega:.9f} | {plain.omega:.9f} | the printed {product} is the frequency "
        "read off the graph, not (22)-(23)",
        f"2 Omega{k}/2 pi / Hz | {frequency} | {omega / math.pi:.6f} | {plain.omega / math.pi:.6f} | agree in the "
        "printed digits",
        f"torsional stiffness of the {name} element / N m/rad | 1.11e4 | {stiffness:.6e} | "
        f"{plain.omega**2 * plain.inertia:.6e} | (1) with the data of the same table",
        f"chi_n of the {name} element | {chi} | {chi_n:.6e}; appendix B as printed: {formula:.6e} | {plain.chi_n:.6e} | "
        "appendix B omits chi_B; the stated value follows from neither",
    ]


def angles_section() -> str:
    """Omega over the joint angle."""
    angles = [math.radians(degree) for degree in range(10)]
    scene = {"system": "tripod", "analysis": "parameters", "outputs": ["natural_angular_frequency"]}
    scene["axes"] = {"beta": {"values": angles}}
    curves = [dt.run(scene | {"fixed": {"element": name}}).natural_angular_frequency.values for name in _NAMES]
    curves += [[oracle.shaft(name, angle).omega for angle in angles] for name in _NAMES]
    rows = [[str(degree), *(f"{omega:.4f}" for omega in row)] for degree, row in enumerate(zip(*curves, strict=True))]
    head = "beta / deg | Omega1, ours | Omega3, ours | Omega1, independent | Omega3, independent"
    return section("Natural angular frequencies over the joint angle / rad/s", "", head, rows)


def histories_section() -> str:
    """States of the equations of Figs 11-16 against SciPy, with our own error estimate."""
    times = [0.01, 0.05]
    outputs = ["phi", "velocity", "phi_error"]
    rows = []
    for equation, zeta, chi in HISTORIES:
        fixed = {"element": oracle.EQUATIONS[equation], "equation": equation, "zeta": zeta, "chi_n": chi}
        ours = run("history", outputs, fixed, options={"times": times, "rtol": 1e-10})
        phi, velocity = oracle.history(equation, times, zeta, chi)
        for k, t in enumerate(times):
            values = f"{float(ours.phi[k]):.12e} | {phi[k]:.12e} | {float(ours.velocity[k]):.9f} | {velocity[k]:.9f}"
            rows.append(f"({equation}), zeta {zeta:g}, t = {t:g} s | {values} | {float(ours.phi_error[k]):.1e}")
    text = (
        "All histories start from rest and use the stated chi_n. The paper prints only graphs. Every history is a "
        "damped oscillation about a static twist. The phase portraits that the paper calls strange attractors are "
        "its transient."
    )
    head = " | phi, ours | phi, SciPy | velocity, ours | velocity, SciPy | estimated error of phi"
    return section("Histories: the equations of Figs 11-16", text, head, rows)


# Times without transient, in s.
STEADY = np.linspace(0.4, 0.5, 4001).tolist()


def readings_section() -> str:
    """Both readings of the printed torque sums, which differ in histories but not in stability."""
    rows = []
    for equation, zeta, chi in HISTORIES[::3]:
        name = oracle.EQUATIONS[equation]
        fixed = {"element": name, "zeta": zeta, "chi_n": chi}
        options = {"times": STEADY, "rtol": 1e-9}
        octave, harmonic = (
            run("history", ["phi"], fixed | {"equation": equation, "torque_reading": reading}, options=options).phi
            for reading in ("octave", "harmonic")
        )
        times = {"max_time": 4.0, "steps": 24}
        exponents = [
            run("lyapunov", ["lyapunov_spectrum"], fixed | {"torque_reading": reading}, options=times).lyapunov_spectrum
            for reading in ("octave", "harmonic")
        ]
        rows.append(
            f"({equation}), zeta {zeta:g} | {float(abs(harmonic / octave - 1).max()):.2%} | "
            f"{float(np.ptp(octave.values)):.2e}, {float(np.ptp(harmonic.values)):.2e} | "
            f"{float(abs(exponents[0] - exponents[1]).max()):.1e}"
        )
    text = (
        "(6) and (9) can be read as sums of octaves, cos(2^i x)/2^(i+1), or of harmonics, cos(2 i x)/(2 i + 1). The reading "
        "changes the twist, and no exponent: no verdict of this page depends on it. From 0.4 s on less than 0.4 % of the "
        "transient is left."
    )
    head = " | largest change of phi from 0.4 to 0.5 s | range of phi / rad: octaves, harmonics | change of exponents / 1/s"
    return section("Readings of the torque", text, head, rows) + f"\n{_motor_orders()}"


def _motor_orders() -> str:
    """The twist of the input element for each of the printed orders of the motor."""
    fixed, rows = {"element": "input", "equation": "25", "zeta": 0.0016, "chi_n": 0.0026}, []
    options = {"times": [0.01], "rtol": 1e-9}
    for order in (6, 12, 24, 48, 96):
        ours = float(run("history", ["phi"], fixed | {"motor_order": order}, options=options).phi[0])
        scipy = float(oracle.history("25", [0.01], 0.0016, 0.0026, motor_order=order)[0, 0])
        rows.append([str(order), f"{ours:.9e}", f"{scipy:.9e}", f"{ours / float(rows[0][1]) - 1 if rows else 0:+.1%}"])
    text = (
        "(7) prints five orders n of the motor and does not say which one the figures have. Figs 11 to 13 are computed with "
        "n = 6. (25), zeta 0.0016, phi(0.01 s):\n"
    )
    return f"{text}\n" + table("n | phi, ours | phi, SciPy | against n = 6", rows)


def floquet_section() -> str:
    """Multipliers and exponents of the linear parametric part, and the critical nonuniformity."""
    outputs = ["spectral_radius", "floquet_exponent", "liouville_residual"]
    rows = []
    for name, frequency, zeta, chi in FLOQUET:
        fixed = {"element": name, "zeta": zeta, "chi_n": chi, "excitation_frequency": frequency}
        ours = run("floquet", outputs, fixed)
        exponents = ", ".join(f"{x:.6f}" for x in ours.floquet_exponent.values)
        rows.append(
            f"{name}, {frequency:g} Hz, zeta {zeta:g}, chi_n {chi:g} | {float(ours.spectral_radius):.12f} | "
            f"{oracle.spectral_radius(name, zeta, frequency, chi):.12f} | {exponents} | {float(ours.liouville_residual):.1e}"
        )
    tips, lowest = [], math.inf
    printed = [(case["zeta"], f"{case['chi_n']:.12f}") for case in json.loads(REFERENCE.read_text())["critical_chi_n"]]
    for zeta, expected in ((LOWEST_DAMPING, "0.0173632641"), *printed):
        independent = oracle.critical_nonuniformity("input", zeta)
        chi_n, frequency = _tip_of_tongue(zeta, independent)
        lowest = min(lowest, chi_n)
        found = f"{chi_n:.12f} at {frequency:.4f} Hz | {independent[0]:.10f} at {independent[1]:.2f} Hz"
        tips.append(f"{zeta:g} | {found} | {expected}")
    text = (
        "The paper reports chaos and parametric instability here. The linear parametric part is stable at every "
        "setting of the paper. It becomes unstable at the values of chi_n in the second table: at the paper's lowest "
        f"damping, {LOWEST_DAMPING:g}, at {lowest / 0.0026:.2f} times the stated 0.0026."
    )
    head = " | spectral radius, ours | SciPy | exponents / 1/s | determinant minus its exact value"
    critical = table("zeta | critical chi_n, ours | SciPy (brentq, bounded search) | theory note", tips)
    return section("Floquet multipliers of (29) and (30)", text, head, rows) + f"\n{critical}"


def _tip_of_tongue(zeta: float, start: tuple[float, float]) -> np.ndarray:
    """chi_n and frequency [Hz] at which the spectral radius is 1 and largest over the frequency, near ``start``."""
    unit = np.array(start)

    def radius(relative: Any) -> Any:
        chi_n, frequency = relative * unit
        shaft = Tripod(element="input", beta=NINE_DEGREES, zeta=zeta, chi_n=chi_n, excitation_frequency=frequency)
        return floquet(shaft, rtol=1e-13).spectral_radius

    slopes = jax.jit(jax.value_and_grad(radius))

    def misses(relative: np.ndarray) -> list[float]:
        value, (_, along) = slopes(relative)
        return [float(value) - 1, float(along)]

    return root(misses, np.ones(2), tol=1e-13).x * unit


def range_section(full: bool) -> str:
    """The largest exponent over the range of the paper."""
    rows = []
    for name, low, high, stated in (("input", 2950.0, 3200.0, 0.0026), ("output", 2650.0, 2950.0, 0.0027)):
        # The tip of the resonance is narrower than the steps, so it is added to the values.
        steps = np.linspace(low, high, 501 if full else 101)
        axes = {
            "excitation_frequency": {"values": sorted({*steps.tolist(), oracle.shaft(name).omega / math.pi})},
            "zeta": {"start": 0.0016, "stop": 0.0318, "num": 40 if full else 8},
        }
        for source, chi in (("derived", None), ("appendix B", "printed_formula"), (f"stated {stated:g}", stated)):
            given = {} if chi is None else {"chi_source": chi} if isinstance(chi, str) else {"chi_n": chi}
            ds = run("floquet", ["floquet_exponent", "verdict"], {"element": name} | given, axes=axes)
            largest = float(ds.floquet_exponent.max())
            stable = int(np.sum(ds.verdict.values == 0))
            rows.append([name, source, f"{stable} of {ds.verdict.size}", f"{largest:.4f}"])
    text = "Excitation frequencies and dampings (0.0016 to 0.0318) for which the paper reports chaos at low damping."
    head = "element | chi_n | stable points | largest exponent / 1/s"
    return section("Stability in the range of the paper", text, head, rows)


def page(full: bool) -> Page:
    """The page; with ``full`` the range of the paper has finer steps."""
    sections = (constants_section(), angles_section(), histories_section(), readings_section(), floquet_section())
    return Page(
        "Validation of the double-tripod driveshaft",
        "Bugaru & Vasile 2022 against this package; the reconstructed equations are in "
        "[theory/tripod.md](../theory/tripod.md).",
        (*sections, range_section(full), *tripod_chaos.sections(full), inventory("tripod")),
    )
