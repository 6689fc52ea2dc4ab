"""Generate docs/validation/<system>.md: published and computed values, and the reasons of their differences.

    python -m benchmarks.validation [SYSTEM ...] [--full]      # --full: comparisons over whole charts, not samples

Numbers of the package are compared with independent ones by NumPy and SciPy where that is feasible.
"""
