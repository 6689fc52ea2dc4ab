"""Choice of the direct method: error of the Floquet multipliers against evaluations of H and against time.

    python -m benchmarks.work_precision      # writes results/work_precision_cardan.csv and .png

Every candidate integrates the half-period form (docs/theory/cardan.md) with fixed steps; rho and the multipliers are
compared with the 200-bit reference. The figure shows the multipliers, not rho: where all multipliers lie on one circle,
damping alone determines rho, and a method that keeps quadratic invariants gets rho right with entirely wrong phases.

Explicit: the 12 stages of DOP853 in the clocks

    tau    the joint's own rotation
    chi    tan(chi) = sqrt(c) tan(tau),             c = cos(beta)
    psi    tan(2 chi) = kappa tan(2 psi),           kappa^2 = 1 - r^2, r = tan(beta/2)^2  (the same step once more)

Implicit, in psi: Gauss-Legendre collocation with 8 and 12 stages and Radau IIA collocation with 8. Times are per
point in a compiled batch of ``LANES`` copies of the point on one thread pool, so they compare methods, not machines.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.integrate import DOP853

from benchmarks.timing import parser, provenance, results_folder, write_csv
from tests.oracles.cardan_reference import NAMES

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

REFERENCE = Path(__file__).parents[1] / "tests" / "reference" / "cardan.json"
# Typical, slow, low-speed, wide tongue, next to pi/2, stiff: indices in the reference.
POINTS = (3, 4, 9, 12, 14, 28)
LANES = 128
LADDER = (1, 2, 3, 4, 6, 8, 11, 16, 22, 32, 45, 64, 90, 128, 256, 512, 1024)
MOST_EVALUATIONS, SPENT = 6_144, 0.2
REVERSOR = np.kron(np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(2))

Values = dict[str, Any]
Clock = Callable[[Any, Any], tuple[Any, Any, Any]]


def clock_tau(x: Any, beta: Any) -> tuple[Any, Any, Any]:
    """``(eta, d eta/dx, d tau/dx)`` for x = tau; the denominators of all clocks are sums of positive terms."""
    c, sine, cosine = jnp.cos(beta), jnp.sin(x), jnp.cos(x)
    d = cosine**2 + c**2 * sine**2
    return c / d, c * jnp.sin(beta) ** 2 * 2 * sine * cosine / d**2, jnp.ones_like(d)


def _from_chi(cos2: Any, sin2: Any, rate: Any, beta: Any) -> tuple[Any, Any, Any]:
    c = jnp.cos(beta)
    large = (1 + jnp.abs(cos2)) / 2
    small = sin2**2 / (4 * large)
    cosine2, sine2 = jnp.where(cos2 > 0, large, small), jnp.where(cos2 > 0, small, large)
    upper, lower = c * cosine2 + sine2, cosine2 + c * sine2
    return upper / lower, jnp.sin(beta) ** 2 * sin2 / lower**2 * rate, jnp.sqrt(c) / upper * rate


def clock_chi(x: Any, beta: Any) -> tuple[Any, Any, Any]:
    """As :func:`clock_tau` for x = chi."""
    return _from_chi(jnp.cos(2 * x), jnp.sin(2 * x), 1.0, beta)


def clock_psi(x: Any, beta: Any) -> tuple[Any, Any, Any]:
    """As :func:`clock_tau` for x = psi."""
    c, r = jnp.cos(beta), jnp.tan(beta / 2) ** 2
    kappa = jnp.sqrt(2 * c / (1 + c) * (1 + r))
    cosine, sine = jnp.cos(2 * x), kappa * jnp.sin(2 * x)
    d = jnp.sqrt(cosine**2 + sine**2)
    return _from_chi(cosine / d, sine / d, kappa / d**2, beta)


def h_rows(clock: Clock, x: Any, v: Values) -> list[list[Any]]:
    """``H`` of (q, Omega p)' = H (q, Omega p) in the clock's time, as nested rows of shape ``(N,)``."""
    eta, deta, w = clock(x, v["beta"])
    s, g = 1 / v["Omega"], v["gamma"] ** -0.5
    zeta, alpha, mu = v["zeta"], v["alpha"], v["mu"]
    w11, w12, w22 = 1 + alpha * eta**2, -alpha * g * eta, alpha * g**2
    v11, v12, v22 = 1 + mu * eta**2, -mu * g * eta, mu * g**2
    sw, twist = s * w, alpha * zeta * g * deta
    k11 = sw * (zeta**2 * (w11**2 + w12**2) - v11)
    k12 = sw * (zeta**2 * w12 * (w11 + w22) - v12)
    k22 = sw * (zeta**2 * (w12**2 + w22**2) - v22)
    d11, d12, d22, zero = -zeta * sw * w11, -zeta * sw * w12, -zeta * sw * w22, jnp.zeros_like(sw)
    return [[d11, d12, sw, zero], [d12, d22, zero, sw], [k11, k12 - twist, d11, d12], [k12 + twist, k22, d12, d22]]


def explicit(clock: Clock) -> Callable[[Values, Any], Any]:
    """Half-period propagator ``(4, 4, N)`` by ``n`` equal steps of DOP853's stages."""
    a, b, c = DOP853.A, DOP853.B, DOP853.C

    def propagate(v: Values, n: Any) -> Any:
        h = jnp.pi / 2 / n

        def step(i: Any, y: list[Any]) -> list[Any]:
            slopes: list[list[Any]] = []
            for j in range(12):
                stage = [y[m] + h * sum(float(a[j, k]) * slopes[k][m] for k in range(j) if a[j, k]) for m in range(4)]
                rows = h_rows(clock, (i + c[j]) * h, v)
                slopes.append([sum(e * s for e, s in zip(row, stage, strict=True)) for row in rows])
            return [y[m] + h * sum(float(b[k]) * slopes[k][m] for k in range(12) if b[k]) for m in range(4)]

        start = [jnp.zeros((4, v["beta"].size)).at[m].set(1.0) for m in range(4)]
        return jnp.stack(jax.lax.fori_loop(0, n, step, start))

    return propagate


def gauss_nodes(stages: int) -> np.ndarray:
    """Gauss-Legendre nodes on [0, 1]: order 2 ``stages``, A-stable."""
    return (np.polynomial.legendre.leggauss(stages)[0] + 1) / 2


def radau_nodes(stages: int) -> np.ndarray:
    """Radau IIA nodes on (0, 1], the zeros of P_s - P_(s-1): order 2 ``stages`` - 1, L-stable."""
    basis = np.polynomial.legendre.Legendre.basis
    return (np.sort((basis(stages) - basis(stages - 1)).roots().real) + 1) / 2


def collocation(clock: Clock, nodes: np.ndarray) -> Callable[[Values, Any], Any]:
    """Half-period propagator ``(4, 4, N)`` by ``n`` equal panels of collocation at ``nodes``."""
    stages = len(nodes)
    x, weights = np.polynomial.legendre.leggauss(stages)
    lagrange = [np.prod([(s - nodes[k]) / (nodes[j] - nodes[k]) for k in range(stages) if k != j], axis=0)
                for s in [(np.append(nodes, 1.0)[:, None] * (x + 1) / 2)] for j in range(stages)]  # fmt: skip
    integrals = np.stack([(values @ weights) / 2 * np.append(nodes, 1.0) for values in lagrange], axis=-1)
    a, b = integrals[:-1], integrals[-1]

    def propagate(v: Values, n: Any) -> Any:
        h, lanes = jnp.pi / 2 / n, v["beta"].size

        def panel(i: Any, y: Any) -> Any:
            at_nodes = jax.vmap(lambda t: jnp.stack([jnp.stack(row) for row in h_rows(clock, t, v)]))((i + nodes) * h)
            system = jnp.eye(4 * stages) - jnp.einsum("ij,jklN->Nikjl", h * a, at_nodes).reshape(
                lanes, 4 * stages, 4 * stages
            )
            values = jnp.linalg.solve(
                system, jnp.broadcast_to(jnp.tile(jnp.eye(4), (stages, 1)), (lanes, 4 * stages, 4))
            )
            slopes = jnp.einsum("jklN,Njlm->Njkm", at_nodes, values.reshape(lanes, stages, 4, 4))
            return (jnp.eye(4) + h * jnp.einsum("j,Njkm->Nkm", b, slopes)) @ y

        return jnp.moveaxis(jax.lax.fori_loop(0, n, panel, jnp.broadcast_to(jnp.eye(4), (lanes, 4, 4))), 0, -1)

    return propagate


@dataclass(frozen=True)
class Candidate:
    """A method and the number of evaluations of H that one of its steps takes."""

    label: str
    propagate: Callable[[Values, Any], Any]
    evaluations: int
    style: str


CANDIDATES = (
    Candidate("DOP853, tau", explicit(clock_tau), 12, "o-"),
    Candidate("DOP853, chi", explicit(clock_chi), 12, "s-"),
    Candidate("DOP853, psi", explicit(clock_psi), 12, "D-"),
    Candidate("Gauss 8, psi", collocation(clock_psi, gauss_nodes(8)), 8, "^--"),
    Candidate("Gauss 12, psi", collocation(clock_psi, gauss_nodes(12)), 12, "v--"),
    Candidate("Radau IIA 8, psi", collocation(clock_psi, radau_nodes(8)), 8, "x--"),
)


def check_clock() -> float:
    """Largest difference between this module's H in psi and the package's reduced form, relative to H."""
    from drivetrain_jax.systems.cardan import Cardan

    values = {"beta": 1.3, "Omega": 0.4, "zeta": 0.2, "alpha": 3.0, "mu": 5.0, "gamma": 7.0}
    ours = np.array(h_rows(clock_psi, 0.4, values))
    return float(
        np.abs(ours - np.asarray(Cardan.of(values).floquet_model().reduced.matrix(0.4))).max() / np.abs(ours).max()
    )


def measure(indices: Sequence[int]) -> list[dict[str, Any]]:
    """One row per candidate, point and number of steps; a method stops once its error no longer falls."""
    points = json.loads(REFERENCE.read_text())["points"]
    rows = []
    for candidate in CANDIDATES:
        example = {name: jnp.full(LANES, float(points[0][name])) for name in NAMES}
        compiled = jax.jit(candidate.propagate).lower(example, jnp.int64(1)).compile()
        for index in indices:
            point = points[index]
            lanes = {name: jnp.full(LANES, float(point[name])) for name in NAMES}
            for steps in (n for n in LADDER if n * candidate.evaluations <= MOST_EVALUATIONS):
                phi, seconds = _timed(compiled, lanes, steps)
                rho_error, error = _errors(phi[..., 0], point)
                rows.append(
                    {"method": candidate.label, "point": index, **{name: float(point[name]) for name in NAMES}}
                    | {"steps": steps, "evaluations": steps * candidate.evaluations}
                    | {"microseconds": 1e6 * seconds / LANES, "rho_error": rho_error, "error": error}
                )
                if error < 2e-14:
                    break
    return rows


def _errors(phi: np.ndarray, point: Values) -> tuple[float, float]:
    """Relative error of rho, and largest distance of a multiplier from its partner in the reference, over rho."""
    if not np.abs(phi).max() < 1e150:
        return np.inf, np.inf
    ours = np.linalg.eigvals(REVERSOR @ phi.T @ REVERSOR @ phi)
    exact = np.array([complex(float(re), float(im)) for re, im in point["multipliers"]])
    distances = np.abs(ours[:, None] - exact)
    pairing = min(distances[list(order), range(4)].max() for order in permutations(range(4)))
    rho = float(point["rho"])
    return abs(float(np.abs(ours).max()) / rho - 1), float(pairing / rho)


def _timed(compiled: Any, lanes: Values, steps: int) -> tuple[np.ndarray, float]:
    seconds: list[float] = []
    while len(seconds) < 5 and sum(seconds) < SPENT:
        start = time.perf_counter()
        phi = compiled(lanes, jnp.int64(steps)).block_until_ready()
        seconds.append(time.perf_counter() - start)
    return np.asarray(phi), min(seconds)


def cheapest(rows: list[dict[str, Any]], tolerance: float = 1e-9) -> list[dict[str, Any]]:
    """Evaluations and time of every method at every point from which on the error stays below ``tolerance``."""
    table = []
    for index in dict.fromkeys(row["point"] for row in rows):
        line: dict[str, Any] = {"point": index}
        for candidate in CANDIDATES:
            mine = [row for row in rows if row["method"] == candidate.label and row["point"] == index]
            bad = [i for i, row in enumerate(mine) if not row["error"] <= tolerance]
            first = bad[-1] + 1 if bad else 0
            good = mine[first] if first < len(mine) else None
            line[candidate.label] = f"{good['evaluations']} / {good['microseconds']:.1f}" if good else "-"
        table.append(line)
    return table


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw error against evaluations (top) and against time (bottom), one column per point."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    indices = list(dict.fromkeys(row["point"] for row in rows))
    figure, axes = plt.subplots(
        2, len(indices), figsize=(3 * len(indices), 7.2), sharey=True, squeeze=False, layout="constrained"
    )
    for column, index in enumerate(indices):
        point = next(row for row in rows if row["point"] == index)
        for candidate in CANDIDATES:
            mine = [row for row in rows if row["method"] == candidate.label and row["point"] == index]
            error = [max(row["error"], 1e-16) if row["error"] < 1e3 else np.nan for row in mine]
            for ax, key in ((axes[0, column], "evaluations"), (axes[1, column], "microseconds")):
                ax.loglog([row[key] for row in mine], error, candidate.style, ms=4, lw=1, label=candidate.label)
        axes[0, column].set_title(
            f"beta {point['beta']:g}, Omega {point['Omega']:g}, zeta {point['zeta']:g}", fontsize=10
        )
        axes[0, column].set_xlabel("evaluations of H")
        axes[1, column].set_xlabel("time per point / us")
        for ax in axes[:, column]:
            ax.axhline(1e-9, color="0.6", lw=0.8)
            ax.set_ylim(3e-17, 30)
            ax.grid(alpha=0.25)
            ax.xaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].set_ylabel("error of the multipliers / rho")
    axes[1, 0].set_ylabel("error of the multipliers / rho")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(CANDIDATES), frameon=False
    )
    facts = provenance()
    figure.suptitle(f"{facts['machine']}; {facts['versions']}; {facts['date']}", fontsize=7, color="0.4")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write the CSV and the figure, and print the cost at which every method reaches 1e-9."""
    options = parser(__doc__).parse_args(arguments)
    difference = check_clock()
    if difference > 1e-13:
        raise RuntimeError(f"the benchmark's H differs from the package's by {difference:.1e}")
    rows = measure(POINTS[:2] if options.quick else POINTS)
    about = "error: of the multipliers over rho; rho_error: |rho/reference - 1|"
    note = f"{about}; time per point of {LANES}, best of up to 5 that start within {SPENT:g} s"
    folder = results_folder(options)
    write_csv(folder / "work_precision_cardan.csv", rows, [note])
    draw(rows, folder / "work_precision_cardan.png")
    summary = cheapest(rows)
    print("evaluations / microseconds from which the error of the multipliers stays below 1e-9 rho")
    for line in summary:
        print("  ".join(f"{key} {value}" for key, value in line.items()))


if __name__ == "__main__":
    main()
