"""Modes of discrete systems: frequencies, types, tracking, gradients."""
