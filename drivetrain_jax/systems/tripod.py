"""Double-tripod driveshaft: the torsion of its input or output element under motor or mill torque.

Source: M. Bugaru, O. Vasile, "A new robust method to investigate dynamic instability of forced torsional vibrations for
the double tripod industrial driveshafts in the principal parametric resonance region", Applied Sciences 12(12), 6182,
2022. Equation numbers in parentheses are the paper's; docs/theory/tripod.md lists what its text had lost.

All functions broadcast over parameters of any common shape. SI units, angles in rad.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Component
from drivetrain_jax.systems._base import Number, System, Values, parameter, serves
from drivetrain_jax.systems._flow import Components, Flow
from drivetrain_jax.systems._periodic import FloquetModel, LinearPeriodic
from drivetrain_jax.systems._rows import Rows
from drivetrain_jax.systems._tripod_element import (
    RESULTS,
    SHOWN,
    Element,
    constants,
    element_of,
    excitation_frequency,
    joint_amplitude,
    stiffness_ratio,
)
from drivetrain_jax.systems._tripod_parameters import (
    CHI_SOURCES,
    EQUATIONS,
    GEOMETRY,
    MOTION,
    READINGS,
    SHAPE,
    check_chi,
    check_motion,
    check_parametric,
    of_element,
    positive,
)
from drivetrain_jax.systems.trigonometry import cos, sin


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


def flow_model(values: Values) -> Flow:
    """(25), (26), (29) or (30) as a flow of ``y = (phi, phi'/Omega)``, time in seconds.

    phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = (M/Ibar)(1 + ripple)(1 - 3 A_TJ sin 3 phi)/(1 + chi_n cos 2 phi)
    with g at 2 phi, (25)-(26), or at Theta = 2 pi f t, (29)-(30). The clocks are Theta and, for the input element, the
    angle of the motor. The default equation is (29) or (30).
    """
    name = values["element"]
    equation = values.get("equation", EQUATIONS[name][1])
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


def history_model(values: Values) -> Flow:
    """Like :func:`flow_model`, with (25) or (26) as default equation."""
    return flow_model({"equation": EQUATIONS[values["element"]][0], **values})


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


def floquet_model(values: Values) -> FloquetModel:
    """The linear parametric part of (29), (30): phi'' + 2 zeta Omega sqrt(g) phi' + Omega^2 g phi = 0, g at Theta.

    State ``(phi, phi'/Omega)``; clock of the reduced form: Theta in [0, 2 pi].
    """
    element = element_of(values)
    omega, frequency = element.frequency, excitation_frequency(values, element)

    natural = _Parametric(element, values["zeta"], omega, frequency)
    reduced = _Parametric(element, values["zeta"], omega / (2 * math.pi * frequency), frequency)
    return FloquetModel(
        LinearPeriodic(natural.rows_in_time, 1 / frequency, log_determinant=natural.log_determinant),
        LinearPeriodic(reduced.rows, 2 * math.pi, _cosine, log_determinant=reduced.log_determinant),
    )


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
        "1",
        "nonuniformity",
        symbol="χ",
        derived="chi_source",
        lower=-1.0,
        upper=1.0,
        open_lower=True,
        open_upper=True,
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
        """See :func:`constants`."""
        return constants(self.values)

    @serves("history", parameters=MOTION, check=check_motion)
    def history_model(self) -> Flow:
        """The flow of (25) or (26), unless another equation is given."""
        return history_model(self.values)

    @serves("floquet", parameters=(*SHAPE, "zeta", "equation", "excitation_frequency"), check=check_parametric)
    def floquet_model(self) -> FloquetModel:
        """The linear parametric part of (29) or (30)."""
        return floquet_model(self.values)

    @serves("lyapunov", "poincare", parameters=MOTION, check=check_motion)
    def flow_model(self) -> Flow:
        """The flow of (29) or (30), unless another equation is given."""
        return flow_model(self.values)

    def vector_field(self, t: Any, y: Array) -> Array:
        """``(phi', phi'')`` of ``y = (phi, phi')`` [rad, rad/s] at the time ``t`` [s]; (25) or (26) by default."""
        flow = self.history_model()
        turned = t / flow.period
        scale = jnp.stack([jnp.asarray(s, float) for s in flow.scale or ()])
        return scale * flow.vector(0, turned, y / scale)
