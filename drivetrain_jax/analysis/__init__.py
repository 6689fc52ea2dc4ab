"""The analyses by name. Each one solves a single point, independent of grids, files and figures.

Other packages add analyses through the entry point group ``drivetrain_jax.analyses``; each entry point names an
:class:`Analysis`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivetrain_jax._errors import InputError, did_you_mean, nearest
from drivetrain_jax._plugins import ANALYSES, load_plugin, plugin_names
from drivetrain_jax._quantities import Dimension, Parameter, Variable

if TYPE_CHECKING:
    from drivetrain_jax.analysis._base import OUTCOME, RTOL, Analysis, Outcome, Request, Solver, forward_derivatives
    from drivetrain_jax.analysis.numerics.lanes import over_lanes
    from drivetrain_jax.systems import System

# Modules of this package and the names of the analyses in them.
_BUILT_IN = {
    "floquet": "floquet.analysis:ANALYSIS",
    "atlas": "atlas:ANALYSIS",
    "forced": "forced.analysis:ANALYSIS",
    "frequency_response": "frequency_response.analysis:ANALYSIS",
    "history": "history.analysis:ANALYSIS",
    "lyapunov": "lyapunov.analysis:ANALYSIS",
    "poincare": "poincare:ANALYSIS",
    "parameters": "constants:PARAMETERS",
    "phasing": "constants:PHASING",
    "modes": "modes:ANALYSIS",
    "harmonic_response": "harmonic_response:ANALYSIS",
    "steady_state": "steady_state:ANALYSIS",
    "basins": "basins:ANALYSIS",
    "critical_speeds": "critical_speeds.analysis:ANALYSIS",
    "whirl": "critical_speeds.whirl:ANALYSIS",
}

__all__ = [
    "OUTCOME", "RTOL", "Analysis", "Dimension", "Outcome", "Parameter", "Request", "Solver", "Variable", "analyses_of",
    "analysis_names", "analysis_of", "forward_derivatives", "get_analysis", "over_lanes",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    # Imported on first use: figures and rules are submodules of this package and must import without jax.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{'numerics.lanes' if name == 'over_lanes' else '_base'}"), name)


def analysis_names() -> tuple[str, ...]:
    """Names of all analyses: the built-in ones, then those of installed packages."""
    return (*_BUILT_IN, *(name for name in plugin_names(ANALYSES) if name not in _BUILT_IN))


def get_analysis(name: str) -> Analysis:
    """The analysis ``name``; :class:`InputError` with the known names if there is none, or if its package fails."""
    if name in _BUILT_IN:
        module, _, record = _BUILT_IN[name].partition(":")
        return getattr(import_module(f"{__name__}.{module}"), record)
    from drivetrain_jax.analysis._base import Analysis

    analysis = load_plugin(ANALYSES, name, "an analysis", lambda x: isinstance(x, Analysis))
    if analysis is None:
        raise InputError(f"analysis = {name!r}: unknown{nearest(str(name), analysis_names())}")
    if analysis.uses and analysis.uses not in analysis_names():
        raise InputError(
            f"analysis = {name!r}: uses = {analysis.uses!r}: no analysis{nearest(analysis.uses, analysis_names())}"
        )
    return analysis


def analysis_of(system: type[System], name: str) -> Analysis:
    """The analysis ``name`` of ``system``, with what it declares; :class:`InputError` if it has no model for it."""
    analysis = get_analysis(name) if name in analysis_names() else None
    # The model first: only a system with one declares what the analysis takes from its class.
    if analysis is None or (analysis.uses or analysis.name) not in system.models:
        known = analyses_of(system)
        guess = did_you_mean(str(name), known)
        raise InputError(f"analysis = {name!r}: unknown to {system.name}{guess}; expected one of {', '.join(known)}")
    return analysis.for_system(system)


def analyses_of(system: type[System]) -> tuple[str, ...]:
    """Names of the analyses of ``system``: those it has a model for, and those that use such a model (``Analysis.uses``)."""
    served = dict.fromkeys(system.models)
    for name in plugin_names(ANALYSES):
        try:
            uses = get_analysis(name).uses
        except InputError:
            # Skip a package that fails to import; `broken_analyses` reports its error.
            continue
        served |= dict.fromkeys([name] if uses in system.models else [])
    return tuple(served)


def broken_analyses() -> dict[str, str]:
    """The reasons why analyses of installed packages cannot be used, by name."""
    reasons = {}
    for name in plugin_names(ANALYSES):
        try:
            get_analysis(name)
        except InputError as error:
            reasons[name] = str(error).partition(": ")[2]
    return reasons
