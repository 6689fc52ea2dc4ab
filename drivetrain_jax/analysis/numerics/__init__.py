"""Shared numerics: small linear algebra, roots, lanes of a batch, compilation of kernels."""

import drivetrain_jax.systems  # noqa: F401  double precision
