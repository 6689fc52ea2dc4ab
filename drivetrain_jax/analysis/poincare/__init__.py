"""Poincare sections and their errors."""
