"""Claims of the cardan paper against SciPy: printed equations and criterion."""

from __future__ import annotations

import pytest

from tests.oracles.cardan_paper import printed_matrices, unstable_fraction
from tests.oracles.cardan_reference import damping_and_stiffness

# Every tenth angle and speed of the base chart: 16 x 20 cells.
STRIDE = 10


def test_printed_equations_are_unstable_everywhere():
    assert unstable_fraction(printed_matrices(1.0), STRIDE)[0] > 0.98


def test_correcting_one_sign_alone_gives_a_blank_chart():
    assert unstable_fraction(printed_matrices(-1.0), STRIDE)[0] == 0


def test_second_clause_of_the_criterion_drops_most_cells():
    fraction, dropped = unstable_fraction(damping_and_stiffness, STRIDE)
    assert fraction == pytest.approx(0.256, abs=0.03)
    assert 0.6 < dropped < 0.8
