"""Tables of docs/theory: tips of the base case, and numbers of polynomials for each coordinate of the angle."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from test_tips import TIPS

from tests.oracles.atlas_direct import BASE, propagators

THEORY = Path(__file__).parents[2] / "docs" / "theory"
# Coordinate of the angle and its inverse, in the order of the table.
COORDINATES = (
    (lambda beta: np.tan(beta / 2) ** 2, lambda x: 2 * np.arctan(np.sqrt(x))),
    (lambda beta: np.arctanh(np.sin(beta)), lambda x: np.arcsin(np.tanh(x))),
    (lambda beta: -np.log(np.cos(beta)), lambda x: np.arccos(np.exp(-x))),
)


def test_tips_of_the_page():
    text = (THEORY / "boundaries.md").read_text()
    found = re.findall(r"^\| ([SHC][+-]?\d+) \| \S+ \| ([\d.]+) \| ([\d.]+) \|$", text, re.M)
    assert [name for name, *_ in found] == list(TIPS)
    for name, *printed in found:
        for value, digits in zip(TIPS[name], printed, strict=True):
            assert value == pytest.approx(float(digits), abs=0.501 * 10.0 ** -len(digits.partition(".")[2])), name


def needed(forward, backward, top: float, speed: float, count: int = 96) -> int:
    """Number of polynomials up to the last coefficient above 1e-11 of the largest entry of Phi."""
    nodes = np.pi * (np.arange(count) + 0.5) / count
    x = forward(top) * (1 + np.cos(nodes)) / 2
    phi = propagators({**BASE, "beta": backward(x), "Omega": speed}, 1e-14)
    coefficients = 2 / count * np.cos(np.outer(np.arange(count), nodes)) @ phi
    return int(np.flatnonzero(np.abs(coefficients).max(axis=1) > 1e-11 * np.abs(phi).max()).max()) + 1


@pytest.mark.full
def test_polynomials_that_the_coordinates_of_the_angle_need():
    rows = re.findall(r"^\| (1\.\d+) \| (\d+) \| (\d+) \| (\d+) \|$", (THEORY / "atlas.md").read_text(), re.M)
    assert len(rows) == 4
    for top, *printed in rows:
        for (forward, backward), number in zip(COORDINATES, printed, strict=True):
            found = max(needed(forward, backward, float(top), speed) for speed in (0.1, 0.3, 1.0))
            # The last coefficient may be at the limit.
            assert abs(found - int(number)) <= 1
