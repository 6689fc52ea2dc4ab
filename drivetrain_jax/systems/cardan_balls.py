"""The propagator of the cardan shaft in ball arithmetic, by Taylor series with Cauchy's bound of what they leave out.

It needs python-flint, and shares no code with the rest of the package. Equation numbers are those of docs/theory/atlas.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

# Bits, terms of a series, ratio of the radius of a disc to a step, and largest norm of the exponent over a disc.
_BITS, _TERMS, _RATIO, _LARGEST = 192, 48, 4.0, 6.0


def propagator(values: Mapping[str, float], middle: Mapping[str, float]) -> Any:
    """An ``arb_mat`` that contains T Phi S, eq. (15), at the stored binary64 ``values`` of all parameters."""
    from flint import acb, arb, arb_mat, arb_series, ctx

    ctx.prec, ctx.cap = _BITS, _TERMS + 1
    c, s, i = arb(values["beta"]).cos(), 1 / arb(values["Omega"]), acb(0, 1)
    zeta, alpha, mu, g = *(arb(values[name]) for name in ("zeta", "alpha", "mu")), arb(values["gamma"]).rsqrt()
    root, turn = c.sqrt(), (1 - c).sqrt()
    p = root / (1 + turn)
    # Zeros of D1 and D2, eq. (17), all apart from the real axis.
    zeros = (i * p, -i * p, i / p, -i / p), [a * turn + b * i * root for a in (1, -1) for b in (1, -1)]
    near = [complex(float(x.real.mid()), float(x.imag.mid())) for x in (*zeros[0], *zeros[1])]

    def rows(w: Any, eta: Any, minus: int = -1) -> list[Any]:
        """s w B(eta), eq. (10) of cardan.md, by rows; with ``minus = 1`` bounds of the moduli."""
        f11, f21, f22 = zeta * (1 + alpha * eta * eta), minus * 2 * zeta * alpha * g * eta, zeta * alpha * g * g
        k11, k22 = f11 * f11 + f21 * f21 + minus * (1 + mu * eta * eta), f22 * f22 + minus * mu * g * g
        k12, (a, b, d) = f21 * f22 + mu * g * eta, (minus * f for f in (f11, f21, f22))
        return [s * w * entry for entry in (a, 0, 1, 0, b, d, 0, 1, k11, k12, a, b, k12, k22, 0, d)]

    def diagonal(*entries: Any) -> Any:
        return arb_mat(4, 4, [entries[k // 4] if k % 5 == 0 else 0 for k in range(16)])

    t, m = arb(max(middle["mu"], 1.0)).root(4) / root, (1 + arb(middle["mu"])).root(4)
    k = (arb(middle["mu"]) / arb(middle["gamma"])).root(4)
    x, phi = 0.0, diagonal(1 / m, 1 / k, m, k)
    while x < 1:
        # In balanced states the norm of B is small.
        eta = (4 * x * x + float(c) * (1 - x * x) ** 2) / ((1 - x * x) ** 2 + 4 * float(c) * x * x)
        k1, k2 = (1 + values["mu"] * eta**2) ** 0.25, float((mu.sqrt() * g).sqrt())
        scale = [arb(k1), arb(k2), 1 / arb(k1), 1 / arb(k2)]
        radius = min(abs(x - zero) for zero in near) / 2
        while True:
            least, most = (
                [math.prod(abs(x - z) + sign * arb(radius) for z in some) for some in zeros] for sign in (-1, 1)
            )
            disc = rows(2 * (1 + (x + arb(radius)) ** 2) / (root * least[0]), c * most[0] / least[1], 1)
            norm = sum((b * scale[j // 4] / scale[j % 4]) ** 2 for j, b in enumerate(disc)).sqrt().upper()  # pyright: ignore[reportAttributeAccessIssue]
            if norm * radius < _LARGEST:
                break
            radius *= 0.7
        end = min(x + radius / _RATIO, 1.0)
        step, u = arb(end) - arb(x), arb_series([x, 1])
        square = (1 - u * u) * (1 - u * u)
        first, second = 4 * u * u + c * square, square + 4 * c * u * u
        series = [arb_series([0]) + b for b in rows(2 * root * (1 + u * u) / first, first / second)]
        matrices = [arb_mat(4, 4, [b[j] for b in series]) * step**j for j in range(_TERMS)]
        ratio, terms = step / arb(radius), [diagonal(1, 1, 1, 1)]
        for n in range(_TERMS):
            term = matrices[0] * terms[n]
            for j in range(1, n + 1):
                term += matrices[j] * terms[n - j]
            terms.append(term * (step / (n + 1)))
        left_out = (norm * radius).exp() * ratio ** (_TERMS + 1) / (1 - ratio)
        part = arb_mat(4, 4, [arb(0, 1) * left_out * scale[j % 4] / scale[j // 4] for j in range(16)])
        for term in terms:
            part += term
        x, phi = end, part * phi
    return diagonal(t, k, 1 / t, 1 / k) * phi
