"""The solvers of the floquet analysis against SciPy, against each other, and against invariants of the equations."""

from __future__ import annotations

import math
import sys
import textwrap

import jax
import numpy as np
import pytest
from floquet_batch import ANALYSIS, BASE, CARDAN, EVERYTHING, STABLE, UNDECIDED, UNSTABLE, FloquetBatch, request
from scipy.integrate import solve_ivp
from scipy.special import mathieu_a, mathieu_b

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.systems import get_system, system_names
from tests.oracles.cardan_reference import monodromy, spectral_radius, stacked_monodromy
from tests.sizes import but_full, full_after

RANGES = {"Omega": (0.05, 5), "zeta": (1e-4, 1), "alpha": (0.1, 20), "mu": (0.1, 20), "gamma": (0.1, 1e3)}


def random_points(count: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = {name: np.exp(rng.uniform(np.log(a), np.log(b), count)) for name, (a, b) in RANGES.items()}
    return {"beta": rng.uniform(-1.5, 1.5, count)} | points


# Multipliers below the rounding of the matrix need a march of their own, which takes as long to compile as all the rest.
RADIUS = tuple(name for name in EVERYTHING if not name.startswith("floquet_multiplier"))


@pytest.fixture(scope="module")
def direct():
    return FloquetBatch("direct", outputs=RADIUS)


@pytest.fixture(scope="module")
def everything():
    return FloquetBatch("direct")


@pytest.fixture(scope="module")
def diffrax():
    return FloquetBatch("diffrax", outputs=("spectral_radius",), chunk=(4,))


@pytest.fixture(scope="module")
def sample(direct):
    """Random points, their results, and results with a tighter tolerance for comparison."""
    points = random_points(200, 13)
    return points, direct(points), direct(points, rtol=1e-13)


def rows(points: dict[str, np.ndarray]) -> list[dict[str, float]]:
    return [dict(zip(points, row, strict=True)) for row in zip(*points.values(), strict=True)]


def assert_three_ways_agree(points: dict[str, np.ndarray], direct: FloquetBatch, diffrax: FloquetBatch) -> None:
    ours = direct(points)
    assert (ours["outcome"] <= Outcome.TOLERANCE_NOT_MET).all()
    general = diffrax(points, rtol=1e-11)
    # Spectral radii reach down to 1e-10, and a larger absolute tolerance would exceed them.
    oracle = spectral_radius(stacked_monodromy(points, 1e-12, 1e-15, batch=25))
    np.testing.assert_allclose(ours["spectral_radius"], oracle, rtol=1e-9)
    np.testing.assert_allclose(general["spectral_radius"], oracle, rtol=1e-9)
    assert (np.abs(ours["spectral_radius"] - oracle) <= ours["spectral_radius_error"] + 1e-10 * oracle).all()


def test_direct_diffrax_and_scipy_agree(direct, diffrax):
    assert_three_ways_agree(random_points(12, 11), direct, diffrax)


@pytest.mark.full
def test_direct_diffrax_and_scipy_agree_on_500_points(direct):
    wide = FloquetBatch("diffrax", outputs=("spectral_radius",), chunk=(64,))
    assert_three_ways_agree(random_points(500, 12), direct, wide)


def assert_bound_holds(found: dict[str, np.ndarray], sharp: dict[str, np.ndarray]) -> None:
    rho, exact = found["spectral_radius"], sharp["spectral_radius"]
    assert (np.abs(rho - exact) <= found["spectral_radius_error"]).all()
    # A bound must not be zero, and must be small at easy points.
    assert (found["spectral_radius_error"] >= 4 * np.finfo(float).eps * rho).all()
    assert np.median(found["spectral_radius_error"] / rho) < 1e-10
    wrong = (found["verdict"] == STABLE) & (exact > 1) | (found["verdict"] == UNSTABLE) & (exact < 1)
    assert not wrong.any()
    assert np.mean(found["verdict"] == UNDECIDED) < 0.01
    assert np.mean(found["outcome"] == Outcome.SUCCESS) > 0.98


def test_error_bound_holds(sample):
    assert_bound_holds(*sample[1:])


@pytest.mark.full
def test_error_bound_holds_on_50000_points():
    points, direct = random_points(50_000, 14), FloquetBatch("direct", chunk=(256, 8, 256, 64))
    assert_bound_holds(direct(points), direct(points, rtol=1e-13))


def test_a_tolerance_below_rounding_does_not_add_rounding(direct):
    """A straight shaft has constant coefficients; 500 times the panels made its error 20 times larger."""
    speeds = 1 / np.linspace(0.5, 10.0, 64)
    found = direct(
        {
            **{k: np.full(64, v) for k, v in BASE.items()},
            "beta": np.zeros(64),
            "mu": np.full(64, 20.0),
            "Omega": speeds,
        },
        rtol=1e-14,
    )
    exact = []
    for speed in speeds:
        system = CARDAN.models["floquet"].build({**BASE, "mu": 20.0, "beta": 0.0, "Omega": speed}).natural
        exact.append(np.exp(np.linalg.eigvals(np.asarray(system.matrix(0.0))).real.max() * float(system.span)))
    error = np.abs(found["spectral_radius"] - exact)
    assert error.max() < 5e-13 and (error <= found["spectral_radius_error"]).all()


CROSSING = {
    "beta": np.array([1.4286756246861043, 0.9151340127635716, 1.2499655001770509]),
    "Omega": np.array([0.051491953585090705, 0.021584104489659632, 0.029022801274611213]),
    "zeta": np.array([0.8216350310482179, 1.0118784861123455, 0.4990596490718316]),
    "alpha": np.array([0.16457759993153423, 0.16887439094976234, 0.14118529541987074]),
    "mu": np.array([10.976429953601453, 3.5240622328300297, 10.758480824751404]),
    "gamma": np.array([0.36790064817400686, 0.5100380577939942, 0.7959599064678967]),
}
# By tests/oracles/cardan_precise_reference.py with BITS = 300 and 400.
CROSSING_RADIUS = np.array([2.19580758985809508e-18, 1.0515487833445584448e-44, 6.8701943106188223541e-16])


@pytest.mark.full
@pytest.mark.parametrize("rtol", [1e-7, 1e-10, 1e-12])
def test_bound_counts_rounding_that_grows_on_the_way(direct, rtol):
    """One mode survives the first half of the span, another one the second half: rounding grows 1e4 times in between."""
    found = direct(CROSSING, rtol=rtol)
    error = np.abs(found["spectral_radius"] - CROSSING_RADIUS)
    assert (error <= found["spectral_radius_error"]).all(), error / found["spectral_radius_error"]
    assert (error <= 1e-10 * CROSSING_RADIUS + rtol * CROSSING_RADIUS).all()
    assert (found["spectral_radius_error"] <= 1e-8 * CROSSING_RADIUS + 10 * rtol * CROSSING_RADIUS).all()


# beta, Omega; spectral radius by tests/oracles/cardan_precise_reference.py with BITS = 300.
STIFF_AND_SOFT = (
    (1.2406405954877202, 0.3171689579416352, 0.52542871630596923),
    (1.2458283486844648, 0.33150135645386614, 0.99999999999974989),
    (1.2395863741339859, 0.3324238451657872, 0.99999999999950080),
)


@pytest.mark.parametrize("rtol", full_after(1, [1e-5, 1e-10, 1e-13]))
def test_bound_counts_rounding_that_both_step_sizes_share(direct, rtol):
    """The stiffness of a soft mode is a difference of entries that are five hundred times larger."""
    beta, omega, exact = map(np.array, zip(*STIFF_AND_SOFT, strict=True))
    shaft = {"zeta": 0.11912450176186314, "alpha": 45.51311106679596, "mu": 520.8626364709467}
    found = direct({"beta": beta, "Omega": omega, **shaft, "gamma": 0.9443277346781929}, rtol=rtol)
    error = np.abs(found["spectral_radius"] - exact)
    assert (error <= found["spectral_radius_error"]).all(), error / found["spectral_radius_error"]
    assert (found["spectral_radius_error"] <= 6e-11 + 10 * rtol).all()
    assert found["verdict"].tolist() == [STABLE, UNDECIDED, UNDECIDED]


# Columns as above; strong damping.
TOO_LONG_TO_MARCH = (
    (1.1752422858416216, 0.1533373642851158, 0.000031524877051342704379),
    (1.177266820356422, 0.15211986425991417, 0.000036121927451657249321),
    (1.1833404239008234, 0.15130819757644642, 0.000023066282558911271422),
    (1.16714414778242, 0.15536653099378517, 0.000040448626806663973144),
)


@pytest.mark.full
def test_bound_counts_rounding_of_strong_damping(direct):
    beta, omega, exact = map(np.array, zip(*TOO_LONG_TO_MARCH, strict=True))
    shaft = {
        "zeta": 1.2355069626811421,
        "alpha": 3.8571086733775415,
        "mu": 447.2975440886813,
        "gamma": 2.6446796826861276,
    }
    found = direct({"beta": beta, "Omega": omega, **shaft}, rtol=1e-13)
    error = np.abs(found["spectral_radius"] - exact)
    assert (error <= found["spectral_radius_error"]).all(), error / found["spectral_radius_error"]
    assert (found["spectral_radius_error"] <= 1e-10 * exact).all()


# Strong damping, and the spectral radius in quadruple precision.
SLOW_BESIDE_FAST = {
    "beta": (1.1736694503606175, 1.0959683971777907, 1.1451498070596562),
    "Omega": (0.05214942575131293, 0.08592426831610524, 0.048249976070327494),
    "zeta": (1.096825186792873, 1.9637207047338443, 1.5548747731845267),
    "alpha": (2.1594233923939674, 13.05848013763306, 0.012047019004057464),
    "mu": (181.24532787955954, 490.321446370808, 25.745447314261412),
    "gamma": (0.4433396358481521, 7.183507557145039, 0.743689598391847),
}
RADII = np.array([1.4146604913796845e-19, 1.2510611059620708e-06, 2.7608973440634447e-14])


@pytest.mark.parametrize("rtol", [1e-9, 1e-10, 1e-13])
@pytest.mark.full
def test_slow_modes_beside_fast_ones_keep_their_digits(direct, rtol):
    """In a search of the reduced form for the worst point, the first point had the largest ratio of error to bound, 13."""
    found = direct({name: np.array(values) for name, values in SLOW_BESIDE_FAST.items()}, rtol=rtol)
    error, bound = np.abs(found["spectral_radius"] - RADII), found["spectral_radius_error"]
    assert (error <= bound / 2).all(), error / bound
    # A bound may reach ten times the tolerance, or the limit of rounding.
    assert (error <= 2e-11 * RADII).all(), error / RADII
    assert (bound <= max(10 * rtol, 4e-10) * RADII).all(), bound / RADII


def test_errors_that_cancel_in_the_product_do_not_deceive(direct):
    """Z is nearly of rank one, and with 11 and with 22 steps its largest multiplier has the same error."""
    easy = (1.0563183658089397, 2.7349631755532484, 0.5761121672699921, 10.00834660652285, 0.0793118790, 49.2510470811)
    hard = (1.430161738887235, 2.831786623776442, 0.6559498501124649, 6.079785878549506, 0.07667072270795319)
    points = np.array([(*hard, 51.92629177049027), easy]).T
    names = ("beta", "Omega", "zeta", "alpha", "mu", "gamma")
    loose, sharp = (direct(dict(zip(names, points, strict=True)), rtol=rtol) for rtol in (1e-5, 1e-12))
    error = np.abs(loose["spectral_radius"] - sharp["spectral_radius"])
    assert (error <= loose["spectral_radius_error"]).all()


@pytest.mark.full
def test_what_underflows_is_not_exactly_zero(direct):
    point = BASE | {"beta": np.array([0.0]), "Omega": 0.001, "zeta": 1.0, "gamma": 1.0}
    for rtol in (1e-3, 1e-10):
        found = direct(point, rtol=rtol)
        assert 0 < found["spectral_radius_error"][0] < 1e-300 and found["verdict"][0] == STABLE
        assert found["outcome"][0] == Outcome.TOLERANCE_NOT_MET


def test_error_follows_the_tolerance(direct, sample):
    rtol = 1e-5
    points, exact = {name: x[:256] for name, x in sample[0].items()}, sample[2]["spectral_radius"][:256]
    found = direct(points, rtol=rtol)
    error = np.abs(found["spectral_radius"] - exact)
    assert (error <= found["spectral_radius_error"] + 1e-12 * exact).all()
    easy = found["outcome"] == Outcome.SUCCESS
    assert easy.mean() > 0.9
    assert (error[easy] <= 10 * rtol * exact[easy]).all()


@pytest.mark.full
def test_multipliers_and_their_largest_modulus(everything):
    points = random_points(200, 13)
    found = everything(points)
    moduli = np.abs(found["floquet_multiplier"])
    np.testing.assert_allclose(moduli[:, 0], found["spectral_radius"], rtol=1e-9)
    assert not (np.diff(moduli, axis=1) > 2e-9 * moduli[:, :1]).any()
    for p, multipliers in list(zip(rows(points), found["floquet_multiplier"], strict=True))[:3]:
        z = monodromy(p, "DOP853", 1e-12, 1e-14)
        expected, computed = np.poly(z)[1:], np.poly(multipliers)[1:]
        assert np.abs(computed - expected).max() <= 1e-9 * max(1, np.abs(multipliers[0])) ** 4


@pytest.mark.full
def test_sign_of_the_joint_angle_does_not_matter(everything):
    points = random_points(64, 17)
    found, mirrored = everything(points), everything(points | {"beta": -points["beta"]})
    for name in EVERYTHING:
        np.testing.assert_array_equal(found[name], mirrored[name])


def physical_monodromy(machine: dict[str, float]) -> np.ndarray:
    """Monodromy matrix over half a turn of the flywheel, in seconds and for the rotations of the two disks."""
    m, beta = machine, machine["beta"]

    def field(t: float, y: np.ndarray) -> np.ndarray:
        q1, q2, v1, v2 = y.reshape(4, 4)
        c, s2, phi = math.cos(beta), math.sin(beta) ** 2, m["Omega0"] * t
        d = 1 - s2 * math.sin(phi) ** 2
        ratio, rate = c / d, m["Omega0"] * c * s2 * math.sin(2 * phi) / d**2
        torque = m["k2"] * (q2 - ratio * q1) + m["c2"] * (v2 - ratio * v1 - rate * q1)
        driving = m["k1"] * q1 + m["c1"] * v1
        return np.concatenate([v1, v2, (ratio * torque - driving) / m["J1"], -torque / m["J2"]])

    end = math.pi / m["Omega0"]
    start = np.eye(4).reshape(-1)
    return solve_ivp(field, (0, end), start, "DOP853", rtol=1e-12, atol=1e-12, t_eval=(end,)).y[:, -1].reshape(4, 4)


def test_unit_of_time_does_not_matter(direct):
    """The same machine (J in kg m^2, k in J, c in J s) in three units of time."""
    machine = {"J1": 0.3, "J2": 4.2, "k1": 55.0, "k2": 80.0, "c1": 0.4, "c2": 0.9, "Omega0": 12.0, "beta": 0.8}
    groups = {
        "beta": 0.8,
        "Omega": 12.0 * math.sqrt(0.3 / 55.0),
        "zeta": 0.4 / (2 * math.sqrt(55.0 * 0.3)),
        "alpha": 0.9 / 0.4,
        "mu": 80.0 / 55.0,
        "gamma": 4.2 / 0.3,
    }
    rho = direct(groups)["spectral_radius"][0]
    for unit in (1.0, 60.0, 0.1):
        powers = {"k1": 2, "k2": 2, "c1": 1, "c2": 1, "Omega0": 1}
        scaled = {name: value * unit ** powers.get(name, 0) for name, value in machine.items()}
        expected = np.abs(np.linalg.eigvals(physical_monodromy(scaled))).max()
        assert rho == pytest.approx(expected, abs=1e-9)


def test_without_damping_the_motion_is_bounded_outside_the_tongues(direct):
    rng = np.random.default_rng(18)
    points = BASE | {"zeta": 0.0, "beta": rng.uniform(0.0, 1.4, 384), "Omega": rng.uniform(0.2, 2.0, 384)}
    rho = spectral_radius(stacked_monodromy(points, 1e-11, 1e-12))
    inside, outside = rho > 1 + 1e-5, rho < 1 + 1e-8
    assert inside.sum() > 50 and outside.sum() > 200
    verdict = direct(points)["verdict"]
    assert (verdict[inside] == UNSTABLE).all()
    assert (verdict[outside] == STABLE).all()
    assert not (verdict[rho > 1 + 1e-7] == STABLE).any()


def test_damping_can_destabilise(direct):
    found = direct(BASE | {"beta": 1.14, "Omega": 0.6695, "zeta": np.array([0.0, 0.001, 0.01])})
    assert found["verdict"].tolist() == [STABLE, UNSTABLE, UNSTABLE]
    assert found["spectral_radius"][1] - 1 == pytest.approx(3.5e-6, abs=5e-8)
    assert found["spectral_radius"][2] - 1 == pytest.approx(3.04e-5, abs=5e-7)


def test_tip_of_the_first_subharmonic_tongue(direct):
    """S11 begins at beta = 0.0238, which the grids of the paper do not show; a refined local grid finds the tip."""
    low, high = 0.02, 0.03
    for _ in range(4):
        beta = np.linspace(low, high, 64)
        found = direct(BASE | {"beta": beta, "Omega": 0.0706222355}, rtol=1e-12)
        first = int(np.argmax(found["verdict"] == UNSTABLE))
        assert first > 0 and (found["verdict"][first:] == UNSTABLE).all()
        assert set(found["verdict"][:first].tolist()) <= {STABLE, UNDECIDED}
        low, high = beta[first - 1], beta[first]
    assert high == pytest.approx(0.0237682941, abs=1e-6)
    below = direct(BASE | {"beta": high - np.array([1e-5, 1e-4, 1e-3]), "Omega": 0.0706222355})
    assert (below["verdict"] == STABLE).all()
    aside = direct(BASE | {"beta": 0.0238, "Omega": 0.0706222355 * np.array([0.999, 1.001])})
    assert (aside["verdict"] == STABLE).all()


def base_chart(stride: int) -> dict[str, np.ndarray]:
    beta, speed = np.linspace(0, 1.5, 151)[::stride], np.linspace(0.01, 2.0, 200)[::stride]
    return BASE | dict(zip(("beta", "Omega"), np.meshgrid(beta, speed, indexing="ij"), strict=True))


def test_unstable_part_of_the_base_chart(direct):
    """Every fourth angle and speed: SciPy's DOP853 (rtol 1e-11) finds 473 of 1900 cells unstable, and no radius near 1."""
    found = direct(base_chart(4))
    assert np.bincount(found["verdict"], minlength=3).tolist() == [1900 - 473, 473, 0]


@pytest.mark.full
def test_unstable_part_of_the_whole_base_chart(direct):
    verdict = direct(base_chart(1))["verdict"]
    assert verdict.size == 151 * 200
    assert np.mean(verdict == UNSTABLE) == pytest.approx(0.256, abs=0.002)
    assert np.mean(verdict == UNDECIDED) < 1e-3


def test_liouville_residual_is_small_where_the_result_is_good(sample):
    found = sample[1]
    good = found["outcome"] == Outcome.SUCCESS
    assert np.abs(found["liouville_residual"][good]).max() < 1e-9
    assert (np.abs(found["liouville_residual"][good]) > 0).any()


@pytest.mark.parametrize("method", full_after(1, ["auto", "direct", "diffrax"]))
@pytest.mark.parametrize(
    "outputs",
    full_after(1, [("spectral_radius",), ("verdict",), ("floquet_multiplier", "liouville_residual"), EVERYTHING]),
)
def test_only_what_is_asked_for_is_returned(method, outputs):
    values = {name: jax.ShapeDtypeStruct((), float) for name in CARDAN.models["floquet"].parameters}
    for solver in ANALYSIS.solvers(CARDAN, request(method, 1e-10, outputs)):
        shapes = jax.eval_shape(solver.solve, values, jax.ShapeDtypeStruct((), np.int64))
        assert set(shapes) == {*outputs, "outcome"}
        for name, shape in shapes.items():
            assert shape.shape == ((4,) if name.startswith("floquet_multiplier") else ())
            assert shape.dtype == {"floquet_multiplier": complex, "verdict": np.int8, "outcome": np.int8}.get(
                name, float
            )


@pytest.mark.full
@pytest.mark.parametrize("solver", but_full(["Tsit5", "Kvaerno5"], "Kvaerno5"))
def test_any_diffrax_solver_gives_the_same(direct, solver):
    batch = FloquetBatch("diffrax", outputs=("spectral_radius",), chunk=(2,), solver=solver)
    points = BASE | {"beta": np.array([0.5, 1.1]), "Omega": np.array([1.2, 0.6]), "zeta": np.array([0.001, 0.3])}
    np.testing.assert_allclose(batch(points, 1e-6)["spectral_radius"], direct(points)["spectral_radius"], rtol=1e-5)


def test_what_cannot_be_computed_is_marked(direct):
    """A lane that is not finite is NaN, undecided and has an outcome; its neighbour stays accurate."""
    points = BASE | {"beta": np.array([0.5, 0.5]), "Omega": np.array([1.2, 1.2]), "mu": np.array([np.nan, 1.0])}
    padded = {name: np.pad(np.broadcast_to(x, 2), (0, 62), mode="edge") for name, x in points.items()}
    found = {name: np.asarray(x) for name, x in direct.kernel(0)(padded, np.int64(20), 1e-10).items()}
    assert found["outcome"][:2].tolist() == [Outcome.NOT_FINITE, Outcome.SUCCESS]
    assert np.isnan(found["spectral_radius"][0]) and found["verdict"][0] == UNDECIDED
    exact = direct({name: x[1:2] for name, x in padded.items()})["spectral_radius"][0]
    assert found["spectral_radius"][1] == pytest.approx(exact, rel=1e-10)


# A minimal system of another package: two states, one form, no reversor, no prediction of steps.
MATHIEU = '''
import math

import jax.numpy as jnp

from drivetrain_jax._quantities import Parameter
from drivetrain_jax.systems import FloquetModel, LinearPeriodic, System, parameter, serves


class Mathieu(System):
    """x'' + 2 d x' + (a - 2 q cos 2t) x = 0."""

    name = "mathieu"
    title = "Damped Mathieu equation"
    source = "DLMF 28"

    a: float = parameter("1", "stiffness")
    q: float = parameter("1", "modulation")
    d: float = parameter("1", "damping")

    @serves("floquet")
    def floquet_model(self):
        form = LinearPeriodic(self.rows, math.pi)
        return FloquetModel(form, form)

    def rows(self, t):
        return (0, 1.0), (2 * self.q * jnp.cos(2 * t) - self.a, -2 * self.d)
'''


@pytest.fixture(scope="module")
def other_package(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    (folder / "other_shafts.py").write_text(textwrap.dedent(MATHIEU))
    info = folder / "other_shafts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-shafts\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[drivetrain_jax.systems]\nmathieu = other_shafts:Mathieu\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DRIVETRAIN_JAX_CACHE", "0")
        patch.syspath_prepend(str(folder))
        yield "mathieu"
        sys.modules.pop("other_shafts", None)


def test_other_package_adds_a_system(other_package):
    assert other_package in system_names()
    assert get_system(other_package).title == "Damped Mathieu equation"
    with pytest.raises(InputError, match=r"cardan, .*mathieu"):
        get_system("nothing of the kind")


@pytest.mark.parametrize("method", full_after(1, ["direct", "diffrax"]))
def test_any_linear_periodic_system_is_analysed(other_package, method):
    """Mathieu's characteristic values bound the tongues; damping d multiplies the multipliers at a - d^2 by e^(-d pi)."""
    q, d = 1.3, 0.02
    bands = [(mathieu_a(0, q), mathieu_b(1, q)), (mathieu_a(1, q), mathieu_b(2, q)), (mathieu_a(2, q), mathieu_b(3, q))]
    stable = [low + x * (high - low) for low, high in bands for x in (0.1, 0.5, 0.9)]
    tongue = [mathieu_b(1, q) + x * (mathieu_a(1, q) - mathieu_b(1, q)) for x in (0.2, 0.5, 0.8)]
    edges = [mathieu_b(1, q), mathieu_a(1, q), mathieu_b(2, q)]
    a = np.array([*stable, *tongue, *edges])
    points = {"a": [*a, *(a + d * d)], "q": [q] * 2 * len(a), "d": [0.0] * len(a) + [d] * len(a)}
    scene = {
        "system": other_package,
        "analysis": "floquet",
        "points": {k: list(map(float, v)) for k, v in points.items()},
    }
    options = {"method": method, "rtol": 1e-9}
    ds = dt.run(scene | {"options": options, "outputs": ["spectral_radius", "spectral_radius_error", "verdict"]})
    rho, bound = (ds[name].values.reshape(2, -1) for name in ("spectral_radius", "spectral_radius_error"))
    verdict = ds.verdict.values.reshape(2, -1)
    inside = slice(len(stable), len(stable) + len(tongue))
    # Undamped: multipliers on the unit circle between the tongues, off it inside, double at the edges.
    assert (verdict[0, : len(stable)] == STABLE).all() and (rho[0, : len(stable)] == 1).all()
    assert (verdict[0, inside] == UNSTABLE).all() and (rho[0, inside] > 1.1).all()
    assert (verdict[0, inside.stop :] == UNDECIDED).all()
    marginal = np.r_[: len(stable), inside.stop : len(a)]
    assert (np.abs(rho[0, marginal] - 1) <= bound[0, marginal]).all()
    # Damped: every multiplier is smaller by the same factor.
    assert (verdict[1, marginal] == STABLE).all() and (verdict[1, inside] == UNSTABLE).all()
    assert (np.abs(rho[1, marginal] - math.exp(-d * math.pi)) <= bound[1, marginal]).all()
    np.testing.assert_allclose(rho[1, inside], math.exp(-d * math.pi) * rho[0, inside], rtol=1e-8)


@pytest.mark.parametrize("extreme", [{"zeta": 1e300}, {"Omega": 1e-300}])
def test_point_beyond_every_scheme_has_an_outcome(extreme):
    base = {"beta": 0.5, "Omega": 1.0, "zeta": 0.1, "alpha": 1.0, "mu": 1.0, "gamma": 1.0}
    point = dt.point("cardan", "floquet", **(base | extreme))
    assert point.outcome.name == "STEP_LIMIT"
    assert np.isnan(point.spectral_radius)
    assert point.verdict == 2


@pytest.mark.full
def test_strong_damping_where_only_the_speed_varies():
    """The matrices of the reversal do not depend on the speed, and are the same for all lanes."""
    fixed = {"beta": 0.5, "zeta": 1.0, "alpha": 1.0, "mu": 1.0, "gamma": 1.0}
    scene = {"system": "cardan", "analysis": "floquet", "fixed": fixed, "outputs": ["spectral_radius"]}
    options = {"options": {"method": "direct", "rtol": 1e-10}}
    speeds = [0.05, 0.06, 0.09]
    swept = dt.run(scene | options | {"points": {"Omega": speeds}}).spectral_radius.values
    alone = [dt.point("cardan", "floquet", Omega=speed, **fixed).spectral_radius for speed in speeds]
    np.testing.assert_allclose(swept, alone, rtol=1e-9)
