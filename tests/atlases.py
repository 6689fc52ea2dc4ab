"""Atlases that tests only read, computed once for all tests, processes and runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

import drivetrain_jax as dt
from drivetrain_jax.runs.output import status

# A shaft of a data sheet, around its first resonance.
SHAFT = {
    "system": "cardan",
    "analysis": "atlas",
    "axes": {"speed": {"start": "22 Hz", "stop": "25 Hz"}, "c1": {"start": "0.1 N m s/rad", "stop": "0.5 N m s/rad"}},
    "fixed": {"J1": 2.0, "J2": 0.5, "k1": 6e4, "k2": 4e4, "alpha": 0.4082, "angle": 12.0},
}
FOLDER = Path(__file__).parents[1] / ".pytest_cache" / "atlases"


def atlas_file(scene: Mapping[str, Any]) -> Path:
    """File of the atlas of ``scene``; a file whose digest is not that of the package's code is replaced."""
    content = json.dumps([scene, os.environ.get("XLA_FLAGS", "")], sort_keys=True)
    path = FOLDER / f"{hashlib.blake2b(content.encode(), digest_size=8).hexdigest()}.nc"
    FOLDER.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if status(scene, path).state != "complete":
            dt.run(scene, out=path, fresh=True)
    return path


def stored_atlas(scene: Mapping[str, Any]) -> Any:
    """The opened :func:`atlas_file` of ``scene``."""
    return dt.open_atlas(atlas_file(scene))
