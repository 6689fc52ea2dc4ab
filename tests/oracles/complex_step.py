"""Derivatives by complex steps, ``df/dp = Im f(p + ih)/h``, in plain NumPy and SciPy without automatic differentiation.

Every function takes the parameters ``values`` and the ``names`` of the parameters to differentiate by, and returns
derivatives with the names as last axis. Lane j of an integration has a step in parameter j.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

# Relative step, whose error is its square.
STEP = 1e-9
_TOLERANCES = {"method": "DOP853", "rtol": 3e-14, "atol": 1e-16}

Values = Mapping[str, Any]
Field = Callable[[float, np.ndarray, Values], Sequence[np.ndarray]]


def lanes(values: Values, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Complex parameters ``(P,)``; lane j has the relative step in ``names[j]``."""
    numbers = {name: value for name, value in values.items() if not isinstance(value, str)}
    complexes = {name: np.full(len(names), value, complex) for name, value in numbers.items()}
    for j, name in enumerate(names):
        complexes[name][j] += 1j * STEP * values[name]
    return complexes


def slopes(stepped: np.ndarray, values: Values, names: Sequence[str]) -> np.ndarray:
    """Derivatives from results of :func:`lanes`, which have the lanes as last axis."""
    return stepped.imag / (STEP * np.array([values[name] for name in names]))


def flow(field: Field, start: np.ndarray, values: Values, times: Sequence[float]) -> np.ndarray:
    """States at rising ``times`` from ``start`` (n, ...) at 0, shape ``(len(times), n, ...)``."""
    shape = start.shape

    def flat(t: float, y: np.ndarray) -> np.ndarray:
        return np.stack(np.broadcast_arrays(*field(t, y.reshape(shape), values))).reshape(-1)

    found = solve_ivp(flat, (0.0, times[-1]), start.reshape(-1), t_eval=times, **_TOLERANCES)
    assert found.success
    return found.y.T.reshape(len(times), *shape)


def columns_of(n: int, values: Values) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Unit states ``(n, n, P)``, and the parameters with an axis for the states."""
    count = len(next(iter(values.values())))
    return np.repeat(np.eye(n, dtype=complex)[:, :, None], count, axis=2), dict(values)


def radius_slopes(matrices: np.ndarray, values: Values, names: Sequence[str]) -> tuple[np.ndarray, float]:
    """Derivatives of the spectral radius of ``matrices`` (n, n, P), and the relative distance of the next modulus."""
    sigma, right = np.linalg.eig(matrices[..., 0].real)
    k = int(np.argmax(np.abs(sigma)))
    left = np.linalg.inv(right)[k]
    moved = np.einsum("i,ijp,j->p", left, slopes(matrices, values, names), right[:, k])
    others = [s for i, s in enumerate(sigma) if i != k and abs(s - sigma[k].conj()) > 1e-9 * abs(s)]
    gap = min(abs(s - sigma[k]) / abs(sigma[k]) for i, s in enumerate(sigma) if i != k)
    apart = min([1 - abs(s) / abs(sigma[k]) for s in others], default=1.0)
    return (sigma[k].conj() * moved).real / abs(sigma[k]), min(apart, gap)


# The cardan shaft, eqs (1)-(6) of the paper with the signs corrected.


def _ratio(values: Values, phase: Any) -> tuple[Any, Any, Any]:
    c, s2 = np.cos(values["beta"]), np.sin(values["beta"]) ** 2
    d, d1, d2 = 1 - s2 * np.sin(phase) ** 2, -s2 * np.sin(2 * phase), -2 * s2 * np.cos(2 * phase)
    return c / d, -c * d1 / d**2, c * (2 * d1**2 / d**3 - d2 / d**2)


def cardan_linear(tau: float, y: np.ndarray, p: Values, forcing: float = 1.0) -> list[Any]:
    """Right-hand side of the linearised shaft, homogeneous without ``forcing``."""
    x1, x2, r1, r2 = y
    eta, d1, d2 = _ratio(p, tau)
    s, d, inertia = 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"], eta**2 + 1 / p["gamma"]
    twist, rate = p["mu"] * s * x2, p["alpha"] * d * r2
    first = -(s * x1 + d * r1) + eta * (twist + rate)
    second = -(2 * d1 - d * eta) * r1 - (d2 - s * eta) * x1 - inertia * (twist + rate) - forcing * d1
    return [r1, r2, first, second]


def cardan_nonlinear(tau: float, y: np.ndarray, p: Values) -> list[Any]:
    """Right-hand side of the nonlinear shaft."""
    x1, x2, r1, r2 = y
    eta, d1, _ = _ratio(p, tau + x1)
    s, d = 1 / p["Omega"] ** 2, 2 * p["zeta"] / p["Omega"]
    torque = p["alpha"] * d * r2 + p["mu"] * s * x2
    first = eta * torque - d * r1 - s * x1
    return [r1, r2, first, -d1 * (1 + r1) ** 2 - eta * first - torque / p["gamma"]]


def cardan_monodromy(values: Values, names: Sequence[str]) -> np.ndarray:
    """The monodromy matrix ``(4, 4, P)`` with a step in every lane."""
    stepped = lanes(values, names)
    start, _ = columns_of(4, stepped)
    return flow(lambda t, y, p: cardan_linear(t, y, p, 0.0), start, stepped, [np.pi])[0]


def periodic_slopes(
    field: Field, state: np.ndarray, period: float, shown: Sequence[int], values: Values, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the periodic ``state`` (n,) and of the largest ``|y_i|`` for i in ``shown``.

    ``y0' = (I - M)^-1 dF/dp`` for the map F over a period; at the peak the state is stationary in time.
    """
    n, stepped = len(state), lanes(values, names)
    moved = np.repeat(state[:, None], n, axis=1) + 1j * STEP * np.eye(n)
    fixed = {name: np.full(n, value, complex) for name, value in values.items()}
    matrix = flow(field, moved, fixed, [period])[0].imag / STEP
    start = np.repeat(state.astype(complex)[:, None], len(names), axis=1)
    change = flow(field, start, stepped, [period])[0].imag
    start = start + 1j * np.linalg.solve(np.eye(n) - matrix, change)
    tops = []
    for i in shown:
        time, sign = _peak(field, state, period, i, values)
        tops.append(sign * slopes(flow(field, start, stepped, [time])[0][i], values, names))
    return slopes(start, values, names), np.array(tops)


def _peak(field: Field, state: np.ndarray, period: float, i: int, values: Values) -> tuple[float, float]:
    """Time and sign of the largest ``|y_i|`` of a motion."""
    right = lambda t, y: np.array(field(t, y, values), float)  # noqa: E731
    path = solve_ivp(right, (0, period), state, dense_output=True, max_step=period / 200, **_TOLERANCES).sol
    times = np.linspace(0, period, 4001)
    best = times[np.argmax(np.abs(path(times)[i]))]
    step = times[1]
    rate = lambda t: right(t, path(t))[i]  # noqa: E731
    low, high = max(best - step, 1e-9), min(best + step, period)
    time = brentq(rate, low, high, xtol=1e-14) if rate(low) * rate(high) < 0 else best
    return time, float(np.sign(path(time)[i]))


# The double-tripod shaft, input element: eqs (1)-(14), (25) and (29).


def tripod_constants(p: Values) -> dict[str, Any]:
    """Natural angular frequency, coefficients of g, joint amplitude and torque over inertia."""
    cos2 = np.cos(p["beta"]) ** 2
    bell = p["J_m"] * (1 + cos2) + p["S_B"] * p["d_C"] ** 2
    axle = np.pi * p["d_A"] ** 4 / 64 * (1 + cos2) + np.pi * p["d_A"] ** 2 / 4 * (p["L_B"] + 0.5 * p["L_A"]) ** 2
    inertia = p["rho"] * (bell * p["L_B"] + axle * p["L_A"])
    stiffness = p["G"] * axle * bell / (axle * p["L_B"] + bell * p["L_A"])
    c1 = p["chi_n"] * inertia / (p["rho"] * bell * p["L_B"])
    c2 = c1 * bell * p["L_A"] / (axle * p["L_B"] + bell * p["L_A"])
    joint = 0.5 * p["R"] / p["L_DM2"] * np.tan(p["beta"]) * np.tan(p["beta"] / 2) ** 2
    return {"omega": np.sqrt(stiffness / inertia), "c1": c1, "c2": c2, "joint": joint, "drive": p["M_AEM"] / inertia}


def _stiffness_ratio(p: Values, k: Values, x: Any) -> Any:
    cosine = np.cos(x)
    return (1 + k["c1"] * cosine) / ((1 + k["c2"] * cosine) * (1 + p["chi_n"] * cosine))


def tripod_monodromy(values: Values, names: Sequence[str]) -> np.ndarray:
    """Monodromy matrix ``(2, 2, P)`` over ``1/excitation_frequency``, in the state (phi, V/omega)."""
    stepped = lanes(values, names)
    start, _ = columns_of(2, stepped)
    k = tripod_constants(stepped)

    def field(s: float, y: np.ndarray, p: Values) -> list[Any]:
        g, scale = _stiffness_ratio(p, k, 2 * np.pi * s), k["omega"] / p["excitation_frequency"]
        return [scale * y[1], scale * (-2 * p["zeta"] * np.sqrt(g) * y[1] - g * y[0])]

    return flow(field, start, stepped, [1.0])[0]


def tripod_history(values: Values, names: Sequence[str], times: Sequence[float]) -> np.ndarray:
    """Derivatives of phi and V at ``times`` from rest, eq. (25): ``(len(times), 2, P)``."""
    stepped = lanes(values, names)
    k, motor = tripod_constants(stepped), 100 * np.pi * values["motor_order"]

    def field(t: float, y: np.ndarray, p: Values) -> list[Any]:
        phi, rate = y
        ripple = sum(np.cos(2**i * motor * t) / 2 ** (i + 1) for i in range(6))
        torque = k["drive"] * (1 + p["chi_AEM"] * ripple) * (1 - 3 * k["joint"] * np.sin(3 * phi))
        g = _stiffness_ratio(p, k, 2 * phi)
        damping = 2 * p["zeta"] * k["omega"] * np.sqrt(g) * rate
        return [rate, torque / (1 + p["chi_n"] * np.cos(2 * phi)) - damping - k["omega"] ** 2 * g * phi]

    return slopes(flow(field, np.zeros((2, len(names)), complex), stepped, times), values, names)


# Gear rattle: matrix exponentials between the flanks.


class RattleOrbit:
    """A periodic orbit of u'' + (c/I) u' + (k/I) f(u) = B0 + B1 cos(omega t) through ``state`` at t = 0.

    ``crossings`` are the times of flank crossings in ``multiple`` periods, ``sides`` the regions between them.
    """

    def __init__(self, values: Values, state: np.ndarray, multiple: int) -> None:
        self.values, self.state, self.multiple = dict(values), state, multiple
        self.crossings, self.sides = self._walk()

    @property
    def span(self) -> float:
        return 2 * np.pi * self.multiple / self.values["omega"]

    def _walk(self) -> tuple[list[float], list[int]]:
        p, b, step = self.values, self.values["b"], 2 * np.pi / self.values["omega"] / 2000
        w, t = self._wide(p, self.state, 0.0), 0.0
        side = _side(w[0], b) if abs(w[0]) != b else int(np.sign(w[0]) * (np.sign(w[0] * w[1]) > 0))
        moves = {s: expm(step * _generator(p, s)) for s in (-1, 0, 1)}
        crossings, sides = [], [side]
        while t < self.span * (1 - 1e-12):
            new = moves[side] @ w
            if _side(new[0], b) != side:
                level = b * (side if side else np.sign(new[0]))
                a, here = _generator(p, side), w
                inside = brentq(
                    lambda x, a=a, here=here, level=level: (expm(x * a) @ here)[0] - level, 0, step, xtol=1e-15
                )
                w, t = expm(inside * a) @ w, t + inside
                # Slightly beyond the flank, so that the next region begins inside.
                side = int(np.sign(level)) if side == 0 else 0
                crossings.append(t)
                sides.append(side)
            else:
                w, t = new, t + step
        kept = [x for x in crossings if x < self.span]
        return kept, sides[: len(kept) + 1]

    @staticmethod
    def _wide(p: Values, state: np.ndarray, t: float) -> np.ndarray:
        return np.array([*state, 1.0, np.cos(p["omega"] * t), np.sin(p["omega"] * t)])

    def run(self, p: Values, state: np.ndarray, end: Any) -> list[tuple[np.ndarray, Any, int]]:
        """States, times and regions at the beginning of each region, and at the ``end``; complex."""
        w, t, path = self._wide(p, state, 0.0).astype(complex), 0.0 + 0j, []
        for crossing, side in zip(self.crossings, self.sides, strict=False):
            path.append((w, t, side))
            a, x = _generator(p, side), crossing - t
            level = p["b"] * np.sign((expm(x.real * a.real) @ w.real)[0])
            for _ in range(3):
                moved = expm(x * a) @ w
                x = x - (moved[0] - level) / moved[1]
            w, t = expm(x * a) @ w, t + x
        path.append((w, t, self.sides[-1]))
        path.append((expm((end - t) * _generator(p, self.sides[-1])) @ w, end, self.sides[-1]))
        return path

    def slopes(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Derivatives of the state at t = 0, of the extremes and of the rms of u."""
        p = self.values
        matrix = np.stack(
            [self.run(p, self.state + 1j * STEP * e, self.span)[-1][0][:2].imag / STEP for e in np.eye(2)], axis=1
        )
        found: dict[str, list[Any]] = {"orbit_state": [], "u_max": [], "u_min": [], "u_rms": []}
        tops = [self._extreme(sign) for sign in (1, -1)]
        for name in names:
            stepped = dict(p)
            stepped[name] = p[name] + 1j * STEP * p[name]
            end = 2 * np.pi * self.multiple / stepped["omega"]
            change = self.run(stepped, self.state, end)[-1][0][:2].imag
            state = self.state + 1j * np.linalg.solve(np.eye(2) - matrix, change)
            path = self.run(stepped, state, end)
            found["orbit_state"].append(state.imag / (STEP * p[name]))
            for key, (k, time) in zip(("u_max", "u_min"), tops, strict=True):
                w, t, side = path[k]
                found[key].append((expm((time - t) * _generator(stepped, side)) @ w)[0].imag / (STEP * p[name]))
            found["u_rms"].append(np.sqrt(self._square(stepped, path) / end).imag / (STEP * p[name]))
        return {key: np.moveaxis(np.array(x), 0, -1) for key, x in found.items()}

    def _extreme(self, sign: int) -> tuple[int, float]:
        """Region and time of the largest ``sign * u``."""
        path, best = self.run(self.values, self.state, self.span), (-np.inf, 0, 0.0)
        for k, (w, t, side) in enumerate(path[:-1]):
            a, w, t, end = _generator(self.values, side), w.real, t.real, path[k + 1][1].real
            times = np.linspace(0, end - t, 400)
            states = [w]
            move = expm(times[1] * a)
            for _ in times[1:]:
                states.append(move @ states[-1])
            j = int(np.argmax(sign * np.array(states)[:, 0]))
            low, high = times[max(j - 1, 0)], times[min(j + 1, len(times) - 1)]
            rate = lambda x, a=a, w=w: (expm(x * a) @ w)[1]  # noqa: E731
            x = brentq(rate, low, high, xtol=1e-15) if rate(low) * rate(high) < 0 else times[j]
            best = max(best, (float(sign * (expm(x * a) @ w)[0]), k, t + x))
        return best[1], best[2]

    def _square(self, p: Values, path: list[tuple[np.ndarray, Any, int]]) -> Any:
        """Integral of u^2 over the period, by Gauss-Legendre sums on pieces of each region."""
        nodes, weights = np.polynomial.legendre.leggauss(12)
        total = 0.0 + 0j
        for k, (w, t, side) in enumerate(path[:-1]):
            a, pieces = _generator(p, side), 8
            h = (path[k + 1][1] - t) / pieces
            moves = [expm(h * (1 + x) / 2 * a) for x in nodes]
            whole = expm(h * a)
            for _ in range(pieces):
                total += h / 2 * sum(weight * (move @ w)[0] ** 2 for move, weight in zip(moves, weights, strict=True))
                w = whole @ w
        return total


def _side(u: float, b: float) -> int:
    return int(np.sign(u)) if abs(u) > b else 0


def _generator(p: Values, side: int) -> np.ndarray:
    """``w' = A w`` for ``w = (u, v, 1, cos omega t, sin omega t)`` beyond the flank ``side``, or between the flanks."""
    stiffness = p["k"] / p["I"]
    force = p["B0"] + (stiffness * side * (1 - p["alpha"]) * p["b"] if side else 0.0)
    spring = stiffness if side else p["alpha"] * stiffness
    a = np.zeros((5, 5), complex if any(isinstance(x, complex) for x in p.values()) else float)
    a[0, 1] = 1.0
    a[1] = [-spring, -p["c"] / p["I"], force, p["B1"], 0.0]
    a[3, 4], a[4, 3] = -p["omega"], p["omega"]
    return a
