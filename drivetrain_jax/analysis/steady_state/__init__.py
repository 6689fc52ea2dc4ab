"""Steady states of oscillators with play."""
