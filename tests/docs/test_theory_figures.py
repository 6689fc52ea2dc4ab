"""Figures of the theory pages that no other test computes: read from the page, computed anew."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import newton

from drivetrain_jax.resonances import natural_frequencies
from drivetrain_jax.systems import get_system, tripod

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[2]
THEORY = ROOT / "docs" / "theory"
BASE = get_system("cardan").presets["base"]


def rows(page: str, head: str) -> list[list[str]]:
    """Cells of the table whose first line begins with ``head``."""
    (text,) = re.findall(rf"^\| {re.escape(head)}.*\n\|[ -|]+\n((?:\|.*\n)+)", (THEORY / page).read_text(), re.M)
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines()]


def rounds_to(value: float, printed: str) -> bool:
    """True if ``printed`` is ``value`` to its digits."""
    return abs(value - float(printed)) <= 0.501 * 10.0 ** -len(printed.partition(".")[2])


def hamiltonian(tau: float, beta: float, omega: float, zeta: float) -> np.ndarray:
    """The matrix of (10), written out."""
    c, g, alpha, mu = math.cos(beta), 1 / math.sqrt(BASE["gamma"]), BASE["alpha"], BASE["mu"]
    d = 1 - (math.sin(beta) * math.sin(tau)) ** 2
    eta, slope = c / d, c * math.sin(beta) ** 2 * math.sin(2 * tau) / d**2
    joint, first = np.outer([-eta, g], [-eta, g]), np.diag([1.0, 0.0])
    damping, stiffness = 2 * zeta / omega * (first + alpha * joint), (first + mu * joint) / omega**2
    turn = alpha * zeta / omega * g * slope * np.array([[0.0, 1.0], [-1.0, 0.0]])
    lower = omega * (-stiffness + damping @ damping / 4 - turn)
    return np.block([[-damping / 2, np.eye(2) / omega], [lower, -damping / 2]])


def clock(name: str, x: float, beta: float) -> tuple[float, float]:
    """tau and its rate in the clock of (11) or (12)."""
    if name == "tau":
        return x, 1.0
    c, r, rate = math.cos(beta), math.tan(beta / 2) ** 2, 1.0
    if name == "psi":
        k = math.sqrt(1 - r * r)
        rate = k / (math.cos(2 * x) ** 2 + (k * math.sin(2 * x)) ** 2)
        x = math.atan2(k * math.sin(2 * x), math.cos(2 * x)) / 2
    rate *= 2 * math.sqrt(c) / ((1 + c) * (1 - r * math.cos(2 * x)))
    return math.atan2(math.sin(x), math.sqrt(c) * math.cos(x)), rate


def half_period(name: str, beta: float, omega: float, steps: int, zeta: float = BASE["zeta"]) -> np.ndarray:
    """Phi by equal steps of DOP853 in a clock."""

    def field(x: float, y: np.ndarray) -> np.ndarray:
        tau, rate = clock(name, x, beta)
        return (rate * hamiltonian(tau, beta, omega, zeta) @ y.reshape(4, 4)).reshape(-1)

    step = math.pi / 2 / steps
    options = {"method": "DOP853", "rtol": 1e6, "atol": 1e6, "first_step": step, "max_step": step}
    return solve_ivp(field, (0, math.pi / 2), np.eye(4).reshape(-1), **options).y[:, -1].reshape(4, 4)


CLOCKS = [
    pytest.param(row, id=row[0], marks=[pytest.mark.full] * (int(row[1]) > 100))
    for row in rows("cardan.md", r"$\beta$, $\Omega$ | in $\tau$")
]


@pytest.mark.parametrize("row", CLOCKS)
def test_steps_in_the_three_clocks(row):
    """The number printed is enough for 1e-9, the next smaller of the ratio sqrt(2) is not."""
    beta, omega = map(float, row[0].split(","))
    exact = half_period("psi", beta, omega, 128)
    for name, printed in zip(("tau", "chi", "psi"), row[1:], strict=True):
        enough, fewer = (
            np.linalg.norm(half_period(name, beta, omega, n) - exact) < 1e-9 * np.linalg.norm(exact)
            for n in (int(printed), round(int(printed) / math.sqrt(2)))
        )
        # Eight steps are the fewest tried.
        assert enough and (not fewer or printed == "8"), name


def test_tips_are_those_of_the_page_and_predictions_of_eq_15():
    one, two = natural_frequencies(BASE["mu"], BASE["gamma"])
    tips = {name: (beta, omega) for name, _, beta, omega in rows("boundaries.md", "name | multiplier")}
    table = rows("cardan.md", "tongue | predicted")
    assert len(table) >= 8
    for name, predicted, omega, beta in table:
        kind, number = name[:-1].rstrip("+12"), int(name[-1])
        exact = (one + two) / (2 * number)
        if kind != "C":
            exact = {"1": one, "2": two}[name[1]] / (2 * number - (kind == "S"))
        assert rounds_to(exact, predicted), name
        assert rounds_to(float(tips[name][0]), beta) and rounds_to(float(tips[name][1]), omega), name
    assert f"C^-_1$ ($\\Omega = {(two - one) / 2:.4f}$)" in (THEORY / "cardan.md").read_text()


def first_order(mode: int, beta: float) -> tuple[float, float]:
    """Relative half width of S_i1 without damping, and the angle at which it begins with it."""
    omega, mu, zeta = natural_frequencies(BASE["mu"], BASE["gamma"])[mode], BASE["mu"], BASE["zeta"]
    g = (1 + mu - omega**2) / mu
    x, pull = 1 / (1 + BASE["gamma"] * g**2), abs(omega**2 - 1)
    start = 2 * math.atan(math.sqrt(zeta * omega * (1 + BASE["alpha"] * (1 - g) ** 2) / pull))
    return math.tan(beta / 2) ** 2 * pull * x / omega**2, start


@pytest.mark.parametrize(("mode", "beta", "start", "error"), [(0, 0.1, "0.02377", 5e-3), (1, 0.2, "0.10633", 1.5e-2)])
def test_first_order_of_the_subharmonic_tongues(mode, beta, start, error):
    """Edges are zeros of det A and det D of Phi."""
    half, begins = first_order(mode, beta)
    assert rounds_to(begins, start) and start in (THEORY / "cardan.md").read_text()
    middle = natural_frequencies(BASE["mu"], BASE["gamma"])[mode]

    def edge(block: slice) -> float:
        def zero(omega: float) -> float:
            return np.linalg.det(half_period("psi", beta, omega, 32 if mode else 80, 0.0)[block, block])

        return newton(zero, middle * (1 - half), x1=middle * (1 + half), tol=1e-9 * middle)

    width = abs(edge(slice(0, 2)) - edge(slice(2, 4))) / (2 * middle)
    assert abs(width / half - 1) < error


def test_folds_and_doublings_of_rattle_are_the_reference_ones():
    specials = json.loads((ROOT / "tests" / "reference" / "rattle.json").read_text())["specials"]["table1"]
    table = dict(rows("rattle.md", "quantity | value"))
    folds = f"{table['folds of the main resonance']}, {table['further folds']}".split(", ")
    for kind, printed in (("fold", folds), ("PD", table["period doublings"].split(", "))):
        exact = sorted(s["omega"] for s in specials if s["type"] == kind)
        assert len(exact) == len(printed)
        assert all(rounds_to(*pair) for pair in zip(exact, sorted(printed, key=float), strict=True)), kind


def test_constants_of_the_driveshaft():
    defaults = {p.name: p.default for p in get_system("tripod").parameters if p.default is not None}
    values = defaults | {"element": "input", "beta": math.radians(9), "zeta": 0.0016, "chi_n": 0.0026}
    e = tripod.element_of(values)
    left = float(e.c_stiffness) - float(e.c_inertia) - 0.0026
    assert rounds_to(left / (4 * 0.0016), "0.15")
    # The largest coefficient reaches 1 first; all are proportional to chi_n.
    assert rounds_to(0.0026 / max(float(e.c_stiffness), 0.0026), "0.4987")
    # exp(-zeta Omega t) falls by e in so many strobes.
    assert 3066.5 / (0.0016 * float(e.frequency)) == pytest.approx(200, rel=0.02)
    assert re.search(r"> 4\\zeta\$; .*\n.* 0\.15 ", (THEORY / "lyapunov.md").read_text())
    assert r"\chi_n < 0.4987" in (THEORY / "tripod.md").read_text()


def test_constants_of_the_cubic_fit_and_the_tube():
    """Largest zero of l1 for alpha = 0; the second moment's tube 50/45 mm."""
    r = [x.real for x in np.roots([-21 / 16, 0, 25 / 8, 0, -45 / 16, 1]) if abs(x.imag) < 1e-9]
    assert rounds_to(1 / min(r), "2.243") and "2.243 b" in (THEORY / "rattle_approximations.md").read_text()
    area = math.pi / 4 * (0.050**2 - 0.045**2)
    assert rounds_to(1e4 * area, "3.7306") and r"$3.7306\cdot10^{-4}$" in (THEORY / "bicardan.md").read_text()
