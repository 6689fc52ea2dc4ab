"""Exclusion and tracing on polynomials of which everything is known."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas import exclusion, tracing
from drivetrain_jax.atlas.patches import Patches


def one_patch(coefficients):
    """The polynomial with these coefficients over [-1, 1]^2, without error."""
    square = np.ones((1, 2))
    return Patches(-square, square, np.array(coefficients)[..., None], np.zeros((1, 1, 1)), np.zeros(1), square)


def test_a_box_without_a_tip_is_not_one_with_a_single_tip():
    """f = h^2 - v has its tip at 0; of f = h^2 - v - 2 the whole floor of the valley is negative."""
    for shift, expected in ((0.0, True), (2.0, False)):
        bundle = exclusion._Bundle(one_patch([[0.5 - shift, -1.0], [0.0, 0.0], [0.5, 0.0]]), 0)
        assert bundle.single().tolist() == [expected]


def test_a_curve_is_traced_both_ways_from_its_seed():
    """The parabola h = (2 v^2 - 1)/5 from its vertex to the rim."""
    field = tracing.Field(one_patch([[0.0, 0.0, -0.2], [1.0, 0.0, 0.0]]))
    (curve,) = tracing.trace(field, np.array([[-0.2, 0.0]]))
    h, v = curve.points.T
    assert h == pytest.approx((2 * v**2 - 1) / 5, abs=1e-12) and not curve.closed
    assert np.abs(np.diff(curve.points, axis=0)).max() < 0.04 and (np.diff(v) > 0).all() == (v[0] < 0)
    assert sorted([v[0], v[-1]]) == pytest.approx([-1.0, 1.0])


def test_a_path_that_runs_along_the_rim_ends_where_it_is():
    """Both of its points lie outside by rounding: the line through them meets the rim far away."""

    def field(y):
        return np.zeros(len(y)), np.tile([1.0, 0.0], (len(y), 1))

    end = tracing._to_rim(field, np.array([-1e-9, 0.5]), np.array([-1.0000001e-9, 0.51]))
    assert end == pytest.approx([0.0, 0.5], abs=0.02)
