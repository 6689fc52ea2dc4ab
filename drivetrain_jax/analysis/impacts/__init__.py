"""Piecewise linear oscillators: the exact flow, attractors, branches of orbits."""

import drivetrain_jax.systems  # noqa: F401  double precision
