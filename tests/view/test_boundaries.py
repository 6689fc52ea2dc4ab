"""Positions of the names of tips of tongues."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax.atlas.tips import Tip, Tips
from drivetrain_jax.runs.atlas_chart import _tips
from drivetrain_jax.systems import get_system
from drivetrain_jax.view import plot
from tests.view import results


def tipped(beta: list[float], opens: list[int] | None, omega: list[float]):
    """The chart of one tongue, with beta upwards from 0 to 1 and tips at these points."""
    names = [f"S{number}" for number in range(1, len(beta) + 1)]
    dataset = results.chart().assign_coords(
        tip=("tip", names),
        tip_proved=("tip", np.ones(len(beta), np.int8)),
        tip_beta=("tip", beta),
        tip_Omega=("tip", omega),
    )
    return dataset if opens is None else dataset.assign_coords(tip_opens=("tip", np.array(opens, np.int8)))


def sides(dataset) -> dict[tuple[float, float], tuple[int, int]]:
    """Direction from each named tip to its name."""
    # Names of predicted lines have leaders, those of tips have none.
    names = [text for text in plot(dataset).axes[0].texts if text.arrow_patch is None]
    return {tuple(map(float, name.xy)): tuple(int(np.sign(x)) for x in name.xyann) for name in names}


DOWN, UP = (0, -1), (0, 1)


@pytest.mark.parametrize(("opens", "side"), [([1], DOWN), (None, DOWN), ([0], UP)])
def test_a_name_stands_where_the_tongue_is_not(opens, side):
    assert sides(tipped([0.5], opens, [1.0])) == {(1.0, 0.5): side}


def test_a_chart_tells_which_way_tongues_open():
    point, error = {"zeta": 0.01, "Omega": 0.7}, {"zeta": 1e-9, "Omega": 1e-9}
    tips = tuple(Tip("H21", "+1", point, error, opens) for opens in (False, True))
    found = _tips(Tips(tips, ()), get_system("cardan"), ("zeta", "Omega"))
    dims, values, attrs = found["tip_opens"]
    assert dims == "tip" and values.tolist() == [0, 1] and attrs["long_name"].endswith("as zeta rises")
