"""The remark of a finished run whose values miss the tolerance: how many, the largest bound, and the verdicts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np

from drivetrain_jax.analysis import OUTCOME, Outcome
from drivetrain_jax.store.reading import opened

_BOUND, _VERDICT, _UNDECIDED = "spectral_radius_error", "verdict", 2


def missed(out: Path, count: int, total: int) -> str:
    """The remark about ``count`` of ``total`` values of the result at ``out``; a Zarr store gives only these numbers."""
    text = f"{count:,} of {total:,} values {'misses' if count == 1 else 'miss'} the tolerance"
    mark = f"{OUTCOME.name} = {int(Outcome.TOLERANCE_NOT_MET)} marks {'it' if count == 1 else 'them'}"
    if out.is_dir():
        return f"{text}; {mark}"
    with cast(Any, opened(out)) as file:
        rtol = json.loads(file.attrs.get("options", "{}")).get("rtol")
        text += f" {rtol:g}" if rtol else ""
        outcome = file[OUTCOME.name]
        places = np.flatnonzero(outcome[()] == Outcome.TOLERANCE_NOT_MET)
        if _BOUND in file:
            bounds = file[_BOUND][()].reshape(-1)[places]
            place = np.unravel_index(places[np.argmax(bounds)], outcome.shape)
            axes = {dim[0].name.strip("/"): dim[0][i] for dim, i in zip(outcome.dims, place, strict=True)}
            at = ", ".join(f"{name} = {value:.6g}" for name, value in axes.items())
            text += f" (largest error bound {bounds.max():.1e}, at {at})"
        if _VERDICT in file:
            undecided = int((file[_VERDICT][()].reshape(-1)[places] == _UNDECIDED).sum())
            text += f"; {undecided:,} of them undecided" if undecided else "; the verdicts are decided"
    return f"{text}; {mark}"
