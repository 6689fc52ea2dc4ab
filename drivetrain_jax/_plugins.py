"""Systems, analyses, figures and rules of other packages, found through entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, TypeVar

from drivetrain_jax._errors import InputError

Found = TypeVar("Found")

SYSTEMS, ANALYSES = "drivetrain_jax.systems", "drivetrain_jax.analyses"
FIGURES, RULES = "drivetrain_jax.figures", "drivetrain_jax.rules"


def plugin_names(group: str) -> tuple[str, ...]:
    """Sorted names of the entry points in ``group``."""
    return tuple(sorted({entry.name for entry in entry_points(group=group)}))


def load_plugin(group: str, name: str, wanted: str, is_wanted: Callable[[Any], bool] = callable) -> Any:
    """The object of the entry point ``name``; None without one.

    Raises :class:`InputError` if its package fails, or if the object is not of the kind ``wanted`` or has another name.
    """
    field = f"{'system' if group == SYSTEMS else 'analysis'} = {name!r}"
    for entry in entry_points(group=group, name=name):
        try:
            plugin = entry.load()
        # Code of another package may raise anything.
        except Exception as error:
            text = " ".join(str(error).split())
            raise InputError(f"{field}: {entry.value} cannot be loaded: {type(error).__name__}: {text}") from error
        if not is_wanted(plugin):
            raise InputError(f"{field}: {entry.value} is of type {type(plugin).__name__}, not {wanted}")
        if getattr(plugin, "name", name) != name:
            raise InputError(f"{field}: {entry.value} is named {plugin.name}, not {name}")
        return plugin
    return None


def call_plugin(
    group: str, name: str, what: str, function: Callable[..., Any], *arguments: Any, kind: type[Found], allowed: str
) -> Found:
    """``function(*arguments)``, a function of the entry point ``name``.

    Raises ``InputError`` with one line that names the entry point if the function fails or returns no ``kind``.
    """
    entry = next((entry.value for entry in entry_points(group=group, name=name)), name)
    try:
        result = function(*arguments)
    except (InputError, MemoryError):
        raise
    # Code of another package may raise anything.
    except Exception as error:
        text = " ".join(str(error).split())
        raise InputError(f"{what} {entry} raised {type(error).__name__}: {text}; expected {allowed}") from error
    if not isinstance(result, kind):
        raise InputError(f"{what} {entry} returned {type(result).__name__}; expected {allowed}")
    return result
