"""Exclusion and zero curves on known polynomials."""

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


def curves(coefficients, tips=()):
    """The zero curves of a polynomial over [-1, 1]^2 on lines along its first coordinate."""
    found = boundaries.ZeroSet(one_patch(coefficients), 0).curves(np.array(tips).reshape(-1, 2))
    for curve in found:
        assert np.abs(np.diff(curve, axis=0)).max() < 0.032
        value = np.polynomial.chebyshev.chebval2d(*curve.T, np.array(coefficients))
        known = (np.abs(curve[:, None] - np.array(tips).reshape(1, -1, 2)) < 1e-12).all(axis=2).any(axis=1)
        assert np.abs(value[~known]).max() < 1e-12
    return found


def test_a_curve_runs_from_rim_to_rim():
    """The parabola h = (2 v^2 - 1)/5, and a line that leaves through the other two sides, almost along the lines."""
    (curve,) = curves([[0.0, 0.0, -0.2], [1.0, 0.0, 0.0]])
    assert sorted(curve[[0, -1], 1]) == [-1.0, 1.0] and abs(abs(np.diff(curve[:, 1]).sum()) - 2) < 1e-12
    (line,) = curves([[0.0, -20.0], [1.0, 0.0]])
    assert sorted(map(tuple, line[[0, -1]])) == [pytest.approx((-1, -0.05)), pytest.approx((1, 0.05))]


@pytest.mark.parametrize("tips", [[], [[0.0, 0.0]]], ids=["unknown", "known"])
def test_a_curve_turns_at_its_tip(tips):
    """The parabola v = h^2."""
    (curve,) = curves([[0.5, -1.0], [0.0, 0.0], [0.5, 0.0]], tips)
    assert sorted(curve[[0, -1], 0]) == pytest.approx([-1, 1])
    assert curve[:, 1].min() == 0 if tips else curve[:, 1].min() < 1e-3


def test_a_closed_curve_ends_where_it_began():
    """The circle of radius 1/2 goes around once."""
    (curve,) = curves([[0.75, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], [[0.0, -0.5], [0.0, 0.5]])
    assert np.array_equal(curve[0], curve[-1])
    assert np.linalg.norm(np.diff(curve, axis=0), axis=1).sum() == pytest.approx(np.pi, rel=1e-3)


def test_the_edges_of_a_narrow_tongue_are_two_curves():
    """h^2 = 1e-8."""
    found = curves([[0.5 - 1e-8, 0.0], [0.0, 0.0], [0.5, 0.0]])
    assert sorted(curve[:, 0].mean() for curve in found) == pytest.approx([-1e-4, 1e-4])


def test_segments_leave_out_points_that_are_not_limiting():
    points = {"beta": np.arange(5.0), "Omega": np.arange(5.0)}
    limiting = np.array([True, True, False, True, True])
    curve = boundaries.Boundary("pair", points, limiting)
    assert [part["beta"].tolist() for part in curve.segments()] == [[0.0, 1.0], [3.0, 4.0]]


@pytest.mark.parametrize(("foot", "width"), [(-0.5, 1e-6), (0.0, 1e-6), (0.0, 1e-7)])
def test_points_lie_on_the_edges_of_a_narrow_slanted_tongue(foot, width):
    """The tongue is (h - 0.3 v - 0.3 v^2)^2 = width (v - foot), slanted at its tip except in the first case."""
    t = np.cos(np.pi * (np.arange(8) + 0.5) / 8)
    analysis = np.linalg.inv(np.polynomial.chebyshev.chebvander(t, 7))
    h, v = np.meshgrid(t, t, indexing="ij")
    values = (h - 0.3 * v - 0.3 * v**2) ** 2 - width * (v - foot)
    (curve,) = curves(analysis @ values @ analysis.T, [[0.3 * foot + 0.3 * foot**2, foot]])
    h, v = curve.T
    top = np.argmin(np.abs(v - foot))
    side = np.sign(h - 0.3 * v - 0.3 * v**2)
    assert len(set(side[:top])) == len(set(side[top + 1 :])) == 1 and side[0] == -side[-1]
    assert v[0] == v[-1] == 1.0 and v[top] == foot
