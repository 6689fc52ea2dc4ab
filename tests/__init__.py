"""Tests; a package, so that test files and benchmarks share their oracles."""
