"""Piecewise linear oscillators: the exact flow, attractors, branches of orbits."""
