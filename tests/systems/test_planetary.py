"""The planetary gear: what is refused."""

from __future__ import annotations

import pytest

from drivetrain_jax._errors import InputError
from drivetrain_jax.runs.scene import load_scene


def test_lists_have_one_entry_per_planet():
    scene = {
        "system": "planetary",
        "analysis": "modes",
        "fixed": {"m_p": [1.0, 2.0]},
        "axes": {"k_p": {"values": [1e8]}},
    }
    with pytest.raises(InputError) as refusal:
        load_scene(scene)
    said = "fixed.m_p = [1.0, 2.0]: 2 entries where planet_angle has 4; allowed is one number, or one entry per planet"
    assert str(refusal.value) == said
