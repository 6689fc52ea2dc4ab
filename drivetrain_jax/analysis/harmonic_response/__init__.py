"""Steady vibration under harmonic forces."""
