"""Approximate responses of oscillators: harmonic balance, describing function, multiple scales."""
