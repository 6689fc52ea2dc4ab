"""An unbalance: the amplitude of the drive follows its frequency. Every point is compared with B1 set by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._errors import InputError
from drivetrain_jax.analysis.frequency_response.harmonic_balance import Basis, contact, residual
from drivetrain_jax.systems.rattle import PRESETS, Rattle
from tests.sizes import but_full

# So damped that every frequency has one motion; the teeth separate above 0.4 rad/s.
GEARS = PRESETS["table1"] | {"c": 0.3, "B1": 0.0, "unbalance": 0.2}
FREQUENCIES = [0.4, 0.6, 0.8, 0.9, 1.0, 1.15]
OUTPUTS = ["u_max", "u_min", "u_rms", "phase"]
METHODS = {
    "exact": {},
    "multiple_scales": {},
    "harmonic_balance": {"harmonics": 7},
    "averaging": {"fit_range": 0.3},
    "describing_function": {},
}


def response(frequencies: list[float], method: str, outputs: list[str] = OUTPUTS, **parameters):
    scene = {"system": "rattle", "analysis": "frequency_response", "outputs": outputs, "axes": {"omega": frequencies}}
    options = {"method": method} | METHODS[method]
    return dt.run(scene | {"fixed": GEARS | parameters, "options": options})


def by_hand(omega: float) -> dict:
    values = GEARS | {"B1": GEARS["unbalance"] * omega**2}
    del values["unbalance"]
    return values


@pytest.mark.full
@pytest.mark.parametrize("method", but_full(METHODS, "exact", *list(METHODS)[2:]))
def test_every_frequency_is_that_of_its_own_amplitude(method):
    """Also outside of scenes, and for a B1 of its own."""
    found = response(FREQUENCIES, method, B1=0.01)
    assert np.all(found.outcome == 0)
    for omega in FREQUENCIES[1::2]:
        single = dt.Rattle(omega=jnp.array([omega]), **by_hand(omega) | {"B1": 0.01 + GEARS["unbalance"] * omega**2})
        expected = dt.frequency_response(single, outputs=OUTPUTS, method=method, **METHODS[method])
        for name in OUTPUTS:
            np.testing.assert_allclose(
                found[name].sel(omega=omega),
                getattr(expected, name)[0],
                rtol=1e-10,
                atol=1e-13,
                err_msg=f"{name} {omega}",
            )


@pytest.mark.full
def test_the_exact_response_is_that_of_steady_states():
    found = response(FREQUENCIES, "exact", ["u_max", "u_min", "u_rms", "regime"])
    assert len(set(found.regime.values[:, 0].tolist())) > 1
    python = dt.frequency_response(dt.Rattle(omega=np.array(FREQUENCIES), **GEARS), outputs="u_max")
    np.testing.assert_allclose(python.u_max, found.u_max, rtol=1e-12)
    for omega in FREQUENCIES:
        for given in (by_hand(omega), GEARS):
            state = dt.point("rattle", "steady_state", outputs=["u_max", "u_min", "u_rms"], omega=omega, **given)
            for name in ("u_max", "u_min", "u_rms"):
                np.testing.assert_allclose(found[name].sel(omega=omega), getattr(state, name), rtol=1e-10, err_msg=name)


@pytest.mark.full
@pytest.mark.parametrize("method", ["exact", "harmonic_balance"])
def test_branches_follow_the_amplitude_between_the_frequencies(method):
    """Lightly damped: the motions that the sweeps find lie on the branch, and two of them coexist somewhere."""
    found = response(
        list(np.linspace(0.6, 1.15, 12)), method, ["u_max", "branch_u_max", "regime"], c=0.05, unbalance=0.05
    )
    assert np.all(found.outcome == 0)
    nearest = np.abs(found.branch_u_max.values[:, :, None] - found.u_max.values[:, None]) / found.u_max.values[:, None]
    assert np.nanmin(nearest, axis=1).max() < (1e-9 if method == "exact" else 1e-6)
    assert np.isfinite(found.branch_u_max.values).sum(axis=1).max() > 1


@pytest.mark.full
def test_the_residual_knows_its_slope_along_the_frequency():
    model = Rattle(omega=0.7, **GEARS).along_frequencies()
    basis = Basis(3, 1, 0)
    x = jnp.array([0.2, 0.1, -0.3, 0.02, 0.01, 0.0, 0.03])[:, None]
    touch = contact(model, basis, x)
    _, slope = jax.jvp(lambda w: residual(model, basis, x, w, touch)[0], (jnp.array([0.7]),), (jnp.ones(1),))
    np.testing.assert_allclose(residual(model, basis, x, jnp.array([0.7]), touch)[1], slope, rtol=1e-13, atol=1e-15)


def test_a_peak_over_frequencies_of_unlike_amplitude_is_refused():
    with pytest.raises(InputError, match="peak_amplitude for a drive of one amplitude"):
        response(FREQUENCIES, "describing_function", ["peak_amplitude"])


@pytest.mark.full
def test_no_threshold_is_drawn_over_the_amplitude_of_an_unbalance():
    scene = {"system": "rattle", "analysis": "steady_state", "outputs": ["u_max"], "axes": {"B1": [0.01, 0.02, 0.03]}}
    fixed = {name: value for name, value in by_hand(0.7).items() if name != "B1"} | {"omega": 0.7}
    assert dt.run(scene | {"fixed": fixed}).drivetrain.resonances() is not None
    with pytest.raises(InputError, match="none are predicted"):
        dt.run(scene | {"fixed": fixed | {"unbalance": 0.01}}).drivetrain.resonances()
