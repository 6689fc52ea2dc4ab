"""Forced response: periodic solutions of linear and nonlinear systems."""
