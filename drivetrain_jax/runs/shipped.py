"""Scenes of the package by name: ``quickstart`` is ``sweeps/quickstart.toml``."""

from __future__ import annotations

from pathlib import Path

import drivetrain_jax
from drivetrain_jax._wording import did_you_mean

# In a checkout this is a link to the folder at the top; in a wheel it contains the files.
FOLDER = Path(drivetrain_jax.__file__).parent / "sweeps"


def names() -> list[str]:
    """Names of these scenes, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def scene_file(source: Path) -> Path:
    """The packaged file if ``source`` is the name of a scene and not of an existing file, else ``source``."""
    return FOLDER / f"{source}.toml" if str(source) in names() and not source.is_file() else source


def remedy(source: Path) -> str:
    """The remedy for a ``source`` that cannot be read."""
    return f"give the path of a scene file, or a name of `drivetrain list`{did_you_mean(str(source), names())}"
