"""Compilation for tests whose kernels run for milliseconds, where optimising takes longer than all the rest."""

from __future__ import annotations

from collections.abc import Callable

import jax

from drivetrain_jax.analysis.numerics.kernels import options_for_few


def quick_jit(function: Callable) -> Callable:
    """``function`` compiled as the engine compiles kernels for a few points."""
    return jax.jit(function, compiler_options=options_for_few())
