"""Double-tripod driveshaft: the torsion of its input or output element under motor or mill torque.

Source: M. Bugaru, O. Vasile, "A new robust method to investigate dynamic instability of forced torsional vibrations for
the double tripod industrial driveshafts in the principal parametric resonance region", Applied Sciences 12(12), 6182,
2022. Equation numbers in parentheses are the paper's; docs/theory/tripod.md lists what its text had lost.

All functions broadcast over parameters of any common shape. SI units, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax.systems._base import FloquetModel, LinearPeriodic, Model, Rows, System, Values
from drivetrain_jax.systems._flow import Components, Flow
from drivetrain_jax.systems._tripod_parameters import (
    EQUATIONS,
    MOTION,
    PARAMETERS,
    SHAPE,
    STATED_CHI,
    check_chi,
    check_motion,
    check_parametric,
    geometry,
)
from drivetrain_jax.systems.trigonometry import cos, sin


class Element(NamedTuple):
    """Constants of one element: what its equation of motion is made of."""

    J_A: Any
    """Moment of area of the axle, reduced to the midshaft axis [m4]."""
    J_B: Any
    """Mean moment of area of the bell [m4]."""
    mean_inertia: Any
    """Ibar [kg m2]: the inertia is Ibar (1 + chi_n cos 2 phi)."""
    chi_n: Any
    """Nonuniformity of the inertia [1]."""
    c_stiffness: Any
    """c1 or c3 [1]: nonuniformity of the bell, the numerator of g."""
    c_inertia: Any
    """c2 or c4 [1]: nonuniformity of the compliance, in the denominator of g."""
    stiffness: Any
    """Torsional stiffness k_t = Omega^2 Ibar at the mean moments of area [N m/rad]."""
    frequency: Any
    """Natural angular frequency Omega [rad/s]."""


def element_of(values: Values) -> Element:
    """Constants of an element from its geometry, the paper's (1), (22), (23) and appendices A, B.

    J_A = (pi d_A^4/64)(1 + cos^2 beta) + (pi d_A^2/4)(L_B + L_A/2)^2, J_B = J_m (1 + cos^2 beta) + S_B d_C^2;
    Ibar = rho (J_B L_B + J_A L_A), a = rho J_A L_A, r = (L_A/L_B)^2, D = 1 + r (Ibar/a - 1);
    Omega^2 = (G/rho)/L_B^2 (1 - a/Ibar)/D, c1 = chi_n/(1 - a/Ibar), c2 = r (Ibar/a) chi_n/D.
    """
    size = geometry(values)
    cos2 = jnp.cos(values["beta"]) ** 2
    area = math.pi * size["d_A"] ** 2 / 4
    j_a = area * size["d_A"] ** 2 / 16 * (1 + cos2) + area * (size["L_B"] + size["L_A"] / 2) ** 2
    j_b = size["J_m"] * (1 + cos2) + size["S_B"] * size["d_C"] ** 2
    axle, bell = values["rho"] * j_a * size["L_A"], values["rho"] * j_b * size["L_B"]
    inertia = axle + bell
    ratio = (size["L_A"] / size["L_B"]) ** 2
    compliance = 1 + ratio * bell / axle
    frequency = jnp.sqrt(values["G"] / values["rho"] * bell / inertia / compliance) / size["L_B"]
    chi = _nonuniformity(values, size, inertia)
    return Element(
        j_a,
        j_b,
        inertia,
        chi,
        chi * inertia / bell,
        ratio * inertia / axle * chi / compliance,
        frequency**2 * inertia,
        frequency,
    )


def _nonuniformity(values: Values, size: Mapping[str, Any], inertia: Any) -> Any:
    """chi_n: as given, or J_m chi_B rho L_B sin^2(beta)/Ibar; the paper's appendix B omits chi_B."""
    if "chi_n" in values:
        return values["chi_n"]
    if values["chi_source"] == "printed_value":
        return jnp.asarray(STATED_CHI[values["element"]])
    printed = size["J_m"] * values["rho"] * size["L_B"] * jnp.sin(values["beta"]) ** 2 / inertia
    return printed * size["chi_B"] if values["chi_source"] == "derived" else printed


def joint_amplitude(values: Values) -> Array:
    """A_TJ = R/(2 L_DM2) tan(beta) tan^2(beta/2) [rad], (13)-(14): amplitude of the joint's kinematic error."""
    beta = values["beta"]
    return geometry(values)["R"] / (2 * values["L_DM2"]) * jnp.tan(beta) * jnp.tan(beta / 2) ** 2


def midshaft_frequency(values: Values) -> Array:
    """nu_1 = sqrt(G/rho)/(2 L_DM2) [Hz], (24): the fundamental; the others are its multiples."""
    return jnp.sqrt(values["G"] / values["rho"]) / (2 * values["L_DM2"])


def excitation_frequency(values: Values, element: Element) -> Any:
    """The excitation frequency [Hz]: as given, or the principal parametric resonance eta = 2 Omega, (27)-(28)."""
    return values.get("excitation_frequency", element.frequency / math.pi)


def stiffness_ratio(element: Element, cosine: Any) -> Any:
    """g = (1 + c1 x)/[(1 + c2 x)(1 + chi_n x)] with x = ``cosine``: k_t/I over its mean Omega^2."""
    x = cosine
    return (1 + element.c_stiffness * x) / ((1 + element.c_inertia * x) * (1 + element.chi_n * x))


def _octaves(cosine: Any, count: int) -> list[Any]:
    """cos(x), cos(2 x), cos(4 x), ... from cos(x); the weights 2^-i of the sums outweigh the growth of rounding."""
    terms = [cosine]
    for _ in range(count - 1):
        terms.append(2 * terms[-1] ** 2 - 1)
    return terms


def motor_ripple(angle: Any, reading: str) -> Any:
    """Sum of (6), angle = Omega_AEM t: cos(2^i angle)/2^(i+1), i = 0..5, or ("harmonic") cos(2 i angle)/(2 i + 1)."""
    if reading == "octave":
        return sum(c / 2 ** (i + 1) for i, c in enumerate(_octaves(cos(angle), 6)))
    return 1.0 + sum(cos(2 * i * angle) / (2 * i + 1) for i in range(1, 6))


def mill_ripple(phi: Any, reading: str) -> Any:
    """Sum of (9): cos(2^(j-1) phi)/2^j, j = 1..7, or ("harmonic") cos((2 j - 1) phi)/(2 j)."""
    if reading == "octave":
        return sum(c / 2 ** (j + 1) for j, c in enumerate(_octaves(cos(phi), 7)))
    return sum(cos((2 * j - 1) * phi) / (2 * j) for j in range(1, 8))


def flow_model(values: Values) -> Flow:
    """(25), (26), (29) or (30) as a flow of ``y = (phi, phi'/Omega)``, time in seconds.

    phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = (M/Ibar)(1 + ripple)(1 - 3 A_TJ sin 3 phi)/(1 + chi_n cos 2 phi)
    with g at 2 phi, (25)-(26), or at Theta = 2 pi f t, (29)-(30). The clocks are Theta and, for the input element, the
    motor's. If no equation is given it is (29) or (30).
    """
    name = values["element"]
    equation = values.get("equation", EQUATIONS[name][1])
    element, reading = element_of(values), values["torque_reading"]
    omega, frequency = element.frequency, excitation_frequency(values, element)
    joint = 3 * joint_amplitude(values)
    mean = (values["M_AEM"] if name == "input" else -values["M_MS"]) / (element.mean_inertia * omega)

    def torque(angles: Components, phi: Any) -> Any:
        if name == "input":
            return 1 + values["chi_AEM"] * motor_ripple(angles[1], reading)
        return 1 + values["chi_MS"] * mill_ripple(phi, reading)

    def ratio(angles: Components, cos_2phi: Any) -> Any:
        return stiffness_ratio(element, cos_2phi if equation in ("25", "26") else cos(angles[0]))

    def field(angles: Components, y: Components) -> Components:
        phi, rate = y[0], y[1]
        sine = sin(phi)
        cos_2phi, sin_3phi = 1 - 2 * sine**2, sine * (3 - 4 * sine**2)
        g = ratio(angles, cos_2phi)
        drive = mean * torque(angles, phi) * (1 - joint * sin_3phi) / (1 + element.chi_n * cos_2phi)
        return omega * rate, drive - omega * (2 * values["zeta"] * jnp.sqrt(g) * rate + g * phi)

    def divergence(angles: Components, y: Components) -> Any:
        return -2 * values["zeta"] * omega * jnp.sqrt(ratio(angles, 1 - 2 * sin(y[0]) ** 2))

    return Flow(
        field,
        start=(values["phi0"], values["velocity0"] / omega),
        period=1 / frequency,
        turns=(1, 50 * values["motor_order"] / frequency) if name == "input" else (1,),
        scale=(1.0, omega),
        divergence=divergence,
        fastest=omega,
    )


def history_model(values: Values) -> Flow:
    """Like :func:`flow_model`, but (25) or (26) if no equation is given."""
    return flow_model({"equation": EQUATIONS[values["element"]][0], **values})


def constants(values: Values) -> dict[str, Any]:
    """What the analysis ``parameters`` reports, by the name of the result."""
    element = element_of(values)
    mean = values["M_AEM"] if values["element"] == "input" else -values["M_MS"]
    return {
        "natural_angular_frequency": element.frequency,
        "resonance_frequency": element.frequency / math.pi,
        "mean_inertia": element.mean_inertia,
        "chi_n": element.chi_n,
        "c_stiffness": element.c_stiffness,
        "c_inertia": element.c_inertia,
        "parametric_excitation": element.c_stiffness - element.c_inertia - element.chi_n,
        "torsional_stiffness": element.stiffness,
        "axle_area_moment": element.J_A,
        "bell_area_moment": element.J_B,
        "joint_amplitude": joint_amplitude(values),
        "torque_acceleration": mean / element.mean_inertia,
        "midshaft_frequency": midshaft_frequency(values),
    }


def floquet_model(values: Values) -> FloquetModel:
    """The linear parametric part of (29), (30): phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = 0, g at Theta.

    State ``(phi, phi'/Omega)``; clock of the reduced form: Theta in [0, 2 pi].
    """
    element = element_of(values)
    omega, frequency = element.frequency, excitation_frequency(values, element)

    def rows(cosine: Any, speed: Any) -> Rows:
        g = stiffness_ratio(element, cosine)
        return (0, speed), (-speed * g, -2 * values["zeta"] * speed * jnp.sqrt(g))

    def determinant() -> Array:
        return log_determinant(values)

    natural = LinearPeriodic(
        lambda t: rows(jnp.cos(2 * math.pi * frequency * t), omega), 1 / frequency, log_determinant=determinant
    )
    reduced = LinearPeriodic(
        lambda cosine: rows(cosine, omega / (2 * math.pi * frequency)),
        2 * math.pi,
        basis=lambda theta: (jnp.cos(theta),),
        log_determinant=determinant,
    )
    return FloquetModel(natural, reduced)


def parametric_tongue(values: Values) -> tuple[Callable[[Any, Any], LinearPeriodic], float, float, float]:
    """The arguments of :func:`~drivetrain_jax.analysis.periodic.tongue_tip.tongue_tip` for the principal resonance.

    The parametric part as a function of chi_n and the excitation frequency [Hz], and where to look for its tip: the
    estimate 4 zeta chi_n/(c1 - c2 - chi_n) of perturbation theory (the coefficients are multiples of chi_n), Omega/pi
    and the damping ratio. A chi_n or excitation frequency in ``values`` is not used.
    """
    unit = element_of({**values, "chi_n": 1.0})
    estimate = 4 * values["zeta"] / (unit.c_stiffness - unit.c_inertia - 1)

    def form(chi_n: Any, frequency: Any) -> LinearPeriodic:
        return floquet_model({**values, "chi_n": chi_n, "excitation_frequency": frequency}).reduced

    return form, float(estimate), float(unit.frequency) / math.pi, float(values["zeta"])


# Equally spaced angles: the rule converges like the distance of the nearest zero or pole of g from the real axis,
# to rounding for coefficients up to 0.99.
_NODES = 256


def log_determinant(values: Values) -> Array:
    """Exact ``log det Z`` over one period (Liouville): -2 zeta Omega T <sqrt g>, the mean over Theta."""
    element = element_of(values)
    decay = 2 * values["zeta"] * element.frequency / excitation_frequency(values, element)
    # g is even: the nodes 2 pi k/_NODES from 0 to pi, the ends with weight 1/2.
    cosines = [math.cos(2 * math.pi * k / _NODES) for k in range(_NODES // 2 + 1)]
    weights = [1 / _NODES if k in (0, _NODES // 2) else 2 / _NODES for k in range(_NODES // 2 + 1)]
    shape = (-1, *(1,) * jnp.ndim(decay + element.chi_n))
    g = stiffness_ratio(element, jnp.asarray(cosines).reshape(shape))
    return -decay * jnp.sum(jnp.asarray(weights).reshape(shape) * jnp.sqrt(g), axis=0)


def _motion(build: Callable[[Values], Flow]) -> Model:
    return Model(build, MOTION, check_motion)


SYSTEM = System(
    name="tripod",
    title="Double-tripod driveshaft",
    source="Bugaru & Vasile, Applied Sciences 12(12), 6182, 2022; corrections in docs/theory/tripod.md",
    parameters=PARAMETERS,
    models={
        "parameters": Model(constants, (*SHAPE, "L_DM2", "M_AEM", "M_MS"), check_chi),
        "history": _motion(history_model),
        "floquet": Model(
            floquet_model,
            (*SHAPE, "zeta", "equation", "excitation_frequency"),
            check_parametric,
        ),
        "lyapunov": _motion(flow_model),
        "poincare": _motion(flow_model),
    },
    time_units="s",
    roles={"speed": "excitation_frequency", "angle": "beta", "damping": "zeta"},
)
