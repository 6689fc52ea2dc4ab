"""Clock of the cardan shaft's reduced equations, and predicted numbers of steps in this clock.

Equation numbers are those of docs/theory/cardan.md.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
from jax import Array


def clock_basis(psi: Any) -> tuple[Array, Array]:
    """``cos 2 psi`` and ``sin 2 psi``, the only functions of the clock psi in the reduced equations."""
    return jnp.cos(2 * psi), jnp.sin(2 * psi)


def clock(cos2psi: Any, sin2psi: Any, beta: Any) -> tuple[Any, Any, Any]:
    """``eta``, ``dtau/dpsi`` and ``deta/dpsi`` in the clock psi, eqs (11)-(12).

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
    return eta, w, 4 * r * kappa2 * sin2psi * inverse_plus * minus * inverse


def oscillation_steps(xp: Any, phase: Any, sharpness: Any, digits: float) -> Any:
    """Steps of order 8 for the ``phase`` over half a period; fitted, see ``Cardan.explicit_steps``."""
    x, bend = xp.log(phase), 2.57
    capped = xp.minimum(x, bend)
    # Limited, because rounding dominates beyond 1e-10, and more steps would move points to the implicit scheme.
    power = 1.13 + 0.01 * digits if digits <= 1 else 1.1
    log_steps = 0.59 * capped + 0.1 * capped**2 + power * (x - capped)
    return xp.exp(log_steps + (0.59 - 0.13 * capped - 0.034 * sharpness) * sharpness + 1.7 + 0.26 * digits)


def decay_steps(xp: Any, decay: Any, digits: float) -> Any:
    """Steps of order 8 for the ``decay`` over half a period; fitted, see ``Cardan.explicit_steps``."""
    accurate = math.exp(1.35 + 0.36 * digits) * decay ** (0.79 - 0.027 * digits)
    return xp.maximum(accurate, decay / 3.2)
