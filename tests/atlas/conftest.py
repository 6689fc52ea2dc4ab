from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def chart():
    """The first chart of the theory page: beta to 1.5, Omega from 0.3 to 2, to 1e-11."""
    from tests.oracles.atlas_direct import cardan_atlas

    return cardan_atlas({"beta": (0.0, 1.5), "Omega": (0.3, 2.0)}, 1e-11)


@pytest.fixture(scope="session")
def undamped():
    """A chart without damping, to 1e-10."""
    from tests.oracles.atlas_direct import BASE, cardan_atlas

    return cardan_atlas({"beta": (0.0, 1.2), "Omega": (0.3, 2.0)}, 1e-10, {**BASE, "zeta": 0.0})
