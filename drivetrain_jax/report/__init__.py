"""One HTML file about one or more results: the answer first, then figures, error bounds and the scene."""

from drivetrain_jax.report.page import report

__all__ = ["report"]
