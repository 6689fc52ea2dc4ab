import math

import jax.numpy as jnp
import numpy as np
import pytest

from drivetrain_jax.resonances import rattle_threshold
from drivetrain_jax.systems import get_system
from drivetrain_jax.systems.rattle import PRESETS, Rattle

TABLE1 = PRESETS["table1"] | {"omega": 0.7}


def test_the_spring_is_continuous_and_linear_outside_the_play():
    model = Rattle.models["basins"].build(TABLE1)
    b, alpha = TABLE1["b"], TABLE1["alpha"]
    u = jnp.array([-b - 0.3, -b, -0.5 * b, 0.0, 0.5 * b, b, b + 0.3])
    expected = [-0.3 - alpha * b, -alpha * b, -alpha * b / 2, 0.0, alpha * b / 2, alpha * b, 0.3 + alpha * b]
    np.testing.assert_allclose(model.restoring(u), expected, atol=1e-16)


def test_the_field_is_the_equation_of_motion():
    model = Rattle.models["basins"].build(TABLE1 | {"I": 2.0, "k": 3.0})
    u, v, t = 0.4, -0.2, 1.3
    spring = u - 0.75 * math.pi / 18
    expected = 0.05 + 0.03 * math.cos(0.7 * t) - 0.05 / 2 * v - 1.5 * spring
    np.testing.assert_allclose(model.field(t, jnp.array([u, v])), [v, expected], rtol=1e-15)
    np.testing.assert_allclose(model.switching(jnp.array([u, v])), [u - TABLE1["b"], u + TABLE1["b"]])


def test_at_the_threshold_the_orbit_touches_the_flank():
    values = TABLE1 | {"omega": 2.0}
    b1 = float(rattle_threshold(values)[0])
    response = b1 / complex(1.0 - 4.0, 0.05 * 2.0)
    mean = values["B0"] + (1 - values["alpha"]) * values["b"]
    assert mean - abs(response) == pytest.approx(values["b"], rel=1e-14)
    # A mean drive that does not hold the teeth in contact has no threshold.
    assert np.isnan(rattle_threshold(values | {"B0": 0.04})[0])


def test_parameters_and_ranges():
    system = get_system("rattle")
    needed = [p.name for p in system.parameters if p.default is None]
    assert needed == ["omega", "B0", "B1", "b", "c", "alpha", "k", "I", "unbalance"]
    with pytest.raises(ValueError, match="0 < k"):
        system.parameter("k").check(0.0)
