"""Constants of one element of the double-tripod driveshaft, in closed form: the model of the analysis ``parameters``.

Equation numbers are those of the source of :mod:`~drivetrain_jax.systems.tripod`. All functions broadcast over parameters
of any common shape. SI units, angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from drivetrain_jax._quantities import Variable
from drivetrain_jax.systems._base import Values
from drivetrain_jax.systems._tripod_parameters import STATED_CHI, geometry


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


def constants(values: Values) -> dict[str, Any]:
    """The values of ``RESULTS`` by name; the value of ``midshaft_frequency`` is a function of the number of the mode."""
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
