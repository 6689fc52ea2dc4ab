"""Stepped shafts: transfer matrices, certified roots, mode shapes."""
