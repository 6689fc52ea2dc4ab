"""Draw the figure of results in memory or in files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from drivetrain_jax import view
from drivetrain_jax.store.consolidate import open_result

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


def plot(result: xr.Dataset | str | Path, *others: xr.Dataset | str | Path) -> Figure:
    """A matplotlib figure of ``result``, a dataset or the path of a result file.

    Args:
        others: results of the same analysis by other methods, drawn into the same axes (``frequency_response``).

    Returns: a figure without a window; save it with ``figure.savefig("chart.png")``.

    Raises: :class:`~drivetrain_jax.InputError` for a result that has no figure.

    >>> import drivetrain_jax as dt, numpy as np
    >>> shaft = dt.Cardan(beta=0.3, Omega=1.4, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    >>> chart = dt.sweep(dt.floquet, shaft, over={"beta": np.linspace(0, 1, 3), "Omega": np.linspace(1.3, 1.5, 3)})
    >>> type(dt.plot(chart)).__name__
    'Figure'
    """
    return view.plot(*(open_result(Path(r)) if isinstance(r, (str, Path)) else r for r in (result, *others)))
