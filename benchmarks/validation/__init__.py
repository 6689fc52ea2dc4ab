"""docs/validation/<system>.md, regenerated: what a paper prints, what this package computes, and why they differ.

    python -m benchmarks.validation [SYSTEM ...] [--full]      # --full: comparisons over whole charts, not samples

Every number of the package is set beside an independent one by NumPy and SciPy where that is feasible.
"""
