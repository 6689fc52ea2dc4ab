"""Uneven rotation of a rigid driveline, and the phases of its yokes that minimise it."""

from drivetrain_jax.analysis.parameters.analysis import constants

ANALYSIS = constants("phasing", "phases of the yokes")
