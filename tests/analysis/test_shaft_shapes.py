"""Mode shapes of stepped shafts against finite elements: joints, supports and masses of every kind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

import drivetrain_jax as dt
from benchmarks.bicardan_reference import complete, matrices
from drivetrain_jax.analysis.shafts.roots import find_roots
from drivetrain_jax.analysis.shafts.shapes import mode_shapes
from drivetrain_jax.systems import Shaft

INF = math.inf
# Pieces more than modes: no mode of a single span is at rest at all nodes.
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
    # At the joint slope and shear force, scaled, are larger than deflection and moment.
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
    "one joint of three": FOUR | SUPPORTED | {"k_hinge": (INF, 291.0, INF)},
    "hinges over rigid supports": FOUR | SUPPORTED | {"k_hinge": (0.0, 2.0, 0.0), "k_joint": (0.0, INF, 0.0)},
}


def random_shaft(rng: np.random.Generator, segments: int) -> dict:
    """Contrasts to 100, joints and supports of every kind."""

    def stiffness() -> float:
        return float(rng.choice([0.0, INF, *10 ** rng.uniform(-1, 4, 2)]))

    return {
        **{name: 10 ** rng.uniform(-0.5, 0.5, segments) for name in ("length", "EI", "rhoA")},
        **{name: stiffness() for name in ("k_A", "k_D")},
        **{name: [stiffness() for _ in range(segments - 1)] for name in ("k_joint", "k_hinge")},
        "m_joint": rng.choice([0.0, 1.0], segments - 1),
    }


def in_pieces(v: Mapping) -> dict:
    """The same shaft with every segment cut into equal ones, so that it has nodes between its joints."""
    cut = {name: np.repeat(v[name], PIECES) for name in ("length", "EI", "rhoA", "kGA", "rhoI")}
    cut["length"] = cut["length"] / PIECES
    for name, none in (("k_joint", 0.0), ("m_joint", 0.0), ("k_hinge", INF)):
        cut[name] = np.full(len(cut["length"]) - 1, none)
        cut[name][PIECES - 1 :: PIECES] = v[name]
    return dict(v) | cut


def elements(values: Mapping) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [rad/s] of one mode more than ``MODES``, and the deflections at the nodes, modes first."""
    v = in_pieces(complete(values))
    nodes = len(v["length"]) + 1
    rigid = np.isinf(np.r_[v["k_A"], v["k_joint"], v["k_D"]])
    springs = {name: np.where(np.isinf(v[name]), 0.0, v[name]) for name in ("k_A", "k_joint", "k_D")}
    K, M = matrices(v | springs, 4)
    kept = np.r_[~rigid, np.ones(len(K) - nodes, bool)]
    K, M = K[np.ix_(kept, kept)], M[np.ix_(kept, kept)]
    stiff = K + M
    inverse, vectors = eigh(M, stiff, subset_by_index=[len(M) - MODES - 1, len(M) - 1])
    shapes = np.zeros((MODES + 1, nodes))
    shapes[:, ~rigid] = vectors[: np.count_nonzero(~rigid), ::-1].T
    return np.sqrt(np.maximum(1 / inverse[::-1] - 1, 0.0)), shapes[:MODES]


def everything(values: Mapping) -> Shaft:
    """The shaft with every field present, so that shafts of one number of segments share a kernel."""
    v = complete(values)
    k, m = (np.r_[v[f"{what}_A"], v[f"{what}_joint"], v[f"{what}_D"]] for what in ("k", "m"))
    return Shaft(v["length"], v["EI"], v["rhoA"], k, m, v["k_hinge"], v["kGA"], v["rhoI"])


def places(values: Mapping) -> np.ndarray:
    lengths = in_pieces(complete(values))["length"]
    return np.concatenate([[0.0], np.cumsum(lengths)]) / np.sum(lengths)


@jax.jit
@partial(jax.vmap, in_axes=(0, 0))
def solve(shaft: Shaft, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    q = find_roots(shaft.arrays(), MODES).q
    return q * q, mode_shapes(shaft.arrays(), jnp.where(q > 0, q, 1.0), x)


def compare(shafts: Mapping[str, Mapping], tolerance: float) -> int:
    """Compares all modes but those of frequency 0 and those whose frequency is nearly that of a neighbour; their
    number."""
    shapes = [everything(values) for values in shafts.values()]
    batch = jax.tree.map(lambda *fields: jnp.stack(fields), *shapes)
    p, found = (np.asarray(x) for x in solve(batch, jnp.stack([jnp.asarray(places(v)) for v in shafts.values()])))
    compared = 0
    for i, (name, values) in enumerate(shafts.items()):
        frequencies, expected = elements(values)
        for j in range(MODES):
            apart = np.abs(np.delete(frequencies, j) - frequencies[j]).min() > 1e-3 * frequencies[j]
            if p[i, j] == 0 or not apart:
                continue
            assert abs(p[i, j] / frequencies[j] - 1) < 1e-6, (name, j)
            shape = expected[j] / expected[j][np.argmax(np.abs(expected[j]))]
            error = min(np.abs(found[i, j] - shape).max(), np.abs(found[i, j] + shape).max())
            assert error < tolerance, (name, j, error)
            compared += 1
    return compared


@pytest.mark.parametrize("segments", [2, 4])
def test_shapes_against_finite_elements(segments):
    """Named cases and random ones: the amplitude and the sign of every part."""
    rng = np.random.default_rng(segments)
    shafts = {name: values for name, values in CASES.items() if len(values["length"]) == segments}
    named = len(shafts)
    shafts |= {f"random {i}": random_shaft(rng, segments) for i in range(20)}
    assert compare(shafts, 1e-6) > 4 * 20 + 2 * named


def test_deflection_is_continuous_at_an_elastic_joint():
    values = CASES["elastic joint between unlike segments"]
    shapes = dt.point(
        "bicardan", "critical_speeds", outputs=["mode_shape"], modes=2, stations=10001, **values
    ).mode_shape
    assert np.abs(np.diff(shapes, axis=1)).max() < 2e-3
