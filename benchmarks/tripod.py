"""Contenders on the double tripod: its state after many strobes.

Equation (29) of the input element, from rest over 1,000 strobes (stiff and slow excitation 128, the chaotic control
40). Times are per strobe of one motion, on one core. The error is that of (phi, phi'/Omega) at the last strobe relative
to the size of the motion, against a Taylor integration by heyoka.py at 1e-19 in extended precision (SciPy's DOP853 at
3e-14 if heyoka.py is not installed). "fixed steps" is the package's ``poincare``, 64 motions at a time. "adaptive 5(4)"
is its pair for demonstrations of loose tolerances. "history" is its diffrax path, whose rtol applies to the motion.
SciPy integrates one motion, heyoka.py a batch of 8 equal ones, in the dimensionless time Omega t. Regions: damping 0.05
(easy); the paper's damping (typical); 1 % below the tip of the principal tongue (chi_n 0.01736); overdamped, zeta = 30;
damping 1e-12; excitation at 200 Hz, 15 natural periods a strobe; the chaotic control of docs/validation/tripod.md.
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

from benchmarks.measure import Job, Judged, Method, Study, judged, outcomes, points_job
from tests.oracles.tripod_reference import NINE_DEGREES, Shaft, shaft

HEYOKA = find_spec("heyoka") is not None
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
        """Angular frequency of the motor over Omega."""
        return 100 * math.pi * self.parameters["motor_order"] / _OMEGA

    @property
    def period(self) -> float:
        """The period of a strobe in the time Omega t."""
        return _OMEGA / self.parameters["excitation_frequency"]

    @property
    def beginning(self) -> Region:
        """The same region over fewer strobes, for a second reference in seconds instead of a minute."""
        return replace(self, strobes=max(self.strobes // 8, 40))


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
_LANES, _FEW, _LEAST = 64, 4, 128
# Batch size of heyoka.py: as many numbers as an AVX-512 vector holds; 4 and 16 are slower.
_BATCH = 8


def equations(phi: Any, rate: Any, time: Any, constants: Sequence[Any], functions: Any) -> tuple[Any, Any]:
    """(29) in the time Omega t, state (phi, phi'/Omega), for Python floats or heyoka's variables."""
    cos, sin, sqrt = functions.cos, functions.sin, functions.sqrt
    zeta, chi, c1, c2, mean, ripple, joint, turn, motor = constants
    c = cos(turn * time)
    g = (1.0 + c1 * c) / ((1.0 + c2 * c) * (1.0 + chi * c))
    a, waves, weight = cos(motor * time), 0.0, 0.5
    for _ in range(6):
        waves = waves + weight * a
        a, weight = 2.0 * a * a - 1.0, weight / 2
    torque = mean * (1.0 + ripple * waves) * (1.0 - 3.0 * joint * sin(3.0 * phi)) / (1.0 + chi * cos(2.0 * phi))
    return rate, torque - 2.0 * zeta * sqrt(g) * rate - g * phi


def _constants(region: Region) -> list[float]:
    s = region.shaft
    return [region.parameters["zeta"], s.chi_n, s.c1, s.c2, s.acceleration / s.omega**2, s.ripple, s.joint,
            2 * math.pi / region.period, region.motor]  # fmt: skip


def by_scipy(region: Region, method: str, rtol: float) -> np.ndarray:
    """State at the last strobe; NaN if SciPy gave up."""
    constants, end = _constants(region), region.strobes * region.period
    motion = solve_ivp(
        lambda x, y: equations(*y.tolist(), x, constants, math), (0, end), (0.0, 0.0), method,
        rtol=rtol, atol=0.1 * rtol * constants[4], t_eval=(end,),
    )  # fmt: skip
    return motion.y[:, -1] if motion.success else np.full(2, np.nan)


@cache
def _taylor(tolerance: float, extended: bool = False) -> Any:
    """heyoka.py's integrator of a batch, or of one motion in the 80-bit numbers of x86 processors."""
    import heyoka as hy

    phi, rate = hy.make_vars("phi", "rate")
    slopes = equations(phi, rate, hy.time, [hy.par[i] for i in range(9)], hy)
    system = list(zip((phi, rate), slopes, strict=True))
    if extended:
        zeros = np.zeros(11, np.longdouble)
        return hy.taylor_adaptive(
            system, zeros[:2], tol=np.longdouble(tolerance), pars=zeros[2:], fp_type=np.longdouble
        )
    return hy.taylor_adaptive_batch(
        system, np.zeros((2, _BATCH)), tol=tolerance, pars=np.zeros((9, _BATCH)), force_avx512=True
    )


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
    integrator = _taylor(1e-19, True)
    integrator.time = np.longdouble(0.0)
    integrator.state[:], integrator.pars[:] = 0.0, _constants(region)
    integrator.propagate_until(np.longdouble(region.strobes * region.period))
    return integrator.state.astype(float)


@cache
def reference(name: str) -> tuple[np.ndarray, float]:
    """State at the last strobe and the size of the motion."""
    region = REGIONS[name]
    exact = in_extended_precision(region) if HEYOKA else by_scipy(region, "DOP853", 3e-14)
    return exact, max(float(np.abs(exact).max()), region.shaft.acceleration / _OMEGA**2)


def error_of(name: str, setting: Any, state: np.ndarray, notice: str = "") -> Judged:
    """The error of a state (phi, phi'/Omega)."""
    exact, size = reference(name)
    return judged(np.max(np.abs(state - exact)) / size, notice)


def _first(region: Region) -> int:
    """Strobes before the section, which has at least ``_LEAST``."""
    return max(region.strobes - _LEAST, 0)


def _columns(region: Region, lanes: int) -> dict[str, np.ndarray]:
    return {name: np.full(lanes, value) for name, value in region.parameters.items()}


_FIXED = {"element": "input", "beta": NINE_DEGREES, "equation": "29"}


def section(method: str, lanes: int, name: str, setting: Any) -> Job:
    """The analysis ``poincare`` on equal motions; ``setting``: steps of a strobe, or rtol."""
    accuracy = {"steps": setting} if method == "fixed" else {"rtol": setting, "atol": 1e-3 * setting}
    options = {"method": method, "strobes": _LEAST, "discard": _first(REGIONS[name]), **accuracy}
    columns = _columns(REGIONS[name], lanes)
    return points_job("tripod", "poincare", ["section", "strobe_error"], columns, fixed=_FIXED, options=options)


def _section_error(name: str, setting: Any, result: Any) -> Judged:
    state = result["section"][0, REGIONS[name].strobes - _first(REGIONS[name]) - 1]
    return error_of(name, setting, state / (1.0, _OMEGA), outcomes(result["outcome"][:1]))


def history(name: str, rtol: float) -> Job:
    """The analysis ``history`` by diffrax on equal motions."""
    region, outputs = REGIONS[name], ["phi", "velocity", "phi_error", "velocity_error"]
    options = {"method": "diffrax", "rtol": rtol, "times": [region.strobes / region.parameters["excitation_frequency"]]}
    return points_job("tripod", "history", outputs, _columns(region, _FEW), fixed=_FIXED, options=options)


def _history_error(name: str, setting: Any, result: Any) -> Judged:
    state = np.array([result["phi"][0, -1], result["velocity"][0, -1]])
    return error_of(name, setting, state / (1.0, _OMEGA), outcomes(result["outcome"][:1]))


def _scipy(method: str) -> Callable[[str, float], Job]:
    return lambda name, rtol: partial(by_scipy, REGIONS[name], method, rtol)


def _heyoka(name: str, tolerance: float) -> Job:
    _taylor(tolerance)
    return partial(by_heyoka, REGIONS[name], tolerance)


def _two_references(names: Sequence[str]) -> list[str]:
    if not HEYOKA:
        return ["the reference is SciPy DOP853 at 3e-14"]
    texts = []
    for name in names:
        region = REGIONS[name].beginning
        apart = np.max(np.abs(by_scipy(region, "DOP853", 3e-14) - in_extended_precision(region))) / reference(name)[1]
        texts.append(
            f"{name}: SciPy DOP853 at 3e-14 differs from the reference by {apart:.0e} after {region.strobes} strobes"
        )
    return ["; ".join(texts)]


def _strobes(name: str) -> int:
    return REGIONS[name].strobes


def _marched(lanes: int) -> Callable[[str], int]:
    return lambda name: lanes * (_first(REGIONS[name]) + _LEAST)


STUDY = Study(
    "tripod", tuple(REGIONS), ("typical", "near a tongue"),
    (
        # Up to what slow excitation (128) and chaos (384) need for nine digits.
        Method("package, fixed steps", partial(section, "fixed", _LANES), _marched(_LANES), (6, 8, 12, 18, 24, 40, 128, 384),
               (12,), "{} steps a strobe", _section_error),
        Method("package, adaptive 5(4)", partial(section, "adaptive", _FEW), _marched(_FEW), (1e-3, 1e-9),
               error=_section_error),
        Method("package, history", history, lambda name: _FEW * _strobes(name), (1e-6, 1e-10), (1e-8,),
               error=_history_error),
        # A quick run keeps the finest setting, because without it a rival would seem not to reach 1e-9.
        Method("scipy DOP853", _scipy("DOP853"), _strobes, (1e-6, 1e-9, 1e-12), (1e-12,)),
        Method("scipy RK45", _scipy("RK45"), _strobes, (1e-6,), (1e-6,)),
        Method("scipy LSODA", _scipy("LSODA"), _strobes, (1e-6, 1e-9), (1e-9,)),
        *([Method("heyoka.py", _heyoka, lambda name: _BATCH * _strobes(name), (1e-6, 1e-9, 1e-10, 1e-11, 1e-12, 1e-15),
                  (1e-12,), "tol={:g}")] if HEYOKA else []),
    ),
    error_of, _two_references,
)  # fmt: skip
