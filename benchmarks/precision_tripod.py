"""Error against run time for the double tripod: its state after many strobes, by integrators.

    python -m benchmarks.precision_tripod [--quick] [--out FOLDER]     # precision_tripod.csv and .png

The equation is (29) of the input element, from rest over 1,000 strobes (stiff and slow excitation 128, the chaotic control
40). Times are per strobe of one motion. The error is that of (phi, phi'/Omega) at the last strobe relative to the size of
the motion, against a Taylor integration by heyoka.py at 1e-19 in extended precision (SciPy's DOP853 at 3e-14 if heyoka.py
is not installed). The head of the CSV gives the difference of these two references over the first strobes.

"fixed steps" is the package's ``poincare``, 64 motions at a time. "adaptive 5(4)" is its pair for demonstrations of loose
tolerances. "history" is its diffrax path, whose rtol applies to the motion; its steps have a hundredth of this tolerance.
SciPy integrates one motion, heyoka.py a batch of 8 equal ones, in the dimensionless time Omega t.

Regions: damping 0.05 (easy); the paper's damping (typical); 1 % below the tip of the principal tongue (chi_n 0.01736);
overdamped, zeta = 30; damping 1e-12; excitation at 200 Hz, 15 natural periods a strobe; the chaotic control of
docs/validation/tripod.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.engine_job import columns_scene, engine_job, told
from benchmarks.precision import Contender, Judged
from benchmarks.precision_study import study
from benchmarks.timing import once
from tests.oracles.tripod_reference import NINE_DEGREES, Shaft, shaft

_OMEGA = shaft("input").omega
# All parameters that differ between regions, so that the regions share kernels.
_PAPER = {
    "zeta": 0.0016, "chi_n": 0.0026, "excitation_frequency": 3066.5, "M_AEM": 2550.0, "chi_AEM": 0.05, "motor_order": 6.0,
}  # fmt: skip


@dataclass(frozen=True)
class Region:
    """Parameters of the package, those of the equation, and the strobe at whose end the state is compared."""

    parameters: Mapping[str, float]
    strobes: int = 1000

    @property
    def shaft(self) -> Shaft:
        """The constants of the equation."""
        p = self.parameters
        made = shaft("input", chi_n=p["chi_n"])
        return replace(made, acceleration=p["M_AEM"] / 2550.0 * made.acceleration, ripple=p["chi_AEM"])

    @property
    def motor(self) -> float:
        """Angular frequency of the motor [rad/s]."""
        return 100 * math.pi * self.parameters["motor_order"]

    @property
    def period(self) -> float:
        """The period of a strobe in the time Omega t."""
        return _OMEGA / self.parameters["excitation_frequency"]

    @property
    def beginning(self) -> Region:
        """The same region over fewer strobes, for a second reference in seconds instead of a minute."""
        return replace(self, strobes=max(self.strobes // 8, 40))


# In the order of ``_PAPER``, so that the kernels are the same.
_CONTROL = _PAPER | {
    "zeta": 0.03, "chi_n": 0.3, "M_AEM": 8.4e4 * 2550.0, "chi_AEM": 0.5, "excitation_frequency": _OMEGA / math.pi,
    "motor_order": 0.618 * _OMEGA / (100 * math.pi),
}  # fmt: skip
REGIONS = {
    "easy": Region(_PAPER | {"zeta": 0.05}),
    "typical": Region(_PAPER),
    "near a tongue": Region(_PAPER | {"chi_n": 0.0172}),
    "stiff, zeta = 30": Region(_PAPER | {"zeta": 30.0}, 128),
    "no damping": Region(_PAPER | {"zeta": 1e-12}),
    "slow excitation": Region(_PAPER | {"excitation_frequency": 200.0}, 128),
    "chaotic control": Region(_CONTROL, 40),
}
_LANES, _LEAST = 64, 128
# Batch size of heyoka.py: as many numbers as an AVX-512 vector holds; 4 and 16 are slower.
_BATCH = 8


def field_of(region: Region) -> Callable[[float, np.ndarray], tuple[float, float]]:
    """(29) for SciPy in the time x = Omega t, state (phi, phi'/Omega), in plain Python floats."""
    s, zeta = region.shaft, region.parameters["zeta"]
    turn, motor = 2 * math.pi / region.period, region.motor / _OMEGA
    mean, cos, sin, sqrt = s.acceleration / s.omega**2, math.cos, math.sin, math.sqrt

    def field(x: float, y: np.ndarray) -> tuple[float, float]:
        phi, rate = y.tolist()
        c = cos(turn * x)
        g = (1 + s.c1 * c) / ((1 + s.c2 * c) * (1 + s.chi_n * c))
        a = cos(motor * x)
        ripple, weight = 0.0, 0.5
        for _ in range(6):
            ripple += weight * a
            a, weight = 2 * a * a - 1, weight / 2
        torque = mean * (1 + s.ripple * ripple) * (1 - 3 * s.joint * sin(3 * phi)) / (1 + s.chi_n * cos(2 * phi))
        return rate, torque - 2 * zeta * sqrt(g) * rate - g * phi

    return field


def by_scipy(region: Region, method: str, rtol: float) -> np.ndarray:
    """State at the last strobe; NaN if SciPy gave up."""
    end, size = region.strobes * region.period, region.shaft.acceleration / _OMEGA**2
    found = solve_ivp(field_of(region), (0, end), (0.0, 0.0), method, rtol=rtol, atol=0.1 * rtol * size, t_eval=(end,))
    return found.y[:, -1] if found.success else np.full(2, np.nan)


def _equations() -> list[tuple[Any, Any]]:
    """(29) for heyoka.py, with its constants as parameters."""
    import heyoka as hy

    phi, rate = hy.make_vars("phi", "rate")
    zeta, chi, c1, c2, mean, ripple, joint, turn, motor = (hy.par[i] for i in range(9))
    c = hy.cos(turn * hy.time)
    g = (1.0 + c1 * c) / ((1.0 + c2 * c) * (1.0 + chi * c))
    cosines = [hy.cos(motor * hy.time)]
    for _ in range(5):
        cosines.append(2.0 * cosines[-1] * cosines[-1] - 1.0)
    waves = sum(2.0 ** -(i + 1) * a for i, a in enumerate(cosines))
    torque = mean * (1.0 + ripple * waves) * (1.0 - 3.0 * joint * hy.sin(3.0 * phi)) / (1.0 + chi * hy.cos(2.0 * phi))
    return [(phi, rate), (rate, torque - 2.0 * zeta * hy.sqrt(g) * rate - g * phi)]


def _constants(region: Region) -> list[float]:
    s = region.shaft
    return [region.parameters["zeta"], s.chi_n, s.c1, s.c2, s.acceleration / s.omega**2, s.ripple, s.joint,
            2 * math.pi / region.period, region.motor / _OMEGA]  # fmt: skip


@once
def _taylor(tolerance: float) -> Any:
    import heyoka as hy

    start, constants = np.zeros((2, _BATCH)), np.zeros((9, _BATCH))
    return hy.taylor_adaptive_batch(_equations(), start, tol=tolerance, pars=constants, force_avx512=True)


@once
def _extended() -> Any:
    """The same integrator in the 80-bit numbers of x86 processors; on other processors these may be doubles."""
    import heyoka as hy

    zeros, tolerance = np.zeros(11, np.longdouble), np.longdouble(1e-19)
    return hy.taylor_adaptive(_equations(), zeros[:2], tol=tolerance, pars=zeros[2:], fp_type=np.longdouble)


def by_heyoka(region: Region, tolerance: float) -> np.ndarray:
    """State of a batch of equal motions at the last strobe; NaN if the integration ended early."""
    integrator = _taylor(tolerance)
    integrator.set_time(0.0)
    integrator.state[:], integrator.pars[:] = 0.0, np.array(_constants(region))[:, None]
    integrator.propagate_until(region.strobes * region.period)
    arrived = all(result[0].name == "time_limit" for result in integrator.propagate_res)
    return integrator.state[:, 0].copy() if arrived else np.full(2, np.nan)


def in_extended_precision(region: Region) -> np.ndarray:
    """State at the last strobe in extended precision, rounded to double at the end."""
    integrator = _extended()
    integrator.time = np.longdouble(0.0)
    integrator.state[:], integrator.pars[:] = 0.0, _constants(region)
    integrator.propagate_until(np.longdouble(region.strobes * region.period))
    return integrator.state.astype(float)


@cache
def reference(name: str) -> tuple[np.ndarray, float]:
    """State at the last strobe and the size of the motion."""
    region = REGIONS[name]
    exact = in_extended_precision(region) if find_spec("heyoka") else by_scipy(region, "DOP853", 3e-14)
    return exact, max(float(np.abs(exact).max()), region.shaft.acceleration / _OMEGA**2)


def apart(name: str) -> float:
    """The difference of the two references at the end of ``beginning``, relative to the size of the motion."""
    region, (_, size) = REGIONS[name].beginning, reference(name)
    return float(np.max(np.abs(by_scipy(region, "DOP853", 3e-14) - in_extended_precision(region)))) / size


def error_of(name: str, state: np.ndarray) -> Judged:
    """The error of a state (phi, phi'/Omega)."""
    exact, size = reference(name)
    error = float(np.max(np.abs(state - exact))) / size
    return Judged(error) if math.isfinite(error) else Judged(math.nan, 1, "nan")


def package(name: str, analysis: str, method: str, setting: str, options: Mapping[str, Any], lanes: int) -> Contender:
    """A method of the package on a scene of equal motions; the last strobe is compared."""
    region = REGIONS[name]
    section = analysis == "poincare"
    # A section has at least ``_LEAST`` strobes.
    first = max(region.strobes - _LEAST, 0)
    marched = first + _LEAST if section else region.strobes
    own = (
        {"strobes": _LEAST, "discard": first}
        if section
        else {"times": [region.strobes / region.parameters["excitation_frequency"]]}
    )
    outputs = ["section", "strobe_error"] if section else ["phi", "velocity", "phi_error", "velocity_error"]
    scene = columns_scene(
        "tripod", analysis, outputs, {key: np.full(lanes, value) for key, value in region.parameters.items()},
        fixed={"element": "input", "beta": NINE_DEGREES, "equation": "29"},
        options={"method": method, **own, **options},
    )  # fmt: skip

    def judged(found: Mapping[str, np.ndarray]) -> Judged:
        if section:
            state = found["section"][0, region.strobes - first - 1]
        else:
            state = np.array([found["phi"][0, -1], found["velocity"][0, -1]])
        plain = error_of(name, state / (1.0, _OMEGA))
        return Judged(plain.error, plain.failed, told(found["outcome"][:1]) or plain.noticed)

    label = {"fixed": "package, fixed steps", "adaptive": "package, adaptive 5(4)", "diffrax": "package, history"}[
        method
    ]
    return Contender("tripod", name, label, setting, lanes * marched, partial(engine_job, scene), judged)


def scipy(name: str, method: str, rtol: float) -> Contender:
    """One motion by SciPy."""
    region = REGIONS[name]
    job, judged = partial(by_scipy, region, method, rtol), partial(error_of, name)
    return Contender("tripod", name, f"scipy {method}", f"rtol={rtol:g}", region.strobes, lambda: job, judged)


def heyoka(name: str, tolerance: float) -> Contender:
    """A batch of equal motions by heyoka.py."""
    region = REGIONS[name]

    def prepare() -> Callable[[], np.ndarray]:
        _taylor(tolerance)
        return partial(by_heyoka, region, tolerance)

    points, judged = _BATCH * region.strobes, partial(error_of, name)
    return Contender("tripod", name, "heyoka.py", f"tol={tolerance:g}", points, prepare, judged)


def contenders_of(name: str, quick: bool) -> list[Contender]:
    """All methods in one region."""
    found = []
    # Up to what slow excitation (128) and chaos (384) need for nine digits.
    for steps in (12,) if quick else (6, 8, 12, 18, 24, 40, 128, 384):
        found.append(package(name, "poincare", "fixed", f"{steps} steps a strobe", {"steps": steps}, _LANES))
    # The path by diffrax compiles longest.
    for rtol in () if quick else (1e-3, 1e-9):
        options = {"rtol": rtol, "atol": 1e-3 * rtol}
        found.append(package(name, "poincare", "adaptive", f"rtol={rtol:g}", options, 4))
    for rtol in (1e-8,) if quick else (1e-6, 1e-10):
        found.append(package(name, "history", "diffrax", f"rtol={rtol:g}", {"rtol": rtol}, 4))
    ladder = {"DOP853": (1e-6, 1e-9, 1e-12), "RK45": (1e-6,), "LSODA": (1e-6, 1e-9)}
    for method, tolerances in ladder.items():
        # A quick run keeps the finest setting, because without it a rival would seem not to reach 1e-9.
        for rtol in tolerances[-1:] if quick else tolerances:
            found.append(scipy(name, method, rtol))
    if find_spec("heyoka"):
        for tolerance in (1e-12,) if quick else (1e-6, 1e-9, 1e-10, 1e-11, 1e-12, 1e-15):
            found.append(heyoka(name, tolerance))
    return found


def contenders(quick: bool) -> tuple[Sequence[Contender], Sequence[str]]:
    """All methods in all regions, and the difference of the two references."""
    names = ("typical", "near a tongue") if quick else tuple(REGIONS)
    if not find_spec("heyoka"):
        return [c for name in names for c in contenders_of(name, quick)], ["the reference is SciPy DOP853 at 3e-14"]
    notes = [f"{name}: SciPy DOP853 at 3e-14 differs from the reference by {apart(name):.0e} after "
             f"{REGIONS[name].beginning.strobes} strobes" for name in names]  # fmt: skip
    return [contender for name in names for contender in contenders_of(name, quick)], ["; ".join(notes)]


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure."""
    study("precision_tripod", __doc__, contenders, argv)


if __name__ == "__main__":
    main()
