"""Drivelines with several joints: makers' rules, published properties and independent multipliers against this package."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import drivetrain_jax as dt
from benchmarks.validation.document import Page, section
from tests.oracles import driveline_reference as oracle

REFERENCE = Path(__file__).parents[2] / "tests" / "reference" / "driveline.json"
# Angles in degrees, the phase of the last joint, and what makers of shafts give: the resulting angle by the rule of squares
# with signs, and the unevenness U = max - min of the relative speed where it is printed.
MAKERS = (
    ("one joint of 2.9765", (2.9765,), 0, 2.9765, 0.0027),
    ("5 and 4, well phased", (5, 4), 90, 3.0, None),
    ("30 and 20, well phased", (30, 20), 90, math.sqrt(30**2 - 20**2), None),
    ("30 and 30, badly phased", (30, 30), 0, math.sqrt(2 * 30**2), 4 / 3 - 3 / 4),
)
# Two equal joints, badly phased, with a light tube between them and an inertia behind them, in SI units.
DOUBLE: dict[str, Any] = {
    "k": [9e3, 8e3], "c": [0.5, 0.5], "J": [0.03, 0.5], "beta": [math.radians(20)] * 2, "phase": [0.0, 0.0],
}  # fmt: skip


def variation(degrees: tuple[float, ...], last: float) -> float:
    """Peak-to-peak variation of the output speed by the package; the last phase in degrees."""
    beta = [math.radians(x) for x in degrees]
    phase = [0.0] * (len(beta) - 1) + [math.radians(last)]
    return float(dt.point("driveline", "phasing", beta=beta, phase=phase, speed=1.0).speed_variation)


def extremes(degrees: tuple[float, ...], last: float) -> float:
    """The same from 20,001 rotations of the chain by its definition, without the package."""
    turned = np.linspace(0, math.pi, 20_001)
    angle, rate = turned, np.ones_like(turned)
    for i, x in enumerate(degrees):
        beta, phase = math.radians(x), math.radians(last) if i == len(degrees) - 1 else 0.0
        phi = angle + phase
        rate = rate * math.cos(beta) / (1 - (math.sin(beta) * np.sin(phi)) ** 2)
        angle = angle + np.arctan2(
            -(math.tan(beta / 2) ** 2) * np.sin(2 * phi), 1 + math.tan(beta / 2) ** 2 * np.cos(2 * phi)
        )
    return float(rate.max() - rate.min())


def resulting_angle(uneven: float) -> float:
    """The angle in degrees of one joint with this variation: U = 2 sinh l, l = ln sec beta."""
    return math.degrees(math.acos(math.exp(-math.asinh(uneven / 2))))


def makers() -> str:
    """The resulting angle and the unevenness of plane arrangements."""
    rows = []
    for title, degrees, last, rule, printed in MAKERS:
        found = variation(degrees, last)
        shown = "-" if printed is None else f"{printed:.5f}"
        angle = resulting_angle(found)
        rows.append([title, f"{rule:.4f}", f"{angle:.4f}", shown, f"{found:.7f}", f"{extremes(degrees, last):.7f}"])
    text = (
        "Makers of shafts add squares of angles, with signs by the position of the forks, to the angle of one equivalent "
        "joint, and limit its unevenness U = 1/cos(beta) - cos(beta) to 0.0027. The rule is the limit of small angles of "
        "eq. (8), ln sec(beta) = |sum of +- ln sec(beta_j)|, which holds for all angles. It is 0.002 degrees low at 5 and "
        "4 degrees, and half a degree low at 30 and 20."
    )
    head = "angles in degrees | rule | computed angle | U, printed | U, computed | U, by definition"
    return section("Resulting angle and unevenness", text, head, rows)


def double_joint() -> str:
    """Two joints over the error of their relative phase."""
    rows = []
    for degrees in ((30, 30), (30, 25)):
        for error in (0, 5, 20, 90):
            last = 90 + error
            found = f"{variation(degrees, last):.3e} | {extremes(degrees, last):.3e}"
            rows.append(f"{degrees[0]} and {degrees[1]} | {error} | {found}")
    text = (
        "Fischer & Paul 1991: a double joint turns its output uniformly if and only if its angles are equal and its "
        "relative phase is 0, which is a phase of 90 degrees here; with unequal angles the variation is least there, and "
        "not zero. All agree."
    )
    head = "angles in degrees | error of the phase in degrees | variation, computed | by definition"
    return section("Uniform double joints", text, head, rows)


def half_critical_speed() -> str:
    """The speed of the largest twist of a badly phased double joint, beside half its first torsional frequency."""
    first = 2 * math.pi * float(dt.modes(dt.Driveline(speed=1.0, **DOUBLE)).natural_frequency[0])
    speeds = np.linspace(0.45, 0.55, 101) * first
    scene = {"system": "driveline", "analysis": "forced", "outputs": ["amplitude"], "fixed": dict(DOUBLE)}
    twist = dt.run(scene | {"axes": {"speed": {"values": speeds.tolist()}}}).amplitude.max("shaft")
    peak = float(twist.speed[int(twist.argmax("speed"))])
    rows = [[f"{first:.2f}", f"{first / 2:.2f}", f"{peak:.2f}", f"{peak / first:.4f}"]]
    text = (
        "Yao & DeSmidt 2021 report that a driveline with two joints is captured near half of its first torsional frequency. "
        "Each joint excites the second order of the speed, so the twist by `forced` is largest there."
    )
    head = "first frequency (rad/s) | half of it | speed of the largest twist | ratio"
    return section("Half critical speed", text, head, rows)


def multipliers() -> str:
    """Multipliers of six chains against 80-bit values and Lagrange multipliers."""
    rows = []
    for case in json.loads(REFERENCE.read_text())["cases"][:6]:
        ratio = [f"{p}/{q}" for p, q in case["ratio_fraction"]]
        chain = {name: case[name] for name in ("speed", "k", "c", "J", "beta", "phase")}
        found = np.asarray(
            dt.floquet(dt.Driveline(**chain, ratio=ratio), outputs=["floquet_multiplier"]).floquet_multiplier
        )
        exact = [complex(*pair) for pair in case["multipliers_absolute"]]
        independent = oracle.multipliers(case, case["period_over_pi"] * math.pi)
        apart = [max(np.abs(found - x).min() for x in other) for other in (exact, independent)]
        joints = sum(abs(math.sin(x)) > 0 for x in case["beta"])
        rows.append([case["name"], str(len(chain["k"])), str(joints), f"{np.abs(found).max():.12f}",
                     f"{np.abs(exact).max():.12f}", *(f"{x:.0e}" for x in apart)])  # fmt: skip
    text = (
        "Spectral radii of eq. (A), and the largest distance of a multiplier from values in 80 bits and "
        "from SciPy's solution of equations with Lagrange multipliers, in which the pins of a joint are perpendicular in "
        "space and no ratio of speeds is used. No published chart of a driveline with several joints has numbers."
    )
    head = "chain | inertias | joints | computed | 80 bits | distance | distance from Lagrange multipliers"
    return section("Floquet multipliers", text, head, rows)


def page(full: bool) -> Page:
    """The page of the driveline; ``full`` has no effect."""
    del full
    introduction = (
        "Rules of makers and published properties of drivelines with several Hooke joints against this package, and its "
        "multipliers against two independent computations. The equations are in "
        "[theory/driveline.md](../theory/driveline.md)."
    )
    sections = [section() for section in (makers, double_joint, half_critical_speed, multipliers)]
    return Page("Validation of the driveline", introduction, sections)
