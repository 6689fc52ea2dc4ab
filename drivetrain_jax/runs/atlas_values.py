"""Values that are given to an atlas: compared with its fixed ones, as text, and broadcast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import shown

if TYPE_CHECKING:
    import xarray as xr

# Relative tolerance within which a value equals a fixed parameter of an atlas.
SAME_FIXED = 5e-4


def check_same(name: str, value: Any, fixed: float, source: str = "") -> None:
    """Raise :class:`InputError` unless ``value`` is the ``fixed`` one of the atlas, which may be typed with four digits.

    ``source`` names the physical data from which it follows.
    """
    if isinstance(value, tuple) or not np.allclose(value, fixed, rtol=SAME_FIXED, atol=0):
        made = f"the atlas is made for {name} = {fixed:.10g}"
        given = f"{name} = {as_given(value)}" + (f" (from {source})" if source else "")
        raise InputError(f"{given}: {made}; allowed is that value")


def as_given(value: Any) -> str:
    """A number or a range as text: ``1.3:1.5``."""
    ends = value if isinstance(value, tuple) else (value,)
    return ":".join(f"{end:.10g}" if isinstance(end, (int, float)) else shown(end) for end in ends)


def broadcast(given: Mapping[str, Any]) -> tuple[xr.DataArray, ...]:
    """Arrays of one shape: unlabelled ones are broadcast by position, then all by dimension names."""
    import xarray as xr

    plain = {name: np.asarray(v, float) for name, v in given.items() if not isinstance(v, xr.DataArray)}
    try:
        plain = dict(zip(plain, np.broadcast_arrays(*plain.values()), strict=True))
        labelled: dict[str, Any] = {
            n: xr.DataArray(v, dims=("point",) if v.ndim == 1 else None) for n, v in plain.items()
        }
        arrays = [labelled.get(name, value) for name, value in given.items()]
        # The default of `broadcast` is the union of labels, with NaN for missing ones.
        return xr.broadcast(*xr.align(*arrays, join="exact", copy=False))
    except ValueError:
        shapes = ", ".join(f"{name} {np.shape(value)}" for name, value in given.items())
        allowed = "arrays that broadcast against each other, of the same labels along a dimension that they share"
        raise InputError(f"shapes {shapes}: allowed are {allowed}") from None
