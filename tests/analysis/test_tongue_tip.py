"""Tips of parametric tongues: the least chi_n that makes the driveshaft unstable, and Mathieu's equation."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.analysis.floquet.tongue_tip import tongue_edge, tongue_tip
from drivetrain_jax.systems import LinearPeriodic, get_system, tripod

REFERENCE = json.loads((Path(__file__).parents[1] / "reference" / "tripod.json").read_text())
DEFAULTS = {p.name: p.default for p in get_system("tripod").parameters if p.default is not None}


def element(name: str, zeta: float) -> dict:
    return DEFAULTS | {"element": name, "beta": math.radians(9), "zeta": zeta}


@pytest.mark.parametrize("case", REFERENCE["critical_chi_n"], ids=lambda case: str(case["zeta"]))
def test_critical_nonuniformity(case):
    found = tongue_tip(*tripod.parametric_tongue(element(case["element"], case["zeta"])))
    assert found.amplitude == pytest.approx(case["chi_n"], abs=1e-12)
    assert found.frequency == pytest.approx(case["excitation_frequency_Hz"], abs=1e-4)
    assert found.curvature > 0
    assert found.amplitude_error < 1e-10


@pytest.mark.parametrize("case", REFERENCE["critical_chi_n_at_2_Omega"], ids=lambda case: str(case["zeta"]))
def test_edge_at_twice_the_natural_frequency(case):
    values = element(case["element"], case["zeta"])
    frequency = jnp.array([float(tripod.element_of(values).frequency) / math.pi])
    edge = tongue_edge(tripod.parametric_tongue(values)[0], frequency, jnp.array(case["chi_n"] * 1.03))
    assert float(edge[0]) == pytest.approx(case["chi_n"], abs=1e-11)


def test_estimate_of_perturbation_theory():
    for name, estimate in (("input", 0.017385), ("output", 0.018301)):
        values = element(name, 0.0016)
        assert tripod.parametric_tongue(values)[1] == pytest.approx(estimate, abs=1e-6)


def mathieu(damping: float):
    """x'' + 2 d x' + (1 + q cos(w t)) x = 0 over one period, clock w t."""

    def form(q, w):
        def rows(cosine):
            return (0, 1 / w), (-(1 + q * cosine) / w, -2 * damping / w)

        return LinearPeriodic(rows, 2 * math.pi, basis=lambda t: (jnp.cos(t),))

    return form


def test_tip_of_a_damped_mathieu_tongue():
    """q = 4 d and w = 2 to first order in the damping; the errors are of second order."""
    for damping in (0.01, 0.02):
        tip = tongue_tip(mathieu(damping), 4.1 * damping, 2.0, damping)
        assert tip.amplitude == pytest.approx(4 * damping, rel=3 * damping**2)
        assert tip.frequency == pytest.approx(2.0, abs=5 * damping**2)


def test_no_tip_in_the_interval_is_not_a_number():
    """Beside the tongue the edge only rises."""
    assert math.isnan(tongue_tip(mathieu(0.01), 0.2, 2.08, 0.01).amplitude)
    assert np.isnan(tongue_edge(mathieu(0.01), jnp.array([1.3]), jnp.array(0.04))).all()
