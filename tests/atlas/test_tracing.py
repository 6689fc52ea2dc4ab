"""Exclusion and tracing on known polynomials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivetrain_jax.atlas import boundaries, exclusion
from drivetrain_jax.atlas.patches import Patches, join


def one_patch(coefficients, error=0.0):
    """The polynomial with these coefficients over [-1, 1]^2, with this error."""
    square = np.ones((1, 2))
    return Patches(-square, square, np.array(coefficients)[..., None], np.zeros((1, 1, 1)), np.full(1, error), square)


@pytest.mark.parametrize(
    ("shift", "error", "expected"),
    [(0.0, 0.0, True), (0.0, 0.3, True), (2.0, 0.0, False), (0.5, 0.7, False), (-0.5, 0.7, False)],
)
def test_single_is_true_only_for_boxes_with_one_tip(shift, error, expected):
    """f = h^2 - v has its tip at 0; for f = h^2 - v - 2 the floor of the valley is negative throughout.

    The floor may also be negative throughout if an error is larger than f at either of its ends.
    """
    bundle = exclusion._Bundle(one_patch([[0.5 - shift, -1.0], [0.0, 0.0], [0.5, 0.0]], error), 0)
    assert bundle.single().tolist() == [expected]


@pytest.mark.parametrize(("floor", "error", "expected"), [(0.5, 0.0, True), (0.5, 0.7, False), (-0.5, 0.7, False)])
def test_valley_farther_from_zero_than_its_error_is_excluded(floor, error, expected):
    bundle = exclusion._Bundle(one_patch([[0.5 + floor], [0.0], [0.5]], error), 0)
    assert bundle.excluded().tolist() == [expected]


def test_a_tip_on_the_face_of_two_boxes_is_one_tip():
    """h^2 - v is given over v <= 0 and over v >= 0."""
    halves = [
        replace(one_patch([[0.5 - middle, -0.5], [0.0, 0.0], [0.5, 0.0]], 1e-6), lower=np.array([[-1.0, middle - 0.5]]))
        for middle in (-0.5, 0.5)
    ]
    halves = [replace(p, upper=p.lower + np.array([[2.0, 1.0]])) for p in halves]
    found = exclusion.critical_points((join(halves),), 0, 0)
    assert found.points == pytest.approx(np.zeros((1, 2)), abs=1e-12) and not len(found.undecided)


def test_the_error_includes_trimmed_coefficients():
    patch = one_patch([[1.0, 0.5, 0.0, 0.0, 0.0, 1e-4]], 0.1)
    trimmed = patch.trim()
    assert trimmed.coefficients.shape[1] < 6
    assert trimmed.error == pytest.approx([0.1001])


def test_a_curve_is_traced_both_ways_from_its_seed():
    """The seed is near the vertex of the parabola h = (2 v^2 - 1)/5, which ends at the rim."""
    field = boundaries.Field(one_patch([[0.0, 0.0, -0.2], [1.0, 0.0, 0.0]]))
    (curve,) = boundaries.trace(field, np.array([[-0.21, 0.0]]))
    h, v = curve.T
    assert h == pytest.approx((2 * v**2 - 1) / 5, abs=1e-12)
    assert np.abs(np.diff(curve, axis=0)).max() < 0.04 and (np.diff(v) > 0).all() == (v[0] < 0)
    assert sorted([v[0], v[-1]]) == [-1.0, 1.0]


def test_a_closed_curve_ends_where_it_began():
    """The seed is near the circle of radius 1/2."""
    field = boundaries.Field(one_patch([[0.75, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    (curve,) = boundaries.trace(field, np.array([[0.51, 0.0]]))
    assert np.array_equal(curve[0], curve[-1])
    assert np.linalg.norm(curve, axis=1) == pytest.approx(np.full(len(curve), 0.5), abs=1e-12)
    # The path goes around once.
    assert np.linalg.norm(np.diff(curve, axis=0), axis=1).sum() == pytest.approx(np.pi, rel=1e-3)


def test_the_other_edge_of_a_narrow_tongue_is_another_curve():
    """The edges of h^2 = 1e-8 are nearer to each other than chords are to curves."""
    field = boundaries.Field(one_patch([[0.5 - 1e-8, 0.0], [0.0, 0.0], [0.5, 0.0]]))
    v = np.linspace(-1.0, 1.0, 101)
    edge = np.stack([np.full(101, 1e-4), v], axis=-1)
    seeds = np.array([[1e-4, 0.013], [-1e-4, 0.013], [0.5, 0.013]])
    assert boundaries._contains(field, edge, seeds).tolist() == [True, False, False]


def test_segments_leave_out_points_that_are_not_limiting():
    points = {"beta": np.arange(5.0), "Omega": np.arange(5.0)}
    limiting = np.array([True, True, False, True, True])
    curve = boundaries.Boundary("pair", points, limiting)
    assert [part["beta"].tolist() for part in curve.segments()] == [[0.0, 1.0], [3.0, 4.0]]


def test_a_path_ends_on_the_rim():
    """A straight path has both ends on the rim; on a bent one the last step is corrected along the rim."""
    (curve,) = boundaries.trace(boundaries.Field(one_patch([[-0.3, 0.0], [1.0, 0.0]])), np.array([[0.3, 0.1]]))
    assert sorted(curve[[0, -1], 1]) == [-1.0, 1.0]

    def field(y):
        slope = np.stack([np.ones(len(y)), -0.6 * (y[:, 1] - 1)], axis=-1)
        return y[:, 0] - 0.5 - 0.3 * (y[:, 1] - 1) ** 2, slope

    end = boundaries._to_rim(field, np.array([0.50003, 0.99]), np.array([0.50003, 1.01]))
    assert end == pytest.approx([0.5, 1.0], abs=1e-12)


def test_a_path_along_the_rim_ends_there():
    """Both points of a step lie outside by rounding, and the line through them meets the rim far away."""

    def field(y):
        return np.zeros(len(y)), np.tile([1.0, 0.0], (len(y), 1))

    end = boundaries._to_rim(field, np.array([-1e-9, 0.5]), np.array([-1.0000001e-9, 0.51]))
    assert end == pytest.approx([0.0, 0.5], abs=0.02)


@pytest.mark.parametrize(("foot", "width"), [(-0.5, 1e-6), (0.0, 1e-6), (0.0, 1e-7)])
def test_points_lie_on_the_edges_of_a_narrow_slanted_tongue(foot, width):
    """The tongue is (h - 0.3 v - 0.3 v^2)^2 = width (v - foot), slanted at its tip except in the first case.

    A point of slow convergence must not count as a point of the curve, and the flanks must lie on different edges.
    """
    t = np.cos(np.pi * (np.arange(8) + 0.5) / 8)
    analysis = np.linalg.inv(np.polynomial.chebyshev.chebvander(t, 7))
    h, v = np.meshgrid(t, t, indexing="ij")
    values = (h - 0.3 * v - 0.3 * v**2) ** 2 - width * (v - foot)
    field = boundaries.Field(one_patch(analysis @ values @ analysis.T))
    (curve,) = boundaries.trace_tips(field, np.array([[0.3 * foot + 0.3 * foot**2, foot]]), 0)
    value, gradient = field(field.to_unit(curve))
    h, v = curve.T
    top = np.argmin(np.abs(v - foot))
    assert (np.abs(value) / np.linalg.norm(gradient, axis=1))[np.arange(len(v)) != top].max() < 1e-9
    side = np.sign(h - 0.3 * v - 0.3 * v**2)
    assert (side[:top] == -1).all() and (side[top + 1 :] == 1).all()
    assert v[0] == v[-1] == 1.0


def test_turns_of_steps_are_limited():
    """On this circle the turn limits the step: no step turns by more than a quarter, and none by far less."""
    radius = 0.02

    def field(y):
        return ((y - 0.5) ** 2).sum(axis=1) - radius**2, 2 * (y - 0.5)

    (path,), returned = boundaries._follow(field, np.array([[0.5 + radius, 0.5]]), np.ones(1))
    assert returned.all() and 50 < len(path) < 100
    angle = np.unwrap(np.arctan2(path[:, 1] - 0.5, path[:, 0] - 0.5))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi)
    turns = np.abs(np.diff(angle))[-30:-2]
    # A step grows by 1.6 while it turns by less than a twelfth of a radian.
    assert turns.min() > 1 / 12 and turns.max() < 1.65 / 12


@pytest.mark.parametrize(("shift", "end"), [(0.0015, 1.0), (0.004, 0.6)])
def test_a_large_correction_belongs_to_another_curve(shift, end):
    """A straight line jumps at v = 0.6 by a tenth or a quarter of the longest step.

    The tangent stays the same, so only the size of the correction shows the jump.
    """

    def field(y):
        return y[:, 0] - 0.5 - shift * (y[:, 1] > 0.6), np.tile([1.0, 0.0], (len(y), 1))

    (path,), _ = boundaries._follow(field, np.array([[0.5, 0.3]]), np.ones(1))
    assert path[-1, 1] == pytest.approx(end, abs=1e-6)


def test_a_path_ends_where_the_function_is_undefined():
    """The function has values only below v = 0.7: the step is divided down to the shortest one in few evaluations."""
    asked = []

    def field(y):
        asked.append(len(y))
        known = np.where(y[:, 1] < 0.7, 1.0, np.nan)
        return (y[:, 0] - 0.5) * known, np.tile([1.0, 0.0], (len(y), 1)) * known[:, None]

    (path,), returned = boundaries._follow(field, np.array([[0.5, 0.3]]), np.ones(1))
    assert path[-1] == pytest.approx([0.5, 0.7], abs=1e-6) and not returned.any()
    assert len(asked) < 400
