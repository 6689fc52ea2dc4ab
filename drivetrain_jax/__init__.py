"""Stability and vibration of drivetrains in JAX: systems are pytrees, and analyses are pure functions of systems.

``floquet(Cardan(...))`` and the other analyses accept one system and work under ``jax.jit``, ``jax.vmap`` and ``jax.grad``.
``sweep`` computes an analysis, or any function of yours, on a grid and returns one labelled dataset. ``run`` computes a
scene file, ``point`` one parameter set. Wrong input raises ``InputError``. A failed computation raises ``ChunkError``, or
``Incomplete`` if a file can be resumed. Heavy modules are imported on first use.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivetrain_jax._errors import ChunkError, InputError
from drivetrain_jax._machine import use_double_precision

if TYPE_CHECKING:
    from drivetrain_jax.analyses import (
        Result,
        basins,
        critical_speeds,
        floquet,
        forced,
        frequency_response,
        harmonic_response,
        history,
        lyapunov,
        modes,
        phasing,
        poincare,
        steady_state,
        whirl,
    )
    from drivetrain_jax.datasets.figure import plot
    from drivetrain_jax.runs.atlas_file import open_atlas
    from drivetrain_jax.runs.output import open_result
    from drivetrain_jax.runs.over import sweep
    from drivetrain_jax.runs.point import point
    from drivetrain_jax.runs.run import Incomplete, Interrupted, run
    from drivetrain_jax.systems import register
    from drivetrain_jax.systems.bicardan import Bicardan
    from drivetrain_jax.systems.cardan import Cardan
    from drivetrain_jax.systems.driveline import Driveline
    from drivetrain_jax.systems.planetary import Planetary
    from drivetrain_jax.systems.rattle import Rattle
    from drivetrain_jax.systems.tripod import Tripod

__version__ = "0.3.0"

# Modules of the names; all others are in `analyses`.
_HOME = {
    "datasets.figure": ("plot",),
    "runs.atlas_file": ("open_atlas",),
    "runs.over": ("sweep",),
    "runs.output": ("open_result",),
    "runs.point": ("point",),
    "runs.run": ("Incomplete", "Interrupted", "run"),
    "systems": ("register",),
    "systems.bicardan": ("Bicardan",),
    "systems.cardan": ("Cardan",),
    "systems.driveline": ("Driveline",),
    "systems.planetary": ("Planetary",),
    "systems.rattle": ("Rattle",),
    "systems.tripod": ("Tripod",),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Bicardan",
    "Cardan",
    "ChunkError",
    "Driveline",
    "Incomplete",
    "InputError",
    "Interrupted",
    "Planetary",
    "Rattle",
    "Result",
    "Tripod",
    "__version__",
    "basins",
    "critical_speeds",
    "floquet",
    "forced",
    "frequency_response",
    "harmonic_response",
    "history",
    "lyapunov",
    "modes",
    "open_atlas",
    "open_result",
    "phasing",
    "plot",
    "poincare",
    "point",
    "register",
    "run",
    "steady_state",
    "sweep",
    "whirl",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE.get(name, 'analyses')}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def _register_accessor() -> None:
    """Give every Dataset of xarray, which is imported, the accessor ``drivetrain``."""
    xr = sys.modules["xarray"]
    if not hasattr(xr.Dataset, "drivetrain"):
        # Imported at the first use: the module of the accessor may be the one that imports xarray.
        module = f"{__name__}.datasets.accessor"
        xr.register_dataset_accessor("drivetrain")(lambda dataset: import_module(module).DrivetrainAccessor(dataset))


class _AfterXarray:
    """Import finder that leaves xarray to the other finders, and registers the accessor after its import.

    It does not inherit from :class:`importlib.abc.MetaPathFinder`, whose import takes longer than that of this package.
    """

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """The specification of xarray; None for every other module."""
        if name != "xarray" or self not in sys.meta_path:
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        if (spec := find_spec(name)) and (loader := spec.loader):
            execute = loader.exec_module
            loader.exec_module = lambda module: (execute(module), _register_accessor())[0]
        return spec


use_double_precision()
# This package alone does not import xarray.
if "xarray" in sys.modules:
    _register_accessor()
else:
    sys.meta_path.insert(0, _AfterXarray())
