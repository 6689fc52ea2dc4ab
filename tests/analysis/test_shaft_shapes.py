"""Mode shapes of stepped shafts against finite elements: joints, supports and masses of every kind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp
from scipy.linalg import eigh

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots
from drivetrain_jax.analysis.critical_speeds.shapes import mode_shapes
from drivetrain_jax.systems import Shaft
from tests.oracles.bicardan_reference import complete, matrices

INF = math.inf
# More pieces per segment than modes, so that no mode of a single span is at rest at all nodes.
MODES, PIECES = 5, 7
SUPPORTED = {"k_A": INF, "k_D": INF}
EQUAL = {"length": (1.0, 1.0), "EI": (1.0, 1.0), "rhoA": (1.0, 1.0)}
FOUR = {"length": (1.0,) * 4, "EI": (1.0,) * 4, "rhoA": (1.0,) * 4}
SHEAR = {"kGA": (20.0, 400.0), "rhoI": (0.01, 0.03)}
CASES = {
    "elastic joint between unlike segments": EQUAL | SUPPORTED | {"EI": (1.0, 16.0), "k_hinge": 1.0},
    "hinge between unlike segments": EQUAL | {"rhoA": (1.0, 9.0), "k_A": 50.0, "k_D": 80.0, "k_hinge": 0.0},
    "elastic joint on a rigid support": EQUAL | SUPPORTED | {"k_hinge": 1.0, "k_joint": INF},
    "soft joint on a rigid support": EQUAL | SUPPORTED | {"k_hinge": 0.1, "k_joint": INF},
    "stiff joint on a rigid support": EQUAL | SUPPORTED | {"k_hinge": 10.0, "k_joint": INF},
    "rigid joint on a rigid support": EQUAL | SUPPORTED | {"k_hinge": INF, "k_joint": INF},
    "unlike spans on a rigid support": EQUAL | SUPPORTED | {"EI": (1.0, 1.5), "k_hinge": 0.0, "k_joint": INF},
    "hinge on a stiff support": EQUAL | SUPPORTED | {"k_hinge": 0.0, "k_joint": 1e6},
    "hinge with a mass": {
        "length": (0.4018676,) * 2,
        "EI": (0.613,) * 2,
        "rhoA": (0.188,) * 2,
        "k_A": 64.93,
        "k_D": 64.93,
        "k_hinge": 0.0,
        "m_joint": 1.0,
    },
    "elastic joint on a support": EQUAL | SUPPORTED | {"length": (1.498,) * 2, "k_joint": 875.0, "k_hinge": 0.296},
    "Timoshenko": EQUAL | SUPPORTED | SHEAR | {"EI": (1.0, 4.0), "k_hinge": 1.0, "k_joint": 100.0},
    # At the joint the scaled slope and shear force are larger than deflection and moment.
    "soft joint with a heavy mass": EQUAL
    | {
        "EI": (10.0, 10.0),
        "rhoA": (0.1, 10.0),
        "k_A": 0.1,
        "k_joint": 1.0,
        "k_D": INF,
        "m_joint": 100.0,
        "k_hinge": 1.0,
    },
    "soft joint on a stiff support": EQUAL
    | {"EI": (1.0, 0.1), "rhoA": (10.0, 0.1), "k_A": 100.0, "k_joint": 1000.0, "k_D": 0.1, "k_hinge": 0.1},
    "discs at elastic joints": FOUR
    | SUPPORTED
    | {"I_A": 0.3, "I_joint": (0.0, 2.0, 0.5), "I_D": 0.1, "m_joint": (0.0, 1.0, 2.0), "k_hinge": (3.0, 20.0, 0.0)},
    "clamped with a disc": EQUAL | {"k_A": INF, "k_rot_A": INF, "k_D": 0.0, "k_rot_D": 4.0, "I_joint": 1.0, "I_D": 0.2},
    "a segment without mass": FOUR | SUPPORTED | {"rhoA": (1.0, 0.0, 2.0, 0.0), "k_rot_D": INF, "I_joint": 0.1},
    "no mass but discs": FOUR
    | {
        "rhoA": (0.0,) * 4,
        "k_A": 3.0,
        "k_D": 9.0,
        "k_rot_A": 1.0,
        "m_joint": (1.0, 0.5, 2.0),
        "I_joint": (0.1, 0.0, 0.3),
    },
    "shear without mass": EQUAL
    | SUPPORTED
    | SHEAR
    | {"rhoA": (0.0, 1.0), "rhoI": (0.0, 0.03), "I_A": 0.3, "I_joint": 0.2},
    "one joint of three": FOUR | SUPPORTED | {"k_hinge": (INF, 291.0, INF)},
    "hinges over rigid supports": FOUR | SUPPORTED | {"k_hinge": (0.0, 2.0, 0.0), "k_joint": (0.0, INF, 0.0)},
}


def random_shaft(rng: np.random.Generator, segments: int) -> dict:
    """A shaft with contrasts up to 100, and joints and supports of every kind."""

    def stiffness() -> float:
        return float(rng.choice([0.0, INF, *10 ** rng.uniform(-1, 4, 2)]))

    return {
        **{name: 10 ** rng.uniform(-0.5, 0.5, segments) for name in ("length", "EI", "rhoA")},
        **{name: stiffness() for name in ("k_A", "k_D")},
        **{name: [stiffness() for _ in range(segments - 1)] for name in ("k_joint", "k_hinge")},
        "m_joint": rng.choice([0.0, 1.0], segments - 1),
    }


def random_discs(rng: np.random.Generator, segments: int) -> dict:
    """The same with rotary inertias, rotational springs, and segments without mass."""
    shaft = random_shaft(rng, segments)
    return shaft | {
        "rhoA": shaft["rhoA"] * rng.choice([0.0, 1.0, 1.0], segments),
        **{name: float(rng.choice([0.0, INF, 10 ** rng.uniform(-1, 2)])) for name in ("k_rot_A", "k_rot_D")},
        **{name: float(rng.choice([0.0, 10 ** rng.uniform(-2, 1)])) for name in ("I_A", "I_D")},
        "I_joint": rng.choice([0.0, 1.0], segments - 1) * 10 ** rng.uniform(-2, 1, segments - 1),
        # Every node moves mass, so that every mechanism has a frequency.
        "m_joint": 10 ** rng.uniform(-1, 1, segments - 1),
        "m_A": 0.1,
        "m_D": 0.2,
    }


def in_pieces(v: Mapping) -> dict:
    """The same shaft with every segment cut into equal pieces, so that it has nodes between its joints."""
    cut = {name: np.repeat(v[name], PIECES) for name in ("length", "EI", "rhoA", "kGA", "rhoI")}
    cut["length"] = cut["length"] / PIECES
    for name, none in (("k_joint", 0.0), ("m_joint", 0.0), ("I_joint", 0.0), ("k_hinge", INF)):
        cut[name] = np.full(len(cut["length"]) - 1, none)
        cut[name][PIECES - 1 :: PIECES] = v[name]
    return dict(v) | cut


def elements(values: Mapping) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [rad/s] of ``MODES + 1`` modes and deflections at the nodes, modes first, by finite elements."""
    v = in_pieces(complete(values))
    nodes = len(v["length"]) + 1
    rigid = np.isinf(np.r_[v["k_A"], v["k_joint"], v["k_D"]])
    K, M = matrices(v, 4)
    stiff = K + M
    inverse, vectors = eigh(M, stiff, subset_by_index=[len(M) - MODES - 1, len(M) - 1])
    shapes = np.zeros((MODES + 1, nodes))
    shapes[:, ~rigid] = vectors[: np.count_nonzero(~rigid), ::-1].T
    return np.sqrt(np.maximum(1 / inverse[::-1] - 1, 0.0)), shapes[:MODES]


def everything(values: Mapping) -> Shaft:
    """The shaft with every field present, so that shafts with the same number of segments share a kernel."""
    v = complete(values)
    k, m = (np.r_[v[f"{what}_A"], v[f"{what}_joint"], v[f"{what}_D"]] for what in ("k", "m"))
    inertia = np.r_[v["I_A"], v["I_joint"], v["I_D"]]
    k_rot = np.r_[v["k_rot_A"], np.zeros(len(v["k_joint"])), v["k_rot_D"]]
    return Shaft(v["length"], v["EI"], v["rhoA"], k, m, v["k_hinge"], v["kGA"], v["rhoI"], k_rot, inertia)


def places(values: Mapping) -> np.ndarray:
    lengths = in_pieces(complete(values))["length"]
    return np.concatenate([[0.0], np.cumsum(lengths)]) / np.sum(lengths)


@jax.jit
@partial(jax.vmap, in_axes=(0, 0))
def solve(shaft: Shaft, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    q = find_roots(shaft.arrays(), MODES).q
    return q * q, mode_shapes(shaft.arrays(), jnp.where(q > 0, q, 1.0), x)


def compare(shafts: Mapping[str, Mapping], tolerance: float) -> int:
    """Compare all modes except those of frequency 0 and those close to a neighbour; return the number of compared modes."""
    shapes = [everything(values) for values in shafts.values()]
    batch = jax.tree.map(lambda *fields: jnp.stack(fields), *shapes)
    p, found = (np.asarray(x) for x in solve(batch, jnp.stack([jnp.asarray(places(v)) for v in shafts.values()])))
    compared = 0
    for i, (name, values) in enumerate(shafts.items()):
        frequencies, expected = elements(values)
        for j in range(MODES):
            apart = np.abs(np.delete(frequencies, j) - frequencies[j]).min() > 1e-3 * frequencies[j]
            if p[i, j] == 0 or not apart or np.isinf(p[i, j]):
                continue
            assert abs(p[i, j] / frequencies[j] - 1) < 1e-6, (name, j)
            shape = expected[j] / expected[j][np.argmax(np.abs(expected[j]))]
            error = min(np.abs(found[i, j] - shape).max(), np.abs(found[i, j] + shape).max())
            assert error < tolerance, (name, j, error)
            compared += 1
    return compared


@pytest.mark.parametrize("segments", [2, pytest.param(4, marks=pytest.mark.full)])
@pytest.mark.full
def test_shapes_against_finite_elements(segments):
    """Amplitude and sign of every part, for named and for random cases."""
    rng = np.random.default_rng(segments)
    shafts = {name: values for name, values in CASES.items() if len(values["length"]) == segments}
    named = len(shafts)
    shafts |= {f"random {i}": random_shaft(rng, segments) for i in range(20)}
    shafts |= {f"random discs {i}": random_discs(rng, segments) for i in range(20)}
    assert compare(shafts, 1e-6) > 4 * 40 + 2 * named


UNLIKE = {"length": (1.0, 0.7, 1.3), "EI": (1.0, 2.0, 0.6), "rhoA": (1.0, 0.8, 1.7)}
WEAK = {
    "hinges on stiff supports": UNLIKE | {"k_A": 20.0, "k_D": 30.0, "k_joint": (1e6, 3e5), "k_hinge": 0.0},
    "nearly hinges on rigid supports": UNLIKE | SUPPORTED | {"k_joint": INF, "k_hinge": (1e-5, 1e-4)},
    "hinges on rigid supports": UNLIKE
    | {"k_A": 4e5, "k_D": 0.4, "m_joint": (6.0, 0.3), "k_joint": INF, "k_hinge": 0.0},
    "all kinds, with shear": UNLIKE
    | {"kGA": (20.0, 5.0, 90.0), "rhoI": (0.01, 0.3, 0.03), "k_A": 20.0, "k_D": 21.0, "m_D": 0.2}
    | {"k_joint": (6e4, INF), "k_hinge": (0.0, 8e-4), "m_joint": (0.0, 2.0)},
    "discs, clamped, a segment without mass": UNLIKE
    | {"rhoA": (1.0, 0.0, 1.7), "I_D": 0.3, "I_joint": (0.2, 1e3), "k_hinge": (0.1, 3e4)}
    | {"k_A": INF, "k_rot_A": INF, "k_D": 2.0, "k_rot_D": 1.0},
}


def exact_segment(v: Mapping, i: int, p: mp.mpf, x: mp.mpf) -> mp.matrix:
    """Transfer matrix of the state (f, theta, M, F) over the length x of segment i: cubic in the matrix of (1)."""
    EI, mass, rotary = (mp.mpf(v[name][i]) * scale for name, scale in (("EI", 1), ("rhoA", p * p), ("rhoI", p * p)))
    shear = 1 / mp.mpf(v["kGA"][i])
    A = mp.matrix([[0, 1, 0, shear], [0, 0, -1 / EI, 0], [0, rotary, 0, 1], [-mass, 0, 0, 0]])
    if mass == 0:
        return mp.eye(4) + x * A + x**2 / 2 * A**2 + x**3 / 6 * A**3
    half, product = (mass * shear + rotary / EI) / 2, mass / EI - mass * shear * rotary / EI
    root = mp.sqrt(half * half + product)
    a, b = mp.sqrt(root - half), mp.sqrt(root + half)
    even, odd = (mp.cosh(a * x), mp.cos(b * x)), (mp.sinh(a * x) / a, mp.sin(b * x) / b)
    total = [((b * b * h + a * a * t) / (2 * root), (h - t) / (2 * root)) for h, t in (even, odd)]
    (c0, c2), (c1, c3) = (tuple(mp.re(c) for c in pair) for pair in total)
    return c0 * mp.eye(4) + c1 * A + c2 * A**2 + c3 * A**3


def exact_node(v: Mapping, i: int, p: mp.mpf) -> mp.matrix:
    """Transfer matrix of joint and support in front of segment i, or of the end; rigid and hinged to 30 digits."""
    k, m = (np.r_[v[f"{what}_A"], v[f"{what}_joint"], v[f"{what}_D"]][i] for what in ("k", "m"))
    inner = 0 < i < len(v["length"])
    turns = mp.mpf(v["k_hinge"][i - 1]) if inner else mp.inf
    k_rot = mp.mpf(0 if inner else v["k_rot_A" if i == 0 else "k_rot_D"])
    hinge, support, turned = mp.eye(4), mp.eye(4), mp.eye(4)
    hinge[1, 2], support[3, 0] = -1 / max(turns, mp.mpf("1e-30")), min(mp.mpf(k), mp.mpf("1e30")) - p * p * mp.mpf(m)
    inertia = mp.mpf(np.r_[v["I_A"], v["I_joint"], v["I_D"]][i])
    # Half of it on each side of the joint; at an end both halves turn together.
    turned[2, 1] = (p * p * inertia - min(k_rot, mp.mpf("1e30"))) / 2
    return support * turned * hinge * turned


def exact_shape(v: Mapping, p: float, x: np.ndarray) -> np.ndarray:
    """The mode near the angular frequency ``p`` at ``x`` in [0, 1] by plain transfer matrices, in 260 digits."""
    lengths = [mp.mpf(length) for length in v["length"]]
    ends = [mp.fsum(lengths[:i]) for i in range(len(lengths) + 1)]

    def from_a(p: mp.mpf) -> list[mp.matrix]:
        states = [exact_node(v, 0, p)[:, :2]]
        for i, length in enumerate(lengths):
            states.append(exact_node(v, i + 1, p) * (exact_segment(v, i, p, length) * states[-1]))
        return states

    def determinant(p: mp.mpf) -> mp.mpf:
        return mp.det(from_a(p)[-1][2:, :])

    with mp.workdps(260):
        guess = mp.mpf(p)
        p = mp.findroot(determinant, (guess * (1 - mp.mpf("1e-15")), guess * (1 + mp.mpf("1e-15"))), verify=False)
        states = from_a(p)
        mode = mp.matrix([states[-1][2, 1], -states[-1][2, 0]])
        part = np.searchsorted(np.array(ends[1:-1], float), x * float(ends[-1]))
        shape = [
            (exact_segment(v, i, p, mp.mpf(place) * ends[-1] - ends[i]) * (states[i] * mode))[0]
            for i, place in zip(part, x, strict=True)
        ]
        return np.array([float(f / max(shape, key=abs)) for f in shape])


@pytest.mark.full
@pytest.mark.parametrize("name", WEAK)
def test_shapes_of_weakly_coupled_parts(name):
    """Parts that hardly move, or are at rest, are accurate to the rounding of the largest deflection."""
    values = complete(WEAK[name])
    x = np.linspace(0.0, 1.0, 41)
    p, found = (np.asarray(y) for y in solve(*(jax.tree.map(lambda y: y[None], (everything(values), jnp.asarray(x))))))
    for j in range(MODES):
        expected = exact_shape(values, p[0, j], x)
        assert min(np.abs(found[0, j] - expected).max(), np.abs(found[0, j] + expected).max()) < 1e-12, j


@pytest.mark.full
def test_a_mode_that_turns_without_deflection():
    """Between hinges on rigid supports theta is constant and f = 0 at p^2 = kGA/rhoI; the shape is exactly 0."""
    span = EQUAL | SUPPORTED | {"kGA": (20.0, 50.0), "rhoI": (0.2, 0.01), "k_hinge": 0.0, "k_joint": INF}
    answer = dt.point("bicardan", "critical_speeds", outputs=["angular_frequency", "mode_shape"], **span)
    turning = np.abs(answer.angular_frequency - math.sqrt(20.0 / 0.2)) < 1e-9
    assert np.count_nonzero(turning) == 1
    np.testing.assert_allclose(np.abs(answer.mode_shape).max(axis=1), np.where(turning, 0.0, 1.0), rtol=1e-15)


HINGED = {"k_A": INF, "k_D": INF, "k_joint": INF, "k_hinge": 0.0}


def shapes_of(modes: int, stations: int, **shaft: Any) -> np.ndarray:
    outputs = ["angular_frequency", "mode_shape"]
    found = dt.critical_speeds(dt.Bicardan(**shaft), modes=modes, stations=stations, outputs=outputs)
    return np.asarray(found.mode_shape)


@pytest.mark.full
@pytest.mark.parametrize("spans", [2, 3, 4])
@pytest.mark.parametrize("support", [{}, {"k_joint": 1e25, "k_hinge": 1e-20}], ids=["exact", "almost"])
def test_each_mode_of_a_multiple_frequency_moves_one_span(spans, support):
    """Sine waves in one span each: linearly independent, orthogonal in the mass."""
    shaft = {"length": (0.5,) * spans, "EI": (2e4,) * spans, "rhoA": (5.0,) * spans, **HINGED, **support}
    found = shapes_of(2 * spans, 30 * spans + 1, **shaft)
    x = np.linspace(0.0, spans, 30 * spans + 1)
    moved = [int(x[np.abs(shape).argmax()]) for shape in found]
    assert sorted(moved[:spans]) == sorted(moved[spans:]) == list(range(spans))
    for number, (span, shape) in enumerate(zip(moved, found, strict=True)):
        waves = 1 + number // spans
        expected = np.where((x >= span) & (x <= span + 1), np.sin(waves * np.pi * x), 0.0)
        expected *= np.sign(expected @ shape) / np.abs(expected).max()
        assert np.abs(shape - expected).max() < 1e-12, number


@pytest.mark.full
def test_modes_of_a_frequency_that_parts_share_with_their_neighbours():
    """Three spans of one frequency with shear and rotary inertia, the middle one in two segments of another make."""
    shaft = {"length": (0.5, 0.25, 0.25, 0.5), "EI": (2e4,) * 4, "rhoA": (5.0,) * 4, "kGA": 1e7, "rhoI": 1e-3}
    joints = {"k_joint": (INF, 0.0, INF), "k_hinge": (0.0, INF, 0.0)}
    found = shapes_of(3, 91, **shaft, **HINGED | joints)
    moved = [[np.abs(part).max() > 1e-10 for part in (s[:30], s[31:60], s[61:])] for s in found]
    assert sorted(moved) == np.eye(3, dtype=bool)[::-1].tolist()


@pytest.mark.parametrize("more", [0.0, 1e-8])
@pytest.mark.full
def test_a_disc_that_moves_and_turns_at_one_frequency(more):
    """With I = m l^2/4, 48 EI/(m l^3) = 12 EI/(I l): both modes are mixtures, orthogonal in the mass of the disc. With a
    little more inertia the disc turns at a lower frequency than it moves."""
    disc = {"m_joint": 10.0, "I_joint": 2.5 * (1 + more), "k_A": INF, "k_D": INF}
    found = shapes_of(2, 2001, length=(0.5, 0.5), EI=(2e4, 2e4), rhoA=(0.0, 0.0), **disc)
    deflection, slope = found[:, 1000], np.gradient(found[:, :1001], 1 / 2000, axis=1, edge_order=2)[:, -1]
    mass = 10.0 * np.outer(deflection, deflection) + 2.5 * np.outer(slope, slope)
    assert abs(mass[0, 1]) < 1e-5 * math.sqrt(mass[0, 0] * mass[1, 1])
    x = np.linspace(0.0, 1.0, 2001)
    half = np.minimum(x, 1 - x)
    moves, turns = 3 * half - 4 * half**3, np.sign(0.5 - x) * (half - 4 * half**3)
    basis = np.stack([moves, turns / np.abs(turns).max()])
    rest = found - np.linalg.lstsq(basis.T, found.T, rcond=None)[0].T @ basis
    assert np.abs(rest).max() < 1e-7 and (not more or np.abs(np.abs(found) - np.abs(basis[::-1])).max() < 1e-4)
