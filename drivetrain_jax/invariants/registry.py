"""Rules of each analysis, from ``analysis/NAME/rules.py``. Any other analysis has only the general rules.

Other packages add rules of their analyses through the entry point group ``drivetrain_jax.rules``; each entry point names a
:class:`~drivetrain_jax._rules.Declared`.
"""

from __future__ import annotations

from importlib import import_module

from drivetrain_jax._errors import InputError
from drivetrain_jax._plugins import RULES, load_plugin
from drivetrain_jax._rules import Declared

_BUILT_IN = (
    "atlas",
    "floquet",
    "forced",
    "lyapunov",
    "poincare",
    "modes",
    "critical_speeds",
    "steady_state",
    "frequency_response",
    "basins",
)


def declared(analysis: str) -> Declared:
    """The declaration of the analysis with this name."""
    if analysis in _BUILT_IN:
        return import_module(f"drivetrain_jax.analysis.{analysis}.rules").RULES
    try:
        found = load_plugin(RULES, analysis, "the rules of an analysis", lambda x: isinstance(x, Declared))
    except ImportError as error:
        raise InputError(f"analysis = {analysis!r}: {' '.join(str(error).split())}") from error
    return Declared() if found is None else found
