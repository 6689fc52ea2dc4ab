"""Double-tripod driveshaft: the torsion of its input or output element under motor or mill torque.

Source: M. Bugaru, O. Vasile, "A new robust method to investigate dynamic instability of forced torsional vibrations for
the double tripod industrial driveshafts in the principal parametric resonance region", Applied Sciences 12(12), 6182,
2022. Equation numbers in parentheses are the paper's; docs/theory/tripod.md lists what its text had lost.

All functions broadcast over parameters of any common shape. SI units, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Component, Parameter, Variable
from drivetrain_jax.systems._base import POSITIVE, Conversion, Number, PhysicalData, System, Values, parameter, serves
from drivetrain_jax.systems._models import Components, FloquetModel, Flow, LinearPeriodic, Rows, cos, sin

# Default parameters from tables 1, 2 and 4 of the paper, and conflicts between them.


# Tables 1 and 2: the values that differ between the elements.
_DIMENSIONS = ("L_B", "L_A", "R", "d_A", "d_C", "S_B", "J_m", "chi_B")
_OF_ELEMENT = {
    "input": (0.190, 0.130, 0.070, 0.054, 0.098, 0.0076, 1.4645e-5, 0.22),
    "output": (0.209, 0.143, 0.077, 0.059, 0.108, 0.0092, 2.1442e-5, 0.24),
}
GEOMETRY: Mapping[str, Mapping[str, float]] = {
    element: dict(zip(_DIMENSIONS, row, strict=True)) for element, row in _OF_ELEMENT.items()
}
# Values of chi_n that the paper states and uses at beta = 9 deg; neither its text nor its formulas yield them.
STATED_CHI = {"input": 0.0026, "output": 0.0027}
EQUATIONS = {"input": ("25", "29"), "output": ("26", "30")}
CHI_SOURCES = ("derived", "printed_formula", "printed_value")
READINGS = ("octave", "harmonic")


SHAPE = ("element", "beta", "chi_n", "chi_source", *_DIMENSIONS, "rho", "G")
_TORQUES = ("M_AEM", "M_MS", "chi_AEM", "chi_MS", "motor_order", "torque_reading", "L_DM2")
MOTION = (*SHAPE, "zeta", "equation", "excitation_frequency", *_TORQUES, "phi0", "velocity0")


def of_element(name: str, units: str, long_name: str, *, positive: bool = True, **limits: Any) -> Any:
    """A parameter whose value in the paper depends on the element."""
    values = ", ".join(f"{geometry[name]:g} for the {element}" for element, geometry in GEOMETRY.items())
    return parameter(units, long_name, derived=values, **{"lower": 0.0, "open_lower": positive, **limits})


def positive(units: str, long_name: str, default: float | None = None, **more: Any) -> Any:
    """A parameter greater than 0."""
    return parameter(units, long_name, default=default, **POSITIVE, **more)


def geometry(values: Values) -> dict[str, Any]:
    """The dimensions of the element: the given values, completed by those of the paper."""
    return {name: values.get(name, paper) for name, paper in GEOMETRY[values["element"]].items()}


def check_motion(fixed: Values) -> None:
    """Raise ``ValueError`` if the element does not have the equation, or if chi_n is given twice."""
    _check_equation(fixed, EQUATIONS[fixed["element"]])
    check_chi(fixed)


def check_parametric(fixed: Values) -> None:
    """Raise ``ValueError`` if the equation is not (29) or (30) as the element has it, or if chi_n is given twice."""
    _check_equation(fixed, EQUATIONS[fixed["element"]][1:])
    check_chi(fixed)


def _check_equation(fixed: Values, allowed: tuple[str, ...]) -> None:
    equation = fixed.get("equation")
    if equation is not None and equation not in allowed:
        raise ValueError(
            f"equation = {equation!r}: expected {' or '.join(allowed)} for this analysis of the "
            f"{fixed['element']} element"
        )


def check_chi(fixed: Values) -> None:
    """Raise ``ValueError`` if chi_n is given although the option asks for the value of the paper."""
    if "chi_n" in fixed and fixed["chi_source"] != "derived":
        raise ValueError(f"chi_n = {fixed['chi_n']:g}: given together with chi_source; expected one of the two")


# Constants of one element in closed form: the model of the analysis ``parameters``.


class Element(NamedTuple):
    """Constants in the equation of motion of one element."""

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
    """nu_1 = sqrt(G/rho)/(2 L_DM2) [Hz], (24): the fundamental frequency, of which the others are multiples."""
    return jnp.sqrt(values["G"] / values["rho"]) / (2 * values["L_DM2"])


def excitation_frequency(values: Values, element: Element) -> Any:
    """The excitation frequency [Hz]: as given, or the principal parametric resonance eta = 2 Omega, (27)-(28)."""
    return values.get("excitation_frequency", element.frequency / math.pi)


def stiffness_ratio(element: Element, cosine: Any) -> Any:
    """g = (1 + c1 x)/[(1 + c2 x)(1 + chi_n x)] with x = ``cosine``: k_t/I over its mean Omega^2."""
    x = cosine
    return (1 + element.c_stiffness * x) / ((1 + element.c_inertia * x) * (1 + element.chi_n * x))


RESULTS = (
    Variable("natural_angular_frequency", "rad/s", "natural angular frequency of the element", lower=0.0),
    Variable("resonance_frequency", "Hz", "excitation frequency of the principal parametric resonance"),
    Variable("mean_inertia", "kg m2", "mean moment of inertia of the element", lower=0.0),
    Variable("chi_n", "1", "nonuniformity of the inertia"),
    Variable("c_stiffness", "1", "nonuniformity of the bell, numerator of g (c1, c3)"),
    Variable("c_inertia", "1", "nonuniformity of the compliance, denominator of g (c2, c4)"),
    Variable("parametric_excitation", "1", "amplitude of the parametric excitation, c1 - c2 - chi_n"),
    Variable(
        "torsional_stiffness", "N m/rad", "torsional stiffness of the element at its mean moment of area", lower=0.0
    ),
    Variable("axle_area_moment", "m4", "moment of area of the axle about the midshaft"),
    Variable("bell_area_moment", "m4", "mean moment of area of the bell about the midshaft"),
    Variable("joint_amplitude", "rad", "amplitude of the kinematic error of the joint (A_TJ)"),
    Variable("torque_acceleration", "rad/s2", "mean torque over mean inertia"),
    Variable("midshaft_frequency", "Hz", "natural frequency of the midshaft in torsion", ("mode",)),
)
SHOWN = (
    "natural_angular_frequency",
    "mean_inertia",
    "chi_n",
    "c_stiffness",
    "c_inertia",
    "torsional_stiffness",
    "midshaft_frequency",
)


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


class _Motion(eqx.Module):
    """The right-hand sides of (25), (26), (29) and (30) for ``y = (phi, phi'/Omega)``."""

    element: Element
    zeta: Any
    joint: Any
    """3 A_TJ."""
    mean: Any
    """Mean torque over Ibar Omega [rad/s]."""
    ripple: Any
    driven: bool = eqx.field(static=True)
    parametric: bool = eqx.field(static=True)
    reading: str = eqx.field(static=True)

    def _torque(self, angles: Components, phi: Any) -> Any:
        angle, sums = (angles[1], motor_ripple) if self.driven else (phi, mill_ripple)
        return 1 + self.ripple * sums(angle, self.reading)

    def _ratio(self, angles: Components, cos_2phi: Any) -> Any:
        return stiffness_ratio(self.element, cos(angles[0]) if self.parametric else cos_2phi)

    def field(self, angles: Components, y: Components) -> Components:
        """``(phi'/Omega, phi''/Omega)`` times Omega."""
        phi, rate = y[0], y[1]
        omega, sine = self.element.frequency, sin(phi)
        cos_2phi, sin_3phi = 1 - 2 * sine**2, sine * (3 - 4 * sine**2)
        g = self._ratio(angles, cos_2phi)
        moved = (1 - self.joint * sin_3phi) / (1 + self.element.chi_n * cos_2phi)
        drive = self.mean * self._torque(angles, phi) * moved
        return omega * rate, drive - omega * (2 * self.zeta * jnp.sqrt(g) * rate + g * phi)

    def divergence(self, angles: Components, y: Components) -> Any:
        """Trace of the Jacobian of :meth:`field`."""
        return -2 * self.zeta * self.element.frequency * jnp.sqrt(self._ratio(angles, 1 - 2 * sin(y[0]) ** 2))


# Number of equally spaced angles of the quadrature. Its rate of convergence is the distance of the nearest zero or pole of g
# from the real axis; for coefficients up to 0.99 the error is rounding.
_NODES = 256


class _Parametric(eqx.Module):
    """phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = 0 with g at Theta, in the time in which Omega is ``speed``."""

    element: Element
    zeta: Any
    speed: Any
    excitation_frequency: Any

    def rows(self, cosine: Any) -> Rows:
        """``A`` of the state ``(phi, phi'/Omega)`` where cos(Theta) is ``cosine``."""
        g = stiffness_ratio(self.element, cosine)
        return (0, self.speed), (-self.speed * g, -2 * self.zeta * self.speed * jnp.sqrt(g))

    def rows_in_time(self, t: Any) -> Rows:
        """``A`` at the time t [s]."""
        return self.rows(jnp.cos(2 * math.pi * self.excitation_frequency * t))

    def log_determinant(self) -> Array:
        """Exact ``log det Z`` over one period (Liouville): -2 zeta Omega T <sqrt g>, the mean over Theta."""
        decay = 2 * self.zeta * self.element.frequency / self.excitation_frequency
        # g is even: use the nodes 2 pi k/_NODES from 0 to pi, the ends with weight 1/2.
        cosines = [math.cos(2 * math.pi * k / _NODES) for k in range(_NODES // 2 + 1)]
        weights = [1 / _NODES if k in (0, _NODES // 2) else 2 / _NODES for k in range(_NODES // 2 + 1)]
        shape = (-1, *(1,) * jnp.ndim(decay + self.element.chi_n))
        g = stiffness_ratio(self.element, jnp.asarray(cosines).reshape(shape))
        return -decay * jnp.sum(jnp.asarray(weights).reshape(shape) * jnp.sqrt(g), axis=0)


def _cosine(theta: Any) -> tuple[Any, ...]:
    return (jnp.cos(theta),)


class Tripod(System):
    """One element of the driveshaft; geometry and torques default to the paper's values for this element.

    >>> import jax.numpy as jnp
    >>> from drivetrain_jax import Tripod
    >>> shaft = Tripod(element="input", beta=0.157, zeta=0.0016)
    >>> print(shaft.vector_field(0.0, jnp.array([0.01, 0.0])).shape)
    (2,)
    """

    name = "tripod"
    title = "Double-tripod driveshaft"
    source = "Bugaru & Vasile, Applied Sciences 12(12), 6182, 2022; corrections in docs/theory/tripod.md"
    time_units = "s"
    physical = PhysicalData(
        (Parameter("speed", "rpm", "speed of the shaft; moments of area repeat twice a turn", **POSITIVE),),
        (Conversion("excitation_frequency", ("speed",), lambda rpm: rpm / 30, "2 speed", lambda f: f * 30),),
    )
    roles = MappingProxyType({"speed": "excitation_frequency", "angle": "beta", "damping": "zeta"})
    state = (
        Component("phi", "rad", "twist"),
        Component("velocity", "rad/s", "rate of twist", r"d$\phi$/d$t$", scale=1e3),
    )

    element: str = parameter("1", "element of the driveshaft", choices=tuple(GEOMETRY))
    beta: Number = parameter("rad", "joint angle", symbol="β", lower=0.0, upper=math.pi / 2, open_upper=True)
    zeta: Number = positive("1", "damping ratio", symbol="ζ")
    equation: str | None = parameter(
        "1",
        "equation of motion",
        choices=("25", "26", "29", "30"),
        derived="25 (input) or 26 (output) for history, otherwise 29 (input) or 30 (output)",
    )
    excitation_frequency: Number | None = positive("Hz", "excitation frequency", derived="Omega/pi")
    chi_n: Number | None = parameter(
        "1", "nonuniformity", symbol="χ", derived="chi_source", lower=-1.0, upper=1.0, open_lower=True, open_upper=True
    )
    chi_source: str = parameter(
        "1", "where chi_n comes from if it is not given", default="derived", choices=CHI_SOURCES
    )
    motor_order: Number = positive("1", "frequency of the motor torque over 50 Hz", 6.0)
    torque_reading: str = parameter("1", "reading of the torque sums", default="octave", choices=READINGS)
    phi0: Number = parameter("rad", "twist at t = 0", default=0.0)
    velocity0: Number = parameter("rad/s", "rate of twist at t = 0", default=0.0)
    L_B: Number | None = of_element("L_B", "m", "length of the bell")
    L_A: Number | None = of_element("L_A", "m", "length of the axle")
    R: Number | None = of_element("R", "m", "radius of the tripod joint")
    d_A: Number | None = of_element("d_A", "m", "diameter of the axle")
    d_C: Number | None = of_element("d_C", "m", "distance of the bell's centre of mass from the tripod", positive=False)
    S_B: Number | None = of_element("S_B", "m2", "cross-section of the bell", positive=False)
    J_m: Number | None = of_element("J_m", "m4", "mean of the bell's principal moments of area")
    chi_B: Number | None = of_element(
        "chi_B", "1", "nonuniformity of the bell's moments of area", positive=False, upper=1.0
    )
    rho: Number = positive("kg/m3", "density", 7850.0, symbol="ρ")
    G: Number = positive("Pa", "shear modulus", 77.3e9)
    L_DM2: Number = positive("m", "length of the midshaft", 0.940)
    M_AEM: Number = parameter("N m", "mean torque of the motor, on the input element", default=2550.0)
    M_MS: Number = parameter("N m", "mean torque of the mill, on the output element", default=2100.0)
    chi_AEM: Number = parameter("1", "nonuniformity of the motor torque", default=0.05)
    chi_MS: Number = parameter("1", "nonuniformity of the mill torque", default=0.15)

    @serves(
        "parameters",
        parameters=(*SHAPE, "L_DM2", "M_AEM", "M_MS"),
        check=check_chi,
        results=RESULTS,
        default_outputs=SHOWN,
    )
    def constants(self) -> dict[str, Any]:
        """The values of ``RESULTS`` by name; the value of ``midshaft_frequency`` is a function of the number of the mode."""
        values = self.values
        element = element_of(values)
        midshaft = midshaft_frequency(values)
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
            "midshaft_frequency": lambda mode: mode * midshaft,
        }

    @serves("history", parameters=MOTION, check=check_motion)
    def history_model(self) -> Flow:
        """The flow of (25) or (26), unless another equation is given."""
        return self._flow(0)

    @serves("floquet", parameters=(*SHAPE, "zeta", "equation", "excitation_frequency"), check=check_parametric)
    def floquet_model(self) -> FloquetModel:
        """The linear parametric part of (29), (30): phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = 0, g at Theta.

        State ``(phi, phi'/Omega)``; clock of the reduced form: Theta in [0, 2 pi].
        """
        values = self.values
        element = element_of(values)
        omega, frequency = element.frequency, excitation_frequency(values, element)

        natural = _Parametric(element, values["zeta"], omega, frequency)
        reduced = _Parametric(element, values["zeta"], omega / (2 * math.pi * frequency), frequency)
        return FloquetModel(
            LinearPeriodic(natural.rows_in_time, 1 / frequency, log_determinant=natural.log_determinant),
            LinearPeriodic(reduced.rows, 2 * math.pi, _cosine, log_determinant=reduced.log_determinant),
        )

    @serves("lyapunov", "poincare", parameters=MOTION, check=check_motion)
    def flow_model(self) -> Flow:
        """The flow of (29) or (30), unless another equation is given."""
        return self._flow(1)

    def _flow(self, default: int) -> Flow:
        """(25), (26), (29) or (30) as a flow of ``y = (phi, phi'/Omega)``, time in seconds.

        phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = (M/Ibar)(1 + ripple)(1 - 3 A_TJ sin 3 phi)/(1 + chi_n cos 2 phi)
        with g at 2 phi, (25)-(26), or at Theta = 2 pi f t, (29)-(30). The clocks are Theta and, for the input element, the
        angle of the motor. The element has two equations, of which number ``default`` is used if none is given.
        """
        values = self.values
        name = values["element"]
        equation = values.get("equation", EQUATIONS[name][default])
        element = element_of(values)
        omega, frequency = element.frequency, excitation_frequency(values, element)
        driven = name == "input"
        motion = _Motion(
            element,
            zeta=values["zeta"],
            joint=3 * joint_amplitude(values),
            mean=(values["M_AEM"] if driven else -values["M_MS"]) / (element.mean_inertia * omega),
            ripple=values["chi_AEM"] if driven else values["chi_MS"],
            driven=driven,
            parametric=equation in ("29", "30"),
            reading=values["torque_reading"],
        )
        return Flow(
            motion.field,
            start=(values["phi0"], values["velocity0"] / omega),
            period=1 / frequency,
            turns=(1, 50 * values["motor_order"] / frequency) if name == "input" else (1,),
            scale=(1.0, omega),
            divergence=motion.divergence,
            fastest=omega,
        )

    def vector_field(self, t: Any, y: Array) -> Array:
        """``(phi', phi'')`` of ``y = (phi, phi')`` [rad, rad/s] at the time ``t`` [s]; (25) or (26) by default."""
        flow = self.history_model()
        turned = t / flow.period
        scale = jnp.stack([jnp.asarray(s, float) for s in flow.scale or ()])
        return scale * flow.vector(0, turned, y / scale)
