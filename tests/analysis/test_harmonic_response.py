"""Response of planetary gears to transmission errors and torques, against a dense solution of the equations of motion."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

import drivetrain_jax as dt
from drivetrain_jax.analysis import Outcome
from tests.oracles.planetary_reference import TABLE_2, matrices

ANGLES = (0.0, 1.3, 2.9, 4.6)
ERRORS = {"e_s": (1e-6, 2e-6, 1e-6, 3e-6), "phase_s": (0.0, 0.3, 1.0, 2.0), "e_r": 2e-6, "phase_r": 0.5}
FOUR = {"planet_angle": tuple(np.arange(4) * np.pi / 2)}


def forces(torques: dict[str, float]) -> np.ndarray:
    """Forces of ERRORS on the coordinates: stiffness times error along the direction of each mesh, and ``torques``."""
    a, force = TABLE_2["pressure_angle"], np.zeros(9 + 3 * len(ANGLES), complex)
    sin, cos = np.sin, np.cos
    for i, angle in enumerate(ANGLES):
        at, ring, sun = 9 + 3 * i, angle + a, angle - a
        meshes = (
            (TABLE_2["k_rp"] * ERRORS["e_r"] * np.exp(1j * ERRORS["phase_r"]),
             {3: -sin(ring), 4: cos(ring), 5: 1, at: sin(a), at + 1: -cos(a), at + 2: -1}),
            (TABLE_2["k_sp"] * ERRORS["e_s"][i] * np.exp(1j * ERRORS["phase_s"][i]),
             {6: -sin(sun), 7: cos(sun), 8: 1, at: -sin(a), at + 1: -cos(a), at + 2: 1}),
        )  # fmt: skip
        for size, direction in meshes:
            for row, part in direction.items():
                force[row] += size * part
    for row, body in ((2, "c"), (5, "r"), (8, "s")):
        force[row] += torques.get(f"T_{body}", 0.0)
    return force


@pytest.mark.full
def test_it_is_the_dense_solution():
    damping, torques = 0.03, {"T_s": 10.0, "T_c": -5.0}
    gear = dt.Planetary(planet_angle=ANGLES, **ERRORS, **torques)
    found = dt.harmonic_response(
        gear, outputs=["amplitude", "phase"], start=100.0, stop=12e3, num=40, damping_ratio=damping
    )
    mass, stiffness = (np.array(x, float) for x in matrices(TABLE_2 | {"planet_angle": ANGLES}))
    squares, shapes = eigh(stiffness, np.diag(mass))
    # The first mode is rigid: the rounding of its frequency must not damp it.
    own = np.where(np.arange(len(squares)) > 0, np.sqrt(abs(squares)), 0.0)
    damper = np.diag(mass) @ shapes @ np.diag(2 * damping * own) @ shapes.T @ np.diag(mass)
    for amplitude, phase, frequency in zip(found.amplitude, found.phase, np.linspace(100, 12e3, 40), strict=True):
        omega = 2 * np.pi * frequency
        expected = np.linalg.solve(stiffness - omega**2 * np.diag(mass) + 1j * omega * damper, forces(torques))
        assert abs(amplitude * np.exp(1j * phase) - expected).max() < 1e-8 * abs(expected).max()


@pytest.mark.full
@pytest.mark.parametrize(("order", "silent"), [(0, ("x_", "y_")), (1, ("u_c", "u_r", "u_s"))])
def test_mesh_phases_choose_the_modes(order, silent):
    """Equal planets in phase excite rotations alone; phases of one turn around the gear excite translations alone."""
    gear = dt.Planetary(**FOUR, phase_s=tuple(order * angle for angle in FOUR["planet_angle"]))
    chart = dt.sweep(dt.harmonic_response, gear, over={"k_p": [1e8]}, start=100.0, stop=12e3, num=50)
    largest = chart.amplitude.max(("k_p", "frequency"))
    still = [dof for dof in largest.dof.values if dof.startswith(silent)]
    assert len(still) >= 3 and float(largest.sel(dof=still).max()) < 1e-12 * float(largest.max())


@pytest.mark.full
def test_rotational_model_has_the_peaks_of_its_modes():
    gear = dt.Planetary(model="rotational", T_s=1.0, e_s=0.0)
    own = np.unique(np.asarray(dt.modes(gear).natural_frequency).round(6))[1:]
    for frequency in own[[0, 2, 3]]:
        near = dt.harmonic_response(gear, start=0.99 * frequency, stop=1.01 * frequency, num=3, damping_ratio=1e-4)
        assert near.amplitude[1].max() > 10 * max(near.amplitude[0].max(), near.amplitude[2].max())


@pytest.mark.full
def test_an_undamped_free_gear_has_no_amplitude_at_rest():
    found = dt.harmonic_response(dt.Planetary(T_s=1.0), start=0.0, stop=500.0, num=3)
    assert int(found.outcome) == Outcome.NOT_FINITE
    assert np.isnan(found.amplitude[0]).any() and np.isfinite(found.amplitude[1:]).all()


@pytest.mark.full
def test_slow_errors_of_meshes_do_not_turn_a_free_gear():
    """Far below the first elastic mode, at 727 Hz, the response is that at rest; inner forces leave the rigid mode alone."""
    still, slow, at_rest = (
        dt.harmonic_response(dt.Planetary(), start=f, stop=2 * f + 1e-9, num=2).amplitude[0] for f in (1.0, 1e-4, 0.0)
    )
    np.testing.assert_allclose(slow, still, rtol=1e-4, atol=1e-11)
    np.testing.assert_allclose(at_rest, slow, rtol=1e-6, atol=1e-11)


@pytest.mark.full
def test_a_batch_equals_its_points():
    sizes = jnp.array([1e-6, 2e-6, 5e-6])
    options = {"start": 100.0, "stop": 3e3, "num": 20}
    batch = jax.vmap(lambda e: dt.harmonic_response(dt.Planetary(e_s=e), **options).amplitude)(sizes)
    chart = dt.sweep(dt.harmonic_response, dt.Planetary(), over={"e_s": sizes}, **options)
    close = {"rtol": 1e-9, "atol": 1e-10 * float(batch.max())}
    np.testing.assert_allclose(batch, chart.amplitude, **close)
    np.testing.assert_allclose(batch[1:], batch[0] * (sizes[1:] / sizes[0])[:, None, None], **close)


@pytest.mark.parametrize(
    ("parameters", "options", "line"),
    [
        ({}, {}, "stop = 0: expected more than start = 1, in Hz"),
        ({"e_s": (1e-6, 1e-6)}, {"stop": 1e3}, "e_s = [1e-06, 1e-06]: 2 entries where planet_angle has 4; "),
    ],
)
def test_wrong_input_is_named(parameters, options, line):
    with pytest.raises(dt.InputError) as error:
        dt.harmonic_response(dt.Planetary(**parameters), **options)
    assert str(error.value).startswith(line)
