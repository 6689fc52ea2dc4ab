"""Clock of the cardan shaft's reduced equations, and predicted numbers of steps in this clock.

Equation numbers are those of docs/theory/cardan.md.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array


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
    light = 0.78 + 0.315 * x + 0.136 * x**2 + (0.5 - 0.128 * x + 0.022 * digits) * y + 0.2 * digits
    heavy = 1.08 + (0.278 + 0.062 * x) * x + 0.413 * y + (0.201 + 0.02 * z - 0.051 * y - 0.062 * x) * z + 0.182 * digits
    return xp.exp(xp.where(decay > 3, heavy, light))
