"""Frequency responses of oscillators with play: exact, harmonic balance, describing function, multiple scales."""
