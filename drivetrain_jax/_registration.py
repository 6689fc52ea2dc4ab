"""Registration of the accessor after xarray is imported: ``import drivetrain_jax`` alone does not import xarray."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

_NAME = "drivetrain"


def register_accessor() -> None:
    """Give every Dataset the accessor ``drivetrain``: now, or as soon as xarray is imported."""
    if "xarray" in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _AfterXarray())


def _register() -> None:
    xr = import_module("xarray")
    if not hasattr(xr.Dataset, _NAME):
        accessor = import_module("drivetrain_jax.datasets.accessor").DrivetrainAccessor
        xr.register_dataset_accessor(_NAME)(accessor)


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
        spec = find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: Any) -> None:
            execute(module)
            _register()

        spec.loader.exec_module = execute_and_register
        return spec
