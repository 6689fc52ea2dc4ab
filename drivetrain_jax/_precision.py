"""Double precision, which the package turns on; ``DRIVETRAIN_JAX_ENABLE_X64=0`` leaves the choice to the caller."""

from __future__ import annotations

import os
import sys


def use_double_precision() -> None:
    """Turn on double precision in jax, or in the jax that this process will import.

    The package calls this at its import, because its first computation may be inside a function that jax is tracing.
    """
    if os.environ.get("DRIVETRAIN_JAX_ENABLE_X64") == "0":
        return
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        os.environ["JAX_ENABLE_X64"] = "1"
