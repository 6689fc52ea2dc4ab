"""The analyses by name. Each one solves a single point, independent of grids, files and figures."""

from __future__ import annotations

from importlib import import_module

from drivetrain_jax.analysis._base import OUTCOME, RTOL, Analysis, Outcome, Request, Solver

_ANALYSES = {
    "floquet": "floquet",
    "atlas": "atlas",
    "forced": "forced",
    "frequency_response": "frequency_response",
    "history": "history",
    "lyapunov": "lyapunov",
    "poincare": "poincare",
    "parameters": "parameters",
    "modes": "modes",
    "steady_state": "steady_state",
    "basins": "basins",
    "critical_speeds": "critical_speeds",
}

__all__ = ["OUTCOME", "RTOL", "Analysis", "Outcome", "Request", "Solver", "analysis_names", "get_analysis"]


def analysis_names() -> tuple[str, ...]:
    """Names of all analyses."""
    return tuple(_ANALYSES)


def get_analysis(name: str) -> Analysis:
    """The analysis called ``name``; ``KeyError`` with the known names if there is none."""
    if name not in _ANALYSES:
        raise KeyError(f"analysis = {name!r}: allowed is one of {', '.join(_ANALYSES)}")
    return import_module(f"drivetrain_jax.analysis.{_ANALYSES[name]}").ANALYSIS
