"""Modes of discrete systems: types, tracking, gradients."""
