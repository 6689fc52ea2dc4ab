"""Measurements behind the choices and claims of drivetrain_jax: ``python -m benchmarks`` runs all of them."""
