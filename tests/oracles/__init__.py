"""Independent computations that tests and benchmarks compare with."""
