"""Shared numerics: small linear algebra, roots, lanes of a batch, compilation of kernels."""
