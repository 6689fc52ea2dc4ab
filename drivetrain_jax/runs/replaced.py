"""Pytrees with some of their numbers replaced by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from drivetrain_jax._errors import InputError
from drivetrain_jax._wording import nearest
from drivetrain_jax.runs.axes import entry_of
from drivetrain_jax.systems import System


def replaced(system: Any, point: Mapping[str, Any]) -> Any:
    """``system`` with these parameters, keys or attributes, or entries of them, replaced."""
    for name, value in point.items():
        base, entry = entry_of(name)
        if base not in (names := _names(system)):
            raise InputError(f"over.{name}: unknown to a {type(system).__name__}{nearest(base, names)}")
        old = system[base] if isinstance(system, Mapping) else getattr(system, base)
        if entry is not None:
            value = _with_entry(old, entry, value, name)
        elif not (isinstance(system, System) and system.parameter(base).is_number):
            _check_number(old, name)
        if isinstance(system, Mapping):
            system = {**system, base: value}
        else:
            system = eqx.tree_at(lambda s, base=base: getattr(s, base), system, value, is_leaf=lambda x: x is None)
    return system


def _names(system: Any) -> list[str]:
    """Names of the keys, fields or attributes of a pytree."""
    if isinstance(system, Mapping):
        return list(system)
    if is_dataclass(system):
        return [field.name for field in fields(system)]
    return list(getattr(system, "_fields", getattr(system, "__dict__", ())))


def _with_entry(old: Any, entry: int, value: Array, name: str) -> Any:
    """``old``, an array, list or tuple, with one number replaced."""
    base = entry_of(name)[0]
    if not _is_listed(old):
        raise InputError(f"over.{name}: {base} is not a list; allowed is {base}")
    if entry >= len(old):
        allowed = f"allowed is {base}[0] to {base}[{len(old) - 1}]" if len(old) else f"{base} is empty"
        raise InputError(f"over.{name}: {allowed}")
    _check_number(old[entry], name)
    if isinstance(old, (list, tuple)):
        return eqx.tree_at(lambda entries: entries[entry], old, value, is_leaf=lambda x: x is None)
    return jnp.asarray(old, jnp.result_type(old, value)).at[entry].set(value)


def _is_listed(value: Any) -> bool:
    return isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) > 0


def _check_number(old: Any, name: str) -> None:
    """Check that a number in the place of ``old`` keeps the structure of the pytree."""
    listed = _is_listed(old)
    if old is None or (jax.tree_util.all_leaves([old]) and not listed and not isinstance(old, str)):
        return
    kind = "an array" if hasattr(old, "ndim") else f"a {type(old).__name__}"
    allowed = f'one entry, for example "{name}[0]"' if listed and name == entry_of(name)[0] else "a number"
    raise InputError(f"over.{name}: {kind} cannot vary as a whole; allowed is {allowed}")
