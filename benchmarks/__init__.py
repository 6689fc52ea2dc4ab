"""Measurements behind the choices and claims of drivetrain_jax, each a command ``python -m benchmarks.NAME``."""
