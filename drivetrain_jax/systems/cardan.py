"""Cardan (Hooke-joint) shaft: two torsionally flexible shafts joined at the angle beta.

Source: M. Soltan Rezaee, M. R. Ghazavi, "Obtaining stable cardan angles in rotating systems and investigating the
effective parameters on system stability", Modares Mechanical Engineering 14(12), 163-170, 2014. Equation numbers
are those of docs/theory/cardan.md, which lists where the printed equations had to be corrected.

Nondimensional time tau = Omega0 t; Omega = Omega0 sqrt(J1/k1), zeta = c1/(2 sqrt(k1 J1)), alpha = c2/c1,
mu = k2/k1, gamma = J2/J1; the prime is d/dtau. All functions broadcast over parameters of any common shape.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from drivetrain_jax._errors import InputError
from drivetrain_jax._quantities import Component, Dimension, Parameter
from drivetrain_jax.resonances import CARDAN
from drivetrain_jax.systems._base import (
    POSITIVE,
    RPM,
    Conversion,
    Number,
    PhysicalData,
    System,
    numeric,
    parameter,
    serves,
)
from drivetrain_jax.systems._models import SWAP, Components, FloquetModel, Flow, ForcedModel, LinearPeriodic, Rows
from drivetrain_jax.systems._smoothness import Coordinate, Smoothness
from drivetrain_jax.systems._tubes import TUBES, stiffness_of_tubes
from drivetrain_jax.systems.cardan_bounds import ENCLOSURE, balance

# Clock of the reduced equations, and predicted numbers of steps in this clock.


def clock_basis(psi: Any) -> tuple[Array, Array]:
    """``cos 2 psi`` and ``sin 2 psi``, the only functions of the clock psi in the reduced equations."""
    return jnp.cos(2 * psi), jnp.sin(2 * psi)


def clock(cos2psi: Any, sin2psi: Any, beta: Any) -> tuple[Any, Any, Any, Any]:
    """``eta``, ``w = dtau/dpsi``, ``deta/dpsi`` and ``d(ln w)/dpsi`` in the clock psi, eqs (11)-(12).

    Two Landen steps lead from tau to psi. The first, tan(chi) = sqrt(cos beta) tan(tau), distributes the poles of eta near
    pi/2 to 0 and pi/2. The second, tan(2 chi) = kappa tan(2 psi) with kappa^2 = 1 - r^2 and r = tan(beta/2)^2, moves these
    poles away from the axis.
    """
    c, r = jnp.cos(beta), jnp.tan(beta / 2) ** 2
    # 1 - r = 2 c/(1 + c) and 1 -+ r cos(2 chi) are sums of positive terms here, without cancellation near beta = pi/2.
    one_minus_r = 2 * c / (1 + c)
    kappa2 = one_minus_r * (1 + r)
    root = jnp.sqrt(cos2psi**2 + kappa2 * sin2psi**2)
    # root (1 + |cos 2chi|) and root (1 - |cos 2chi|), then root (1 - r cos 2chi) and root (1 + r cos 2chi).
    large = root + jnp.abs(cos2psi)
    small = kappa2 * sin2psi**2 / large
    first_half = cos2psi > 0
    minus = one_minus_r * root + r * jnp.where(first_half, small, large)
    plus = one_minus_r * root + r * jnp.where(first_half, large, small)
    # A single division for eta = minus/plus, w = dtau/dpsi and deta/dpsi.
    inverse = 1 / (minus * plus * root)
    inverse_plus = minus * root * inverse
    eta = minus * inverse_plus
    w = 2 * jnp.sqrt(c * kappa2) / (1 + c) * plus * inverse
    # w is a constant over minus and root, minus = root - r cos 2psi, and 1 - kappa^2 = r^2.
    turn = -2 * r * sin2psi * minus * (minus * plus * inverse) ** 2
    return eta, w, 4 * r * kappa2 * sin2psi * inverse_plus * minus * inverse, turn


def panels_needed(xp: Any, phase: Any, sharpness: Any, decay: Any, digits: float) -> Any:
    """Panels of Gauss collocation over half a period; fitted, see ``Cardan.panels``."""
    x, y, z = xp.log(xp.maximum(phase, 1.0)), sharpness, xp.log(xp.maximum(decay, 1.0))
    # For long oscillations the error is phase (phase/n)^10 in n panels.
    short = xp.minimum(x, 4.0)
    light = 0.78 + 0.315 * short + 0.136 * short**2 + (0.5 - 0.128 * short + 0.022 * digits) * y + 0.2 * digits
    light = light + 1.1 * (x - short)
    heavy = 1.08 + (0.278 + 0.062 * x) * x + 0.413 * y + (0.201 + 0.02 * z - 0.051 * y - 0.062 * x) * z + 0.182 * digits
    faded = xp.maximum(heavy, light - xp.maximum(decay - 6.0, 0.0) / 16)
    return xp.exp(xp.where(decay > 3, faded, light))


# Physical data of a cardan shaft and the parameters of ``cardan``, eq. (7) of docs/theory/cardan.md.


def _alpha(c2: Any, c1: Any) -> Any:
    xp, numbers, c1 = numeric(c2, c1)
    # Without damping of the driving shaft the ratio has no meaning. A traced value cannot be checked.
    if xp is np and np.any((c1 == 0) & (numbers != 0)):
        raise InputError(f"c2 = {numbers.tolist()!r}: expected 0 if c1 = 0 (alpha = c2/c1)")
    return c2 / xp.where(c1 == 0, 1.0, c1)


def _frequency(j1: Any, k1: Any) -> Any:
    xp, j1, k1 = numeric(j1, k1)
    return xp.sqrt(k1 / j1)


def _unit_of_damping(j1: Any, k1: Any) -> Any:
    xp, j1, k1 = numeric(j1, k1)
    # Square roots one by one, because in some units the product overflows.
    return 2 * xp.sqrt(k1) * xp.sqrt(j1)


def _entry(position: int, stiffness: tuple[Any, ...]) -> Any:
    """The stiffness of the driving (0) or of the driven shaft (1)."""
    if len(stiffness) != 2:
        raise InputError(f"length: got {len(stiffness)} shafts; expected two, the driving and the driven one")
    return stiffness[position]


PHYSICAL = PhysicalData(
    (
        Parameter("J1", "kg m2", "inertia of the driving disk", **POSITIVE),
        Parameter("J2", "kg m2", "inertia of the driven disk", **POSITIVE),
        Parameter("k1", "N m/rad", "stiffness of the driving shaft", **POSITIVE),
        Parameter("k2", "N m/rad", "stiffness of the driven shaft", **POSITIVE),
        Parameter("c1", "N m s/rad", "damping of the driving shaft", lower=0.0),
        Parameter("c2", "N m s/rad", "damping of the driven shaft", lower=0.0),
        Parameter("speed", "rpm", "speed of the driving shaft", **POSITIVE),
        Parameter("angle", "deg", "joint angle", lower=-90.0, upper=90.0, open_lower=True, open_upper=True),
        *TUBES,
        Parameter("stiffness", "N m/rad", "stiffnesses of the shafts, driving and driven", listed=True, **POSITIVE),
    ),
    (
        *stiffness_of_tubes("stiffness", replaceable=True),
        Conversion("k1", ("stiffness",), partial(_entry, 0), "stiffness[0]", replaceable=True, whole=("stiffness",)),
        Conversion("k2", ("stiffness",), partial(_entry, 1), "stiffness[1]", replaceable=True, whole=("stiffness",)),
        Conversion("beta", ("angle",), lambda angle: angle * (np.pi / 180), "angle", lambda beta: beta * (180 / np.pi)),
        Conversion(
            "Omega",
            ("speed", "J1", "k1"),
            lambda speed, j1, k1: speed * RPM / _frequency(j1, k1),
            "speed sqrt(J1/k1)",
            lambda omega, j1, k1: omega * _frequency(j1, k1) / RPM,
        ),
        Conversion(
            "zeta",
            ("c1", "J1", "k1"),
            lambda c1, j1, k1: c1 / _unit_of_damping(j1, k1),
            "c1/(2 sqrt(k1 J1))",
            lambda zeta, j1, k1: zeta * _unit_of_damping(j1, k1),
        ),
        Conversion("alpha", ("c2", "c1"), _alpha, "c2/c1"),
        Conversion("mu", ("k2", "k1"), lambda k2, k1: k2 / k1, "k2/k1", lambda mu, k1: mu * k1),
        Conversion("gamma", ("J2", "J1"), lambda j2, j1: j2 / j1, "J2/J1", lambda gamma, j1: gamma * j1),
    ),
)


OPEN = {"open_lower": True, "open_upper": True}
# Decay over half a period beyond which slow modes lose digits in absolute coordinates.
_STRONG = 10.0

_SHAFT = ("beta", "Omega", "zeta", "alpha", "mu", "gamma")
_BASE_CASE = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
PRESETS = {"base": _BASE_CASE, "alpha20": _BASE_CASE | {"alpha": 20.0}, "mu20": _BASE_CASE | {"mu": 20.0}}


def speed_ratio(beta: Any, phi: Any) -> tuple[Array, Array, Array]:
    """Transmission ratio ``eta`` and its first and second derivative with respect to the joint's rotation ``phi``.

    Eq. (1): eta = cos(beta) / (1 - sin(beta)^2 sin(phi)^2), period pi.
    """
    c, s2 = jnp.cos(beta), jnp.sin(beta) ** 2
    across, along = jnp.sin(phi), jnp.cos(phi)
    # The denominator of eq. (1) as a sum of squares: the difference loses 1/c^2 units of rounding where eta is largest.
    d = along**2 + (c * across) ** 2
    sine, cosine = 2 * across * along, (along - across) * (along + across)
    return c / d, c * s2 * sine / d**2, c * s2 * (2 * cosine / d**2 + 2 * s2 * sine**2 / d**3)


def _inverse_square(x: Any) -> np.ndarray:
    return 1 / np.asarray(x) ** 2


# Phi is entire in 1/Omega, mu, alpha, zeta, 1/sqrt(gamma) and ln sec(beta). The last holds because the path of integration
# can avoid the poles of eta, sin(tau)^2 = 1/sin(beta)^2, and because cos(beta) = 0 or infinity is infinitely far away.
SMOOTH = Smoothness(
    {
        "beta": Coordinate(
            "ln sec(beta)",
            lambda beta: -np.log1p(-2 * np.sin(np.asarray(beta) / 2) ** 2),
            lambda x: 2 * np.arcsin(np.sqrt(-np.expm1(-np.asarray(x)) / 2)),
            np.tan,
            even=True,
        ),
        "Omega": Coordinate(
            "1/Omega", lambda x: 1 / np.asarray(x), lambda x: 1 / np.asarray(x), lambda x: -_inverse_square(x)
        ),
        "gamma": Coordinate(
            "1/sqrt(gamma)", lambda x: 1 / np.sqrt(x), _inverse_square, lambda x: -0.5 / (np.sqrt(x) * np.asarray(x))
        ),
    },
    "Omega",
    balance,
    ENCLOSURE,
)


class Cardan(System):
    """The shaft of eqs (2)-(3): see the module's docstring. Parameters are numbers or arrays of any common shape.

    >>> import jax.numpy as jnp
    >>> from drivetrain_jax import Cardan
    >>> shaft = Cardan(beta=0.3, Omega=1.416, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> print(shaft.vector_field(0.5, jnp.zeros(4)).round(6))
    [ 0.        0.        0.       -0.073111]
    """

    name = "cardan"
    periods_per_turn = 2
    title = "Cardan (Hooke-joint) shaft"
    source = "Soltan Rezaee & Ghazavi, Modares Mechanical Engineering 14(12), 2014, 163-170"
    presets = PRESETS
    resonances = CARDAN
    physical = PHYSICAL
    roles = MappingProxyType({"speed": "Omega", "angle": "beta", "damping": "zeta"})
    state = (
        Component("theta1", "rad", "twist of the driving shaft"),
        Component("theta2", "rad", "twist of the driven shaft"),
        Component("theta1_rate", "rad", "d theta1/d tau"),
        Component("theta2_rate", "rad", "d theta2/d tau"),
    )
    displacements = Dimension("shaft", "shaft", ("driving", "driven"))

    beta: Number = parameter("rad", "joint angle", symbol="β", lower=-math.pi / 2, upper=math.pi / 2, **OPEN)
    Omega: Number = parameter("1", "speed of the driving shaft over sqrt(k1/J1)", symbol="Ω", **POSITIVE)
    zeta: Number = parameter("1", "damping ratio of the driving shaft", symbol="ζ", lower=0.0)
    alpha: Number = parameter("1", "damping of the driven over the driving shaft, c2/c1", symbol="α", lower=0.0)
    mu: Number = parameter("1", "stiffness of the driven over the driving shaft, k2/k1", symbol="μ", **POSITIVE)
    gamma: Number = parameter("1", "inertia of the driven over the driving disk, J2/J1", symbol="γ", **POSITIVE)
    theta1_0: Number = parameter("rad", "twist of the driving shaft at tau = 0", default=0.0)
    theta2_0: Number = parameter("rad", "twist of the driven shaft at tau = 0", default=0.0)
    theta1_rate_0: Number = parameter("rad", "d theta1/d tau at tau = 0", default=0.0)
    theta2_rate_0: Number = parameter("rad", "d theta2/d tau at tau = 0", default=0.0)

    def vector_field(self, tau: Any, y: Array) -> Array:
        """Nonlinear equations of motion, eqs (2)-(3), as ``y' = f(tau, y)`` with ``y = (theta1, theta2, theta1', theta2')``.

        theta1'' = -2 zeta theta1'/Omega + eta (2 alpha zeta theta2'/Omega) - theta1/Omega^2 + eta mu theta2/Omega^2
        theta2'' = -[eta_phi (1 + theta1')^2 + eta theta1''] - (2 alpha zeta theta2'/Omega + mu theta2/Omega^2)/gamma
        with eta at phi = tau + theta1. ``y`` has shape ``(4, ...)``.
        """
        theta1, theta2, rate1, rate2 = y
        eta, eta_phi, _ = speed_ratio(self.beta, tau + theta1)
        s, damping = 1 / self.Omega, 2 * self.zeta / self.Omega
        torque1 = damping * rate1 + s**2 * theta1
        torque2 = self.alpha * damping * rate2 + self.mu * s**2 * theta2
        acceleration1 = eta * torque2 - torque1
        acceleration2 = -(eta_phi * (1 + rate1) ** 2 + eta * acceleration1) - torque2 / self.gamma
        return jnp.stack(jnp.broadcast_arrays(rate1, rate2, acceleration1, acceleration2))

    def damping_and_stiffness(self, tau: Any) -> tuple[Rows, Rows]:
        """``E`` and ``P`` of the linearised equations theta'' + E theta' + P theta = (0, -eta')^T, eqs (5)-(6)."""
        eta, d1, d2 = speed_ratio(self.beta, tau)
        s, damping = 1 / self.Omega, 2 * self.zeta / self.Omega
        alpha, mu, inertia = self.alpha, self.mu, eta**2 + 1 / self.gamma
        e = ((damping, -alpha * damping * eta), (2 * d1 - damping * eta, alpha * damping * inertia))
        p = ((s**2, -mu * s**2 * eta), (d2 - s**2 * eta, mu * s**2 * inertia))
        return e, p

    def linear_rows(self, tau: Any) -> Rows:
        """``A(tau)`` of ``y' = A y``, ``y = (theta1, theta2, theta1', theta2')``, homogeneous part of eq. (4)."""
        e, p = self.damping_and_stiffness(tau)
        return ((0, 0, 1.0, 0), (0, 0, 0, 1.0), *(tuple(-entry for entry in (*p[i], *e[i])) for i in range(2)))

    def linear_field(self, tau: Any, y: Array) -> Array:
        """Right-hand side of the forced linear equations, eq. (4)."""
        rows = self.linear_rows(tau)
        forcing = (0.0, 0.0, 0.0, -speed_ratio(self.beta, tau)[1])
        return jnp.stack(
            jnp.broadcast_arrays(
                *(sum(a * x for a, x in zip(row, y, strict=True)) + f for row, f in zip(rows, forcing, strict=True))
            )
        )

    def _reduced_rows(self, cos2psi: Any, sin2psi: Any) -> Rows:
        """``d(q, p)/dpsi = (w/Omega) B(eta) (q, p)`` in absolute coordinates, in the clock psi, eqs (9)-(10)."""
        zeta, alpha, mu = self.zeta, self.alpha, self.mu
        g = 1 / jnp.sqrt(self.gamma)
        eta, w, _, _ = clock(cos2psi, sin2psi, self.beta)
        sw = w / self.Omega
        f11, f21, f22 = zeta * (1 + alpha * eta**2), -2 * zeta * alpha * g * eta, zeta * alpha * g**2
        k11 = sw * (f11**2 + f21**2 - 1 - mu * eta**2)
        k12 = sw * (f21 * f22 + mu * g * eta)
        k22 = sw * (f22**2 - mu * g**2)
        d11, d21, d22 = -sw * f11, -sw * f21, -sw * f22
        return ((d11, 0, sw, 0), (d21, d22, 0, sw), (k11, k12, d11, d21), (k12, k22, 0, d22))

    def _absolute_rows(self, cos2psi: Any, sin2psi: Any) -> Rows:
        """``d(q, q_psi)/dpsi`` of the absolute coordinates in the clock psi, eq. (12a)."""
        zeta, mu, g, s = 2 * self.zeta, self.mu, 1 / jnp.sqrt(self.gamma), 1 / self.Omega
        eta, w, deta, turn = clock(cos2psi, sin2psi, self.beta)
        sw = s * w
        stiff, damping = -sw * sw, -zeta * sw
        c12, k12 = -self.alpha * g * eta, -mu * g * eta
        felt = damping * self.alpha * deta
        return (
            (0, 0, 1.0, 0),
            (0, 0, 0, 1.0),
            (
                stiff * (1 + mu * eta**2) + felt * eta,
                stiff * k12,
                turn + damping * (1 + self.alpha * eta**2),
                damping * c12,
            ),
            (stiff * k12 - felt * g, stiff * mu * g**2, damping * c12, turn + damping * self.alpha * g**2),
        )

    def _reversal(self) -> tuple[Rows, Rows]:
        """``R0`` and ``R1`` of the absolute form, eq. (12c); eta is cos(beta) at the start and 1/cos(beta) at the end."""
        c, g = jnp.cos(self.beta), 1 / jnp.sqrt(self.gamma)

        def damping(eta: Any) -> tuple[Any, Any, Any]:
            zeta = 2 * self.zeta
            off = -zeta * self.alpha * eta * g
            return zeta * (1 + self.alpha * eta**2), off, zeta * self.alpha * g**2

        # w is 2/(1 + c) at the start, and c times that at the end.
        slow = 2 / (1 + c) / self.Omega
        d11, d12, d22 = (-(slow**2) * x for x in damping(c))
        start = ((0, 0, slow, 0), (0, 0, 0, slow), (slow, 0, d11, d12), (0, slow, d12, d22))
        fast = 1 / (c * slow)
        d11, d12, d22 = damping(1 / c)
        return start, ((d11, d12, fast, 0), (d12, d22, 0, fast), (fast, 0, 0, 0), (0, fast, 0, 0))

    def _twist_rows(self, cos2psi: Any, sin2psi: Any) -> Rows:
        """``d(x, v)/dpsi`` of the twists x = (theta_1, sqrt(mu) theta_2) and v = Omega q', in the clock psi, eq. (13a)."""
        alpha, root_mu, g = self.alpha, jnp.sqrt(self.mu), 1 / jnp.sqrt(self.gamma)
        eta, w, deta, _ = clock(cos2psi, sin2psi, self.beta)
        sw, damping = w / self.Omega, 2 * self.zeta
        n21, n22, d = -root_mu * eta, root_mu * g, sw * damping
        # Through the joint the first twist changes the second one, on which the damper acts.
        turned, felt = -root_mu * deta, alpha * damping * deta
        return (
            (0, 0, sw, 0),
            (turned, 0, sw * n21, sw * n22),
            (-sw - felt * eta, -sw * n21, -d * (1 + alpha * eta**2), d * alpha * eta * g),
            (felt * g, -sw * n22, d * alpha * eta * g, -d * alpha * g**2),
        )

    def _twist_reversal(self) -> tuple[Rows, Rows]:
        """``R0`` and ``R1`` of the twists, eq. (13b); eta is cos(beta) at the start and 1/cos(beta) at the end."""
        alpha, mu, damping = self.alpha, self.mu, 2 * self.zeta
        root_mu, g, eta = jnp.sqrt(mu), 1 / jnp.sqrt(self.gamma), jnp.cos(self.beta)
        n21, n22 = -root_mu * eta, root_mu * g
        off = damping * alpha * eta * g
        start = (
            (0, 0, 1.0, 0),
            (0, 0, n21, n22),
            (1.0, n21, -damping * (1 + alpha * eta**2), off),
            (0, n22, off, -damping * alpha * g**2),
        )
        m21, m22 = 1 / (eta * g), 1 / n22
        end = ((damping, 0, 1.0, m21), (0, damping * alpha / mu, 0, m22), (1.0, 0, 0, 0), (m21, m22, 0, 0))
        return start, end

    def log_determinant(self) -> Array:
        """Exact ``log det Z`` over the period pi (Liouville).

        Eq. (13): -(2 pi zeta/Omega) [1 + alpha/gamma + alpha (1 + c^2)/(2 c)], c = cos(beta).
        """
        c = jnp.cos(self.beta)
        mean: Any = 1 + self.alpha / self.gamma + self.alpha * (1 + c**2) / (2 * c)
        return -2 * math.pi * self.zeta / self.Omega * mean

    def panels(self, rtol: float) -> np.ndarray:
        """Predicted panels of Gauss collocation, as floats of the batch's shape.

        Fitted to the need of 2,048 random points with zeta from 1e-5 to 300 and of 2,048 cells of the base chart, at rtol
        from 1e-6 to 1e-12, for the phase of the oscillation over the half period, 1/cos(beta) and, where it is large, the
        decay: 1.35 times the need in the median, with a standard deviation of 17 %, or 50 % where the decay is large. The
        prediction affects the cost, but never the accuracy, which the solver tests.
        """
        xp, beta, speed, mu, gamma = numeric(self.beta, self.Omega, self.mu, self.gamma)
        with np.errstate(over="ignore"):
            soft = 1 / gamma
        c = xp.cos(beta)
        ends, time = 2 / (1 + c), math.pi / 2 / speed
        # By Simpson's rule, from the largest frequencies at both ends and in the middle.
        rates = (
            ends * xp.sqrt(1 + mu * (c * c + soft)),
            xp.sqrt(1 + mu * (1 + soft)),
            ends * xp.sqrt(c * c + mu * (1 + c * c * soft)),
        )
        with np.errstate(over="ignore"):
            phase = time * (rates[0] + 2 * rates[1] + rates[2]) / 4
            return panels_needed(xp, phase, -xp.log(c), self._decay(), -math.log10(rtol) - 6)

    def _decay(self) -> np.ndarray:
        """The largest rate of decay times half the period."""
        xp, beta, speed, zeta, alpha, gamma = numeric(self.beta, self.Omega, self.zeta, self.alpha, self.gamma)
        c = xp.cos(beta)
        ends = 2 / (1 + c)
        with np.errstate(over="ignore"):
            soft, time = 1 / gamma, math.pi / 2 / speed
            return (
                time * zeta * xp.maximum(ends * (1 + alpha * (c * c + soft)), ends * (c + alpha * (1 / c + c * soft)))
            )

    def is_strongly_damped(self) -> np.ndarray:
        """True where the twists are better than the absolute coordinates, whose stiffness is squared."""
        return self._decay() > _STRONG

    def is_hamiltonian(self) -> Any:
        """True without damping."""
        return self.zeta == 0

    @serves("atlas", parameters=_SHAFT, smooth=SMOOTH)
    @serves("floquet", parameters=_SHAFT)
    def floquet_model(self) -> FloquetModel:
        """The linearised shaft in its own coordinates and time, and two equivalent forms over half a period."""

        def own(method: Callable[..., Any]) -> Partial:
            # A tenth of the time of a bound method of a module.
            return Partial(method, self)

        kind, exact = type(self), own(type(self).log_determinant)
        # The reversor exchanges q and P: time reversal about the middle of the half period.
        reduced = LinearPeriodic(own(kind._reduced_rows), math.pi / 2, clock_basis, SWAP, exact)
        marched = LinearPeriodic(own(kind._absolute_rows), math.pi / 2, clock_basis, None, exact, own(kind._reversal))
        twists = own(kind._twist_rows), math.pi / 2, clock_basis, None, exact, own(kind._twist_reversal)
        damped = LinearPeriodic(*twists)
        return FloquetModel(
            natural=LinearPeriodic(own(kind.linear_rows), math.pi, log_determinant=exact),
            reduced=reduced,
            marched=marched,
            damped=damped,
            strongly_damped=own(kind.is_strongly_damped),
            panels=own(kind.panels),
            hamiltonian=own(kind.is_hamiltonian),
        )

    @serves("history", "lyapunov")
    def flow(self) -> Flow:
        """The nonlinear equations, with a strobe every half turn of the driving shaft."""

        def own(method: Callable[..., Any]) -> Partial:
            return Partial(method, self)

        steepest = jnp.cos(self.beta)
        largest = 1 / steepest**2 + 1 / self.gamma
        # Rates where the joint turns fastest: of the motion, of its decay, and of the joint itself.
        motion = jnp.sqrt(1 + self.mu * largest) / self.Omega
        decay = 2 * self.zeta / self.Omega * (1 + self.alpha * largest)
        return Flow(
            own(type(self)._components),
            (self.theta1_0, self.theta2_0, self.theta1_rate_0, self.theta2_rate_0),
            period=math.pi,
            turns=(1,),
            divergence=own(type(self)._divergence),
            fastest=jnp.maximum(jnp.maximum(motion, decay), 2 / steepest),
        )

    def _components(self, angles: Components, y: Any) -> Components:
        """The components of ``y'``; the clock turns twice as fast as the shaft."""
        return tuple(self.vector_field(angles[0] / 2, y))

    def _divergence(self, angles: Components, y: Any) -> Array:
        """Trace of the Jacobian of the field."""
        eta, _, _ = speed_ratio(self.beta, angles[0] / 2 + y[0])
        return jnp.asarray(-2 * self.zeta / self.Omega * (1 + self.alpha * (eta**2 + 1 / self.gamma)))

    @serves("frequency_response", parameters=_SHAFT, returns=ForcedModel)
    @serves("forced", parameters=_SHAFT)
    def forced_model(self) -> ForcedModel:
        """The nonlinear shaft, and its linearisation with the forcing (0, -eta')."""
        return ForcedModel(self.vector_field, self.linear_field, math.pi, displacements=(0, 1))
