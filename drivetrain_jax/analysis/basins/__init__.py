"""Basins of attraction of oscillators with play."""
