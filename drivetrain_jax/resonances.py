"""Resonances that systems predict, and orders of excitations.

This module does not import jax, because figures of stored results need none.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Family:
    """Resonances whose labels begin with ``prefix``, as figures draw them.

    ``name`` stands in the legend, ``line`` is ``solid``, ``dashed`` or ``dashdot``. Resonances that make no tongue are not
    ``drawn``. The periodic forcing excites a ``forced`` family: figures of forced responses show it.
    """

    prefix: str
    name: str
    line: str = "solid"
    drawn: bool = True
    forced: bool = False


@dataclass(frozen=True)
class Resonances:
    """Predicted values of the parameter ``axis``, drawn over charts.

    ``values(parameters)`` maps the values of ``parameters`` (scalars or arrays of shape ``(...)``) to an array of shape
    ``(..., len(labels))``. ``multipliers`` gives for each label the multiplier that meets the unit circle there, ``+1``,
    ``-1`` or ``pair``, if known. ``up_to(k)`` returns the same predictions for the orders 1 to k. ``families`` say how
    figures draw them; the family of a label is the one with the longest prefix. Nothing is predicted for a result that has
    one of the parameters ``without``.
    """

    axis: str
    parameters: tuple[str, ...]
    labels: tuple[str, ...]
    values: Callable[[Values], np.ndarray]
    long_name: str
    multipliers: tuple[str, ...] = ()
    up_to: Callable[[int], Resonances] | None = None
    families: tuple[Family, ...] = ()
    without: tuple[str, ...] = ()

    def family(self, label: str) -> Family | None:
        """The family of a ``label``, None without one."""
        fitting = [family for family in self.families if label.startswith(family.prefix)]
        return max(fitting, key=lambda family: len(family.prefix), default=None)


# Predicted parametric resonances of the cardan shaft; names and equation numbers as in ``systems/cardan.py``.


def natural_frequencies(mu: Any, gamma: Any) -> np.ndarray:
    """Undamped natural frequencies omega1 < omega2 at beta = 0, in units of sqrt(k1/J1), shape ``(..., 2)``; eq. (14).

    omega^2 = [b -+ sqrt(b^2 - 4 mu/gamma)]/2, b = 1 + mu (1 + 1/gamma).
    """
    mu, gamma = np.asarray(mu, float), np.asarray(gamma, float)
    b = 1 + mu * (1 + 1 / gamma)
    # b^2 - 4 mu/gamma as a sum of squares, and the smaller root from the product: no cancellation.
    upper = (b + np.sqrt((1 + mu - mu / gamma) ** 2 + 4 * mu**2 / gamma)) / 2
    return np.sqrt(np.stack([mu / gamma / upper, upper], axis=-1))


def parametric_speeds(modes: Any, sums: Any, orders: int) -> np.ndarray:
    """Speeds of parametric resonance up to order ``orders``: of the frequencies ``modes`` H: omega/(2k), then S:
    omega/(2k - 1), and of their ``sums`` C: sum/(2k); shape ``(..., n)``, by frequency, then by order."""
    ks = range(1, orders + 1)
    single = [w / (2 * k - shift) for shift in (0, 1) for w in modes for k in ks]
    return np.stack([*single, *(w / (2 * k) for w in sums for k in ks)], axis=-1)


def resonance_speeds(values: Values, orders: int = 3) -> np.ndarray:
    """Speeds of parametric resonance, eq. (15), shape ``(..., 6 orders)``, in the order of the labels of the predictions."""
    one, two = np.moveaxis(natural_frequencies(values["mu"], values["gamma"]), -1, 0)
    return parametric_speeds((one, two), (two + one, two - one), orders)


# The forcing has only even harmonics of the speed: it meets natural frequencies at the harmonic speeds. Difference
# combinations make no tongues of parametric resonance (equal Krein signature).
_CARDAN_FAMILIES = (
    Family("H", "harmonic $H$", forced=True),
    Family("S", "subharmonic $S$", "dashed"),
    Family("C", "sum combination $C^+$", "dashdot"),
    Family("C-", "difference combination $C^-$", drawn=False),
)


def cardan_resonances(orders: int = 3) -> Resonances:
    """The predictions of :func:`resonance_speeds` with their labels (H12: first mode, order 2)."""
    kinds = {"H1": "+1", "H2": "+1", "S1": "-1", "S2": "-1", "C+": "pair", "C-": "pair"}
    return Resonances(
        axis="Omega",
        parameters=("mu", "gamma"),
        labels=tuple(f"{kind}{k}" for kind in kinds for k in range(1, orders + 1)),
        values=lambda values: resonance_speeds(values, orders),
        long_name="predicted parametric resonance",
        multipliers=tuple(multiplier for multiplier in kinds.values() for _ in range(orders)),
        up_to=cardan_resonances,
        families=_CARDAN_FAMILIES,
    )


CARDAN = cardan_resonances()


# Predicted end of the motion without separation of rattling gears; names as in ``systems/rattle.py``.


def rattle_threshold(values: Values) -> np.ndarray:
    """Amplitude ``B1`` at which the orbit without separation ceases to exist, shape ``(..., 1)``; NaN if there is none.

    ``B1 = (|B0| - alpha b k/I) sqrt((1 - r^2)^2 + (2 zeta r)^2)``, ``r = omega/sqrt(k/I)``, ``zeta = c/(2 sqrt(k I))``,
    for a mean drive that holds the teeth in contact (either flank). Rattle can coexist with that orbit below it.
    """
    mean, b, c, alpha, k, mass, omega = (
        np.asarray(values[name], float) for name in ("B0", "b", "c", "alpha", "k", "I", "omega")
    )
    margin = np.abs(mean) - alpha * b * k / mass
    r, zeta = omega / np.sqrt(k / mass), c / (2 * np.sqrt(k * mass))
    threshold = margin * np.hypot(1 - r**2, 2 * zeta * r)
    return np.where(margin > 0, threshold, np.nan)[..., None]


RATTLE = Resonances(
    "B1",
    ("omega", "B0", "b", "c", "alpha", "k", "I"),
    ("no separation ends",),
    rattle_threshold,
    "amplitude at which the orbit without separation ends",
    # An unbalance adds to the amplitude B1 of the drive.
    without=("unbalance",),
)


# Predicted parametric resonances of a driveline; each joint modulates its matrices twice a turn of its input.

# Lowest modes with predictions.
_MODES = 4


def joint_speeds(values: Values) -> list[float]:
    """Speeds of the joints over that of the driving end, rising; without angles every element may have a joint."""
    count, ratio = len(values.get("k", ())), values.get("ratio") or ()
    beta = values.get("beta") or (1.0,) * count
    speeds = np.cumprod([1.0, *np.abs(ratio or np.ones(count))])
    return sorted({round(float(speed), 12) for speed, angle in zip(speeds, beta, strict=False) if angle != 0})


def torsional_frequencies(values: Values) -> np.ndarray:
    """Undamped natural frequencies [rad/s] of the `_MODES` lowest modes with straight joints; NaN if there are fewer."""
    k, inertia = np.asarray(values["k"], float), np.asarray(values["J"], float)
    ratio = np.asarray(values.get("ratio") or np.ones(len(k)), float)
    twists = np.eye(len(k)) - np.diag(ratio[1:], -1)
    factor = np.sqrt(k)[:, None] * twists / np.sqrt(inertia)
    frequencies = np.linalg.svd(factor, compute_uv=False)[::-1][:_MODES]
    return np.pad(frequencies, (0, _MODES - len(frequencies)), constant_values=np.nan)


def driveline_resonances(orders: int = 2) -> Resonances:
    """H: omega_i/(2k), S: omega_i/(2k-1), C+: (omega_i + omega_j)/(2k), for i < j, over the speed of the joints, NaN unless
    all have one; labels end in the order k."""
    ks, modes = range(1, orders + 1), range(_MODES)
    pairs = [(i, j) for i in modes for j in modes if i < j]

    def speeds(values: Values) -> np.ndarray:
        turns = joint_speeds(values)
        w = torsional_frequencies(values) / (turns[0] if len(turns) == 1 else np.nan)
        return parametric_speeds(w, [w[i] + w[j] for i, j in pairs], orders)

    single = [f"{kind}{i + 1}{k}" for kind in "HS" for i in modes for k in ks]
    return Resonances(
        axis="speed",
        parameters=("k", "J", "ratio"),
        labels=(*single, *(f"C+{i + 1}{j + 1}{k}" for i, j in pairs for k in ks)),
        values=speeds,
        long_name="predicted parametric resonance",
        multipliers=("+1",) * _MODES * orders + ("-1",) * _MODES * orders + ("pair",) * len(pairs) * orders,
        up_to=driveline_resonances,
        families=_CARDAN_FAMILIES[:3],
    )


DRIVELINE = driveline_resonances()


# Predictions of the systems of this package, so that their figures need no jax.
BUILT_IN: dict[str, Resonances | None] = {
    "cardan": CARDAN,
    "rattle": RATTLE,
    "tripod": None,
    "planetary": None,
    "bicardan": None,
    "driveline": DRIVELINE,
}


# Orders of an excitation: multiples of the speed of a shaft, and the speeds at which they meet natural frequencies.

# Natural frequencies below this part of the largest one, or below these Hz, belong to rigid motions, which no order meets.
# Rounding leaves rigid motions 1e-14 of the largest frequency.
RIGID_PART, _SLOWEST = 1e-12, 1e-6
# Results that are natural frequencies, and Hz for one of their units.
FREQUENCIES = ("natural_frequency", "critical_speed", "angular_frequency")
_IN_HERTZ = {"Hz": 1.0, "rpm": 1 / 60, "rad/s": 1 / (2 * np.pi)}


def in_hertz(values: Any, units: str) -> np.ndarray:
    """Frequencies in Hz."""
    return np.asarray(values, float) * _IN_HERTZ[units]


@dataclass(frozen=True)
class Orders:
    """Excitations by name, each with its periods ``per_turn`` of the ``shaft``. Natural frequencies at rest leave out the
    gyroscopic effect of its ``discs``, and the second one of two ``planes`` of supports."""

    shaft: str
    per_turn: Mapping[str, float]
    discs: bool = False
    planes: bool = False

    @property
    def frequency(self) -> str:
        """The frequencies that the orders meet, as a label."""
        lacking = ["without gyroscopic effect"] * self.discs + ["in the first plane"] * self.planes
        return f"natural frequency at rest, {' and '.join(lacking)}" if lacking else "natural frequency"

    def speeds(self, frequency: Any) -> np.ndarray:
        """Speeds [rpm] at which the orders meet each ``frequency`` [Hz], shape ``(..., orders)``; NaN at rigid motions.

        >>> Orders("carrier", {"mesh": 72.0}).speeds([0.0, 720.0]).ravel().tolist()
        [nan, 600.0]
        """
        frequency = np.asarray(frequency, float)
        largest = np.max(frequency, initial=0.0, where=frequency < np.inf)
        elastic = np.isfinite(frequency) & (frequency > max(RIGID_PART * largest, _SLOWEST))
        return np.where(elastic, frequency, np.nan)[..., None] * 60 / np.array(list(self.per_turn.values()))

    def within(self, speeds: np.ndarray, low: float, high: float, unit: str = "rpm") -> list[str]:
        """Sentences about the operating range [``low``, ``high``]: one for each order that meets a mode there.

        ``speeds`` (modes, orders) are those of :meth:`speeds`, in ``unit`` as the range is.
        """
        said = []
        for name, column in zip(self.per_turn, speeds.T, strict=True):
            met = [
                f"mode {k + 1} at {column[k]:.6g} {unit}" for k in np.flatnonzero((column >= low) & (column <= high))
            ]
            said += [f"{name} meets {', '.join(met)}"] if met else []
        return said or ["no order meets a natural frequency"]


def orders_of(system: str, values: Mapping[str, Any], further: Sequence[float] = ()) -> Orders | None:
    """The orders that excite ``system``, from its parameters and physical data ``values``, and ``further`` ones; None if
    there are none."""
    known, names = _own_orders(system, values), {f"order {n:.6g}": float(n) for n in further}
    if not names:
        return known
    known = known or Orders({"driveline": "driving end", "planetary": "carrier"}.get(system, "shaft"), {})
    return replace(known, per_turn={**known.per_turn, **names})


def _own_orders(system: str, values: Mapping[str, Any]) -> Orders | None:
    """The orders that follow from the parameters."""
    if system == "bicardan":
        # A joint under an angle and a torque bends the shaft twice a turn.
        discs = any(np.any(values.get(name) or 0.0) for name in ("Ip_A", "Ip_D", "Ip_joint", "rhoIp"))
        planes = any(values.get(name) is not None for name in ("k_A_y", "k_D_y", "k_joint_y"))
        return Orders("shaft", {"order 1": 1.0, "order 2 (joints)": 2.0}, discs, planes)
    if system == "driveline":
        # A joint is excited twice a turn of its input, and less by multiples of it.
        names = {f"order {n * s:.4g} (joints)": n * s for s in joint_speeds(values) for n in (2, 4)}
        return Orders("driving end", names) if names else None
    mesh, angles = values.get("carrier_order"), values.get("planet_angle")
    if system == "planetary" and isinstance(mesh, (int, float)) and angles:
        meshes = {f"mesh order {k}": float(k * mesh) for k in (1, 2, 3)}
        return Orders("carrier", {**meshes, "planet pass": float(len(angles))})
    return None


def stored_orders(attrs: Mapping[str, Any]) -> Orders | None:
    """The orders of a result with these attributes; None if the result is that of one order."""
    options = json.loads(attrs.get("options", "{}"))
    if options.get("order"):
        return None
    known = json.loads(attrs.get("physical_data", "{}")) | json.loads(attrs.get("fixed_parameters", "{}"))
    values = {n: e["value"] for n, e in known.items()}
    return orders_of(str(attrs.get("system")), values, options.get("orders", ()))


def operating_range(options: Mapping[str, Any]) -> tuple[float, float] | None:
    """Lowest and highest operating speed [rpm] of the options of an analysis; None if they are not given."""
    low, high = (options.get(f"operating_{end}", 0.0) for end in ("min", "max"))
    if high < low:
        raise InputError(f"options.operating_max = {high:g}: expected a speed of at least operating_min = {low:g}")
    return (low, high) if high > 0 else None
