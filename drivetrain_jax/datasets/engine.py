"""The engine ``drivetrain`` of xarray: opens an atlas as a lazy Dataset.

xarray imports this module whenever it looks for an engine. Modules that compute are therefore imported later, when an atlas
is opened.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from xarray.backends import BackendEntrypoint

from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import shown
from drivetrain_jax.store.files import ATLAS_PREFACE

if TYPE_CHECKING:
    import xarray as xr

_GAPS = ("solve", "nan")
# Most cells of a chunk of automatic size, and most cells along one axis.
_CHUNK, _LONGEST = 1 << 18, 1 << 10


class AtlasEntrypoint(BackendEntrypoint):
    """Opens an atlas on any grid; cells are evaluated when they are accessed."""

    description: ClassVar[str] = "Open a stability atlas of drivetrain_jax on any grid"
    url: ClassVar[str] = ""

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """True if the file begins with the preface of an atlas. Copies by other tools need ``engine="drivetrain"``."""
        if not isinstance(filename_or_obj, (str, os.PathLike)) or not os.path.isfile(filename_or_obj):
            return False
        try:
            with open(filename_or_obj, "rb") as file:
                return file.read(len(ATLAS_PREFACE)) == ATLAS_PREFACE
        except OSError:
            return False

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        grid: Any = None,
        gaps: str = "solve",
    ) -> xr.Dataset:
        """The results of an atlas file on a grid, evaluated lazily.

        Args:
            filename_or_obj: path of the file.
            drop_variables: names of results to leave out.
            grid: a mapping from names of parameters, or of physical data, to a number of values between the ends of the
                atlas, ``(start, stop, num)``, a row of values, or one value (a float); or one number of values for all
                parameters. Default: 512.
            gaps: cells in a gap of the atlas are solved directly (``solve``), or have no value and the outcome ``gap``
                (``nan``).

        Returns: a Dataset with the names and attributes of a ``floquet`` result. The cells of a selection are evaluated
        together, so a cell may have other last digits in another selection, within its ``spectral_radius_error``.

        Raises: InputError for a file that is not an atlas or is damaged, and for a grid that reaches beyond the atlas.
        """
        if not isinstance(filename_or_obj, (str, os.PathLike)):
            kind = type(filename_or_obj).__name__
            raise InputError(f"filename_or_obj: got a {kind}; allowed is the path of the file of an atlas")
        if gaps not in _GAPS:
            raise InputError(f"gaps = {shown(gaps)}: allowed is one of {', '.join(_GAPS)}")
        path = os.path.abspath(os.path.expanduser(os.fspath(filename_or_obj)))
        dropped = {drop_variables} if isinstance(drop_variables, str) else set(drop_variables or ())
        return _opened(path, grid, gaps == "solve").drop_vars(dropped, errors="ignore")


def _opened(path: str, grid: Any, solve: bool) -> xr.Dataset:
    import numpy as np
    import xarray as xr
    from xarray.core import indexing

    from drivetrain_jax.analysis import OUTCOME
    from drivetrain_jax.datasets.lazy import GAP, AtlasArray, AtlasGrid, grid_values, in_atlas_parameters, whole
    from drivetrain_jax.runs.assemble import to_dataset
    from drivetrain_jax.runs.atlas_chart import in_physical_units

    grid, views = in_atlas_parameters(whole(path), grid)
    axes, fixed = grid_values(whole(path), grid)
    cells = AtlasGrid(path, axes, fixed, solve)
    atlas = cells.atlas
    point = atlas.stability.blank((), atlas.request.outputs)
    shape = tuple(len(values) for values in axes.values())
    # Broadcast numbers take no memory.
    blank = {name: np.broadcast_to(value, (*shape, *value.shape)) for name, value in point.items()}
    dataset = to_dataset(atlas.scene_on(axes), blank, {})
    degrees = np.max([(0,) * len(axes), *(panel.degrees for panel in atlas.stability.atlas.panels)], axis=0)
    chunks = _chunks(axes, dict(zip(atlas.parameters, degrees.tolist(), strict=True)))
    for name, value in point.items():
        variable = dataset[name].variable
        data = indexing.LazilyIndexedArray(AtlasArray(cells, name, value.shape, value.dtype))
        sizes = dict(zip(variable.dims, variable.shape, strict=True))
        dataset[name] = xr.Variable(variable.dims, data, variable.attrs, {"preferred_chunks": sizes | chunks})
    if not solve:
        about = dataset[OUTCOME.name].attrs
        about["flag_values"] = np.arange(GAP + 1, dtype=OUTCOME.dtype)
        about["flag_meanings"] += " gap"
    dataset = dataset.assign_coords({name: ((), value, atlas.labels(name)) for name, value in fixed.items()})
    for name, (quantity, convert) in views.items():
        dataset = in_physical_units(dataset, name, quantity, convert)
    return dataset


def _chunks(axes: dict[str, Any], degrees: dict[str, int]) -> dict[str, int]:
    """Sizes of chunks by axis, equal for all chunks where possible, because each size needs its own kernels.

    Chunks are long along the two longest axes, whose cells are evaluated together. Among axes of equal length, those with
    low ``degrees`` come first, which take less work.
    """
    longest = sorted(axes, key=lambda name: (-len(axes[name]), degrees[name]))
    chunks, left = {}, _CHUNK
    for name in longest:
        length = len(axes[name])
        most = math.isqrt(_CHUNK) if name == longest[0] and len(axes) > 1 else left
        chunks[name] = -(-length // -(-length // max(1, min(length, most, _LONGEST))))
        left //= chunks[name]
    return {name: chunks[name] for name in axes}
