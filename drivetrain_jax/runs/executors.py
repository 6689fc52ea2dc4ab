"""Choose the executor of a run."""

from __future__ import annotations

import re

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax._machine import usable_cores
from drivetrain_jax._wording import shown
from drivetrain_jax.runs.executor import Executor, Threads

# Most threads or processes, unless four a core are more.
_MOST = 64


def make_executor(threads: int | None = None, workers: int | None = None, dask: str | None = None) -> Executor:
    """The executor: ``workers`` processes, Dask at ``dask`` (``tcp://host:port`` or ``local:N``), or ``threads``.

    Raises :class:`InputError` for invalid or conflicting settings.
    """
    for name, value in (("threads", threads), ("workers", workers)):
        if value is not None and not (_is_integer(value) and value >= 1):
            raise InputError(f"{name} = {shown(value)}: allowed is {name} >= 1, an integer")
        if value is not None and value > (most := max(_MOST, 4 * usable_cores())):
            raise InputError(f"{name} = {value}: allowed is {name} <= {most}, because more only wait for a core")
    if dask is not None and not re.match(r"local:[1-9]\d*$|\w+://", str(dask)):
        raise InputError(f"dask = {dask!r}: allowed is tcp://HOST:PORT or local:N with N >= 1")
    settings = {"threads": threads, "workers": workers, "dask": dask}
    given = [name for name, value in settings.items() if value is not None]
    if len(given) > 1:
        raise InputError(f"{given[0]}: given together with {given[1]}; allowed is one of them")
    # Local imports: most runs need neither.
    if workers is not None:
        from drivetrain_jax.runs.processes import Processes

        return Processes(workers)
    if dask is not None:
        from drivetrain_jax.runs.cluster import Cluster

        return Cluster(dask)
    return Threads(threads)


def _is_integer(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
