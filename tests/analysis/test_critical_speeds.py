"""Critical speeds of stepped shafts against high-precision values, closed forms and finite elements."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax.analysis.critical_speeds.analysis import separation_margin
from drivetrain_jax.analysis.critical_speeds.compound import characteristic, compound, general
from drivetrain_jax.analysis.critical_speeds.frequency_roots import find_roots, relative_error
from drivetrain_jax.analysis.critical_speeds.mechanisms import zero_modes
from drivetrain_jax.systems import Shaft
from drivetrain_jax.systems.bicardan import PRESETS, Bicardan
from tests.oracles.bicardan_reference import complete, finite_elements

CASES = json.loads((Path(__file__).parents[1] / "reference" / "bicardan.json").read_text())
PAPER = PRESETS["paper"]


@jax.jit
def thirty(shafts: Shaft):
    roots = find_roots(shafts, 30)
    return roots, relative_error(shafts, roots), zero_modes(shafts)


@jax.jit
def eight(shafts: Shaft):
    return find_roots(shafts, 8), zero_modes(shafts)


def lanes(parameters: list[Mapping]) -> Shaft:
    """Shafts with the same number of segments as lanes."""
    values = [complete(p) for p in parameters]

    def column(name: str) -> np.ndarray:
        return np.stack([v[name] for v in values], axis=-1)

    k = np.vstack([column("k_A")[None], column("k_joint"), column("k_D")[None]])
    return Shaft(column("length"), column("EI"), column("rhoA"), k).arrays()


def named(case: Mapping) -> dict:
    names = {"length": "l", "EI": "EI", "rhoA": "rhoA", "k_A": "kA", "k_D": "kD"}
    return {name: case[key] for name, key in names.items()}


@pytest.fixture(scope="module")
def solved() -> dict[str, tuple]:
    """By case: p, flags of certified modes, estimated error, number of zero modes."""
    results = {}
    for segments in {len(case["l"]) for case in CASES.values()}:
        names = [name for name, case in CASES.items() if len(case["l"]) == segments]
        roots, error, zeros = thirty(lanes([named(CASES[name]) for name in names]))
        for i, name in enumerate(names):
            results[name] = tuple(np.asarray(x)[..., i] for x in (roots.q**2, roots.certified, error, zeros))
    return results


@pytest.mark.parametrize("name", CASES)
def test_reference_values(solved, name):
    p, certified, error, zeros = solved[name]
    expected = {int(mode): float(value) for mode, value in CASES[name]["p_rad_per_s"].items()}
    assert certified.all()
    assert zeros == CASES[name]["zero_modes"] and np.all(p[:zeros] == 0.0) and np.all(p[zeros:] > 0)
    for mode, value in expected.items():
        assert abs(p[mode - 1] / value - 1) <= 1e-14, mode
        assert abs(p[mode - 1] / value - 1) <= error[mode - 1], mode
    assert error.max() <= 1e-13


@pytest.mark.full
def test_mode_60_of_closed_forms():
    """Pinned ends: z = n pi. Free ends: cos z ch z = 1, from n = 20 on z = (n + 1/2) pi to the last digit."""
    shafts = Shaft(
        jnp.full((1, 2), 1.3), jnp.full((1, 2), 7.0), jnp.full((1, 2), 0.4), jnp.array([[jnp.inf, 0.0], [jnp.inf, 0.0]])
    )
    z = np.asarray(jax.jit(lambda s: find_roots(s, 60).q)(shafts)) * 1.3 * (0.4 / 7.0) ** 0.25
    assert np.abs(z[:, 0] / (np.pi * np.arange(1, 61)) - 1).max() <= 1e-15
    assert np.abs(z[22:, 1] / (np.pi * (np.arange(23, 61) - 1.5)) - 1).max() <= 1e-15


def test_mode_60_of_a_stepped_shaft():
    """The determinant of the plain transfer matrices, with 150 digits, changes sign within 1e-13 of modes 30, 60."""
    found = np.asarray(jax.jit(lambda s: find_roots(s, 60).q)(Bicardan.of(PAPER).shaft())) ** 2
    for mode in (30, 60):
        signs = [_exact_determinant(found[mode - 1] * (1 + side * 1e-13)) > 0 for side in (-1, 1)]
        assert signs[0] != signs[1]


def _exact_determinant(p: float) -> mpmath.mpf:
    with mpmath.workdps(150):
        k_A, k_D = mpmath.mpf(PAPER["k_A"]), mpmath.mpf(PAPER["k_D"])
        state = mpmath.matrix([[0, 1 / k_A], [1, 0], [0, 0], [0, 1]])
        for length, EI, rhoA in zip(PAPER["length"], PAPER["EI"], PAPER["rhoA"], strict=True):
            alpha = mpmath.root(mpmath.mpf(p) ** 2 * mpmath.mpf(rhoA) / mpmath.mpf(EI), 4)
            z = alpha * mpmath.mpf(length)
            c, s, ch, sh = mpmath.cos(z), mpmath.sin(z), mpmath.cosh(z), mpmath.sinh(z)
            f = ((ch + c) / 2, (sh + s) / 2, (ch - c) / 2, (sh - s) / 2)
            d = (1, 1 / alpha, -1 / (alpha**2 * EI), -1 / (alpha**3 * EI))
            state = _krylov(f, d) * state
        r = state
        return (r[2, 0] * r[3, 1] - r[2, 1] * r[3, 0]) - k_D * (r[0, 0] * r[2, 1] - r[0, 1] * r[2, 0])


def _krylov(f: tuple, d: tuple) -> mpmath.matrix:
    return mpmath.matrix([[f[(j - i) % 4] * d[j] / d[i] for j in range(4)] for i in range(4)])


def random_shaft(rng: np.random.Generator, segments: int) -> dict:
    """A shaft with contrasts up to 1e4; supports are absent or from 1e2 to 1e14, a few of them at joints."""

    def support() -> float:
        return 0.0 if rng.random() < 0.2 else 10 ** rng.uniform(2, 14)

    joints = [10 ** rng.uniform(3, 8) if rng.random() < 0.2 else 0.0 for _ in range(segments - 1)]
    return {
        "length": 10 ** rng.uniform(-1, 0, segments),
        "EI": 10 ** rng.uniform(2, 6, segments),
        "rhoA": 10 ** rng.uniform(-1, 2, segments),
        "k_A": support(),
        "k_D": support(),
        "k_joint": joints,
    }


def check_random(count: int, segments: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shafts = [random_shaft(rng, segments) for _ in range(count)]
    roots, zeros = eight(lanes(shafts))
    assert bool(roots.certified.all())
    for i, one in enumerate(shafts):
        p = np.asarray(roots.q)[:, i] ** 2
        expected = finite_elements(one, 8, bubbles=18)
        assert np.count_nonzero(p == 0) == int(zeros[i])
        assert np.all(expected[p == 0] <= 1e-4 * expected[-1])
        close = np.abs(p - expected) <= 1e-6 * expected + 1e-7 * expected[-1]
        assert close[p > 0].all(), (one, p, expected)


@pytest.mark.parametrize("segments", [3])
def test_no_root_is_missed_or_false(segments):
    check_random(34, segments, seed=segments)


@pytest.mark.full
@pytest.mark.parametrize("segments", range(1, 7))
def test_no_root_is_missed_or_false_at_full_size(segments):
    check_random(100, segments, seed=100 + segments)


AREA, MOMENT = np.array(PAPER["rhoA"]) / 7800, np.array(PAPER["EI"]) / 2.1e11
SHEAR = {"kGA": tuple(0.53 * 8.1e10 * AREA), "rhoI": tuple(7800 * MOMENT)}
EXTENSIONS = {
    "support at a joint": {"k_joint": (0.0, 1e6)},
    "yokes": {"m_A": 3.0, "m_D": 1.0, "m_joint": (2.0, 5.0)},
    "elastic joints": {"k_hinge": (1e4, 1e5)},
    "hinge and elastic joint": {"k_hinge": (0.0, 1e5), "k_joint": (1e7, 0.0)},
    "three free bars": {"k_hinge": (0.0, 0.0), "k_A": 0.0, "k_D": 0.0, "m_joint": (0.5, 0.2)},
    "mechanism on one support": {"k_hinge": (0.0, math.inf), "k_joint": (0.0, 3e5), "k_A": 0.0, "k_D": 0.0},
    "overhung bar that turns": {"k_hinge": (math.inf, 0.0), "k_joint": (1e7, 1e7), "k_D": 0.0},
    "Timoshenko": SHEAR,
    "Timoshenko with everything": SHEAR
    | {"k_hinge": (1e4, 0.0), "m_joint": (1.0, 2.0), "k_joint": (0.0, 1e6), "m_A": 0.5},
    "beyond the cut-off frequency": {"kGA": tuple(1e-3 * np.array(SHEAR["kGA"])), "rhoI": tuple(1e3 * 7800 * MOMENT)},
}


def everything(values: Mapping) -> Shaft:
    """The shaft with every field present, so that all cases share two kernels."""
    v = complete(values)
    slender = "kGA" not in values
    k, m = (np.r_[v[f"{what}_A"], v[f"{what}_joint"], v[f"{what}_D"]] for what in ("k", "m"))
    shear = (None, None) if slender else (v["kGA"], v["rhoI"])
    return Shaft(v["length"], v["EI"], v["rhoA"], k, m, v["k_hinge"], *shear).arrays()


@pytest.mark.parametrize("name", EXTENSIONS)
def test_extensions_against_finite_elements(name):
    values = PAPER | EXTENSIONS[name]
    roots, zeros = eight(everything(values))
    p, expected = np.asarray(roots.q) ** 2, finite_elements(values, 8, bubbles=20)
    assert bool(roots.certified.all()) and np.count_nonzero(p == 0) == int(zeros)
    np.testing.assert_allclose(p[p > 0], expected[p > 0], rtol=2e-11)
    assert np.all(expected[p == 0] < 1e-6 * expected[-1])


def test_shear_and_rotary_inertia_lower_the_tube():
    """The first frequency falls by 1 %, the second by 3.3 % on the paper's supports and by 3.9 % on stiff supports."""
    area, moment = 3.6e-4, 1.055e-7
    shear = {"kGA": (0.53 * 8.1e10 * area,) * 3, "rhoI": (7800 * moment,) * 3}
    for supports, expected in (({}, (-0.00990, -0.03268)), ({"k_A": 1e14, "k_D": 1e14}, (-0.01033, -0.03919))):
        tube = PRESETS["paper_tube"] | supports
        thick, slender = (np.asarray(eight(everything(tube | more))[0].q) ** 2 for more in (shear, {}))
        np.testing.assert_allclose((thick / slender)[:2] - 1, expected, atol=6e-6)


def test_coinciding_frequencies_are_all_found():
    """Three equal spans, hinged to each other over rigid supports: every frequency is triple, and N jumps by three."""
    span = {name: (1.0,) * 3 for name in ("length", "EI", "rhoA")}
    rigid = {"k_A": math.inf, "k_D": math.inf, "k_joint": math.inf, "k_hinge": 0.0}
    roots, _ = eight(everything(span | rigid))
    assert bool(roots.certified.all())
    np.testing.assert_allclose(np.asarray(roots.q), np.pi * np.array([1, 1, 1, 2, 2, 2, 3, 3]), rtol=4e-15)


def test_lanes_do_not_disturb_each_other(solved):
    """Lanes with NaN in any parameter result in NaN, not certified; the others are bitwise equal to those without them."""
    names = [name for name, case in CASES.items() if len(case["l"]) == 3]
    bad = [named(CASES[name]) for name in names]
    bad[-1] |= {"EI": [math.nan] * 3}
    bad[-2] |= {"k_A": math.nan}
    roots = thirty(lanes(bad))[0]
    q, certified = np.asarray(roots.q), np.asarray(roots.certified)
    assert np.array_equal(q[:, :-2] ** 2, np.stack([solved[name][0] for name in names[:-2]], axis=-1))
    assert np.isnan(q[:, -2:]).all() and not certified[:, -2:].any()


@pytest.mark.parametrize("z", [1e-3, 0.3, 1.99, 2.01, 7.0, 40.0])
def test_compound_is_the_exponential(z):
    """Both forms of the segment agree with ``exp(z B)`` in 60 digits; errors are relative to the column of an entry."""
    kinds = [(1.0, 0.0, 0.0, compound), (1.0, 0.0, 0.0, None), (1.0, 0.3, 0.1, None), (1.0, 3.0, 2.0, None)]
    kinds += [(0.0, 0.0, 0.0, compound), (0.0, 0.0, 0.0, None), (0.0, 3.0, 0.0, None)]
    # Series hold for other masses as well.
    kinds += [(0.4, 0.0, 0.0, compound), (0.4, 0.3, 0.1, None)] if z < 1 else []
    for r, s, t, functions in kinds:
        given = jnp.array(z), jnp.array(r)
        own = functions(*given) if functions else general(*given, jnp.array(s), jnp.array(t))
        with mpmath.workdps(60):
            B = mpmath.matrix(
                [[0, 1, 0, s, 0], [-t, 0, -2, 0, s], [0, 0, 0, -1, 0], [-r, 0, 0, 0, 1], [0, -r, 0, -t, 0]]
            )
            exact = mpmath.expm(B * mpmath.mpf(z)) * mpmath.exp(-mpmath.mpf(float(own.growth)))
        for j in range(5):
            column = own.propagate(tuple(jnp.array(float(i == j)) for i in range(5)))
            for i in range(5):
                if z < 1:
                    # Small entries matter, because soft supports balance them against large entries.
                    tolerance = 2e-14 * abs(float(exact[i, j])) + 1e-30
                else:
                    tolerance = 2e-14 * max(abs(float(exact[k, j])) for k in range(5))
                assert abs(float(column[i]) - float(exact[i, j])) <= tolerance, (r, s, t, i, j)


def test_count_grows_by_one_through_every_frequency():
    """The count is right even next to the poles of the stiffness of segments, where the stiffness alone cannot give it."""
    uniform = Bicardan.of(PRESETS["paper_tube"]).shaft()
    q = eight(everything(PRESETS["paper_tube"]))[0].q
    clamped = jnp.array([4.730040744862704, 7.853204624095838]) / (0.3 * (2.808 / 22155.0) ** 0.25)
    near = jnp.sort(jnp.concatenate([clamped * (1 + side * 1e-15) for side in (-1, 0, 1)]))
    count = jax.jit(characteristic)(uniform, jnp.concatenate([q * (1 - 1e-14), q * (1 + 1e-14), near])).count
    assert np.array_equal(count[:16], [*range(8), *range(1, 9)])
    assert np.array_equal(count[16:], np.sum(np.asarray(q)[None] < np.asarray(near)[:, None], axis=1))


ABSENT = 2
NODES = jnp.array([PAPER["k_A"], 2e6, 0.0, PAPER["k_D"]])
ARGUMENTS = {name: jnp.array(PAPER[name]) for name in ("length", "EI", "rhoA")} | {
    "k": NODES,
    "m": jnp.array([1.0, 2.0, 0.5, 0.7]),
    "k_hinge": jnp.array([3e4, 1e5]),
}
# Power of the length with which each parameter grows in similar shafts.
SCALING = {"length": 1, "EI": 0, "rhoA": 0, "k": -3, "m": 1, "k_hinge": -1, "kGA": -2, "rhoI": 2}
SCALING |= {"k_rot": -1, "inertia": 3}
STIFFNESSES, MASSES = ("EI", "k", "k_hinge", "kGA", "k_rot"), ("rhoA", "m", "rhoI", "inertia")


def angular_frequencies(arguments: Mapping[str, jax.Array], modes: int = 6) -> jax.Array:
    """Angular frequencies of the shaft whose springs and masses are listed from A to D."""
    lists = {name: tuple(x) for name, x in arguments.items()}
    for kind in ("k", "m"):
        first, *lists[f"{kind}_joint"], last = lists.pop(kind, (0.0,) * (len(arguments["length"]) + 1))
        lists |= {f"{kind}_A": first, f"{kind}_joint": tuple(lists[f"{kind}_joint"]), f"{kind}_D": last}
    return dt.critical_speeds(dt.Bicardan(**lists), outputs="angular_frequency", modes=modes).angular_frequency


def twice(arguments: Mapping[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
    p = angular_frequencies(arguments)
    return p, p


@pytest.fixture(scope="module")
def jacobians() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """p of six modes and its derivatives, by reverse mode."""
    rows, p = jax.jit(jax.jacrev(twice, has_aux=True))(ARGUMENTS)
    return np.asarray(p), {name: np.asarray(row) for name, row in rows.items()}


def check_identities(p: np.ndarray, rows: Mapping[str, np.ndarray], arguments: Mapping[str, jax.Array]) -> None:
    """Assert Euler's identities: p scales like mass^(-1/2), stiffness^(1/2), and length^(-2) of similar shafts."""
    total = {name: (rows[name] * np.asarray(arguments[name])).sum(axis=1) / p for name in rows}
    np.testing.assert_allclose(sum(total[name] for name in MASSES if name in total), -0.5, atol=1e-12)
    np.testing.assert_allclose(sum(total[name] for name in STIFFNESSES if name in total), 0.5, atol=1e-12)
    np.testing.assert_allclose(sum(SCALING[name] * total[name] for name in total), -2.0, atol=1e-11)


def check_differences(p: np.ndarray, rows: Mapping[str, np.ndarray], arguments: Mapping[str, jax.Array]) -> None:
    """Compare with fourth-order differences in the logarithm of each parameter, and with a one-sided difference for the
    absent spring."""
    h, multiples, spring = 1e-3, np.array([-2, -1, 1, 2]), np.array([1e3, 2e3])
    places = [(name, e) for name, x in arguments.items() for e in range(len(x)) if float(x[e]) > 0]
    columns = {name: np.repeat(np.asarray(x)[:, None], 4 * len(places) + 2, axis=1) for name, x in arguments.items()}
    for number, (name, e) in enumerate(places):
        columns[name][e, 4 * number : 4 * number + 4] *= np.exp(h * multiples)
    columns["k"][ABSENT, -2:] = spring
    many = jax.jit(jax.vmap(angular_frequencies, -1, -1))
    found = np.asarray(many({name: jnp.asarray(column) for name, column in columns.items()}))
    slopes = np.log(found[:, :-2]).reshape(6, len(places), 4) @ np.array([1, -8, 8, -1]) / (12 * h)
    for number, (name, e) in enumerate(places):
        exact = rows[name][:, e] * float(arguments[name][e]) / p
        np.testing.assert_allclose(exact, slopes[:, number], atol=3e-11)
    one_sided = (4 * found[:, -2] - found[:, -1] - 3 * p) / spring[1]
    np.testing.assert_allclose(rows["k"][:, ABSENT], one_sided, rtol=1e-5)


@pytest.mark.full
def test_gradients_obey_the_sum_identities(jacobians):
    check_identities(*jacobians, ARGUMENTS)


@pytest.mark.full
def test_gradients_against_finite_differences(jacobians):
    check_differences(*jacobians, ARGUMENTS)


@pytest.mark.full
def test_gradients_of_a_shaft_with_shear_and_rotary_inertia():
    """Forward mode; the fixture uses reverse mode."""
    arguments = ARGUMENTS | {"kGA": jnp.array([4e7, 2e7, 3e7]), "rhoI": jnp.array([2e-3, 1e-3, 3e-3])}
    rows, p = jax.jit(jax.jacfwd(twice, has_aux=True))(arguments)
    results = np.asarray(p), {name: np.asarray(row) for name, row in rows.items()}
    check_identities(*results, arguments)
    check_differences(*results, arguments)


def spans(EI: jax.Array) -> dict[str, jax.Array]:
    """Hinged spans over rigid supports, each with its own p = pi^2 sqrt(EI)."""
    count = len(EI)
    ones = jnp.ones(count)
    return {"length": ones, "EI": EI, "rhoA": ones, "k": jnp.full(count + 1, jnp.inf), "k_hinge": jnp.zeros(count - 1)}


@pytest.mark.full
def test_gradients_of_parts_that_are_independent():
    """Each frequency has derivatives by its own span alone; equal spans have none."""

    def both(EI: jax.Array) -> tuple[jax.Array, jax.Array]:
        p = angular_frequencies(spans(EI), 3)
        return p, p

    derivative = jax.jit(jax.jacrev(both, has_aux=True))
    rows, p = derivative(jnp.array([4.0, 1.0, 2.0]))
    np.testing.assert_allclose(p, np.pi**2 * np.sqrt([1, 2, 4]), rtol=4e-15)
    np.testing.assert_allclose(rows, np.diag(np.pi**2 / np.sqrt([4, 8, 16]))[:, [2, 0, 1]], atol=1e-12)
    bars = Shaft(**spans(jnp.array([4.0, 1.0, 2.0]))).arrays()
    assert np.all(np.asarray(jax.jit(lambda s: relative_error(s, find_roots(s, 3)))(bars)) < 1e-14)
    assert np.isnan(np.asarray(derivative(jnp.array([1.0, 1.0, 2.0]))[0])[:2]).all()


@pytest.mark.full
def test_no_derivative_where_modes_end_in_a_multiple_frequency():
    """Two equal hinged spans over rigid supports: a request for one mode must notice that the second has its frequency."""
    slope = jax.jit(jax.grad(lambda EI: angular_frequencies(spans(EI), 1)[0]))
    assert np.isnan(np.asarray(slope(jnp.array([1.0, 1.0])))).all()
    np.testing.assert_allclose(slope(jnp.array([1.0, 1.0 + 1e-9])), [np.pi**2 / 2, 0.0], atol=1e-5)


@pytest.mark.full
def test_a_zero_mode_stays_but_for_a_spring_that_would_hold_it():
    """Rigid modes of a free shaft have no derivatives by the supports; their other derivatives are zero."""
    free = dt.Bicardan(**PAPER | {"k_A": 0.0, "k_D": 0.0})
    rows = jax.jit(jax.jacfwd(lambda s: dt.critical_speeds(s, modes=3).critical_speed))(free)
    springs = ("k_A", "k_D", "k_rot_A", "k_rot_D")
    for name, slope in rows.values.items():
        for entry in jax.tree.leaves(slope):
            assert np.isnan(entry[:2]).all() if name in springs else (entry[:2] == 0).all(), name
            assert np.isfinite(entry[2]), name


def test_separation_margin():
    margin = separation_margin(jnp.array([0.0, 900.0, 1000.0, 1500.0, 2000.0, 3000.0]), 1000.0, 2000.0)
    np.testing.assert_allclose(margin, [1.0, 0.1, 0.0, 0.0, 0.0, 0.5], rtol=1e-15)
