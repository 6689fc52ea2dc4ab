"""Scenes as nested tables: read TOML, replace entries by dotted keys, convert to typed tables, write TOML."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import drivetrain_jax
from drivetrain_jax._errors import InputError, did_you_mean, nearest, shown
from drivetrain_jax._units import with_unit

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read(
    source: str | Path | Mapping[str, Any], overrides: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], str]:
    """The tables of a scene and its TOML text.

    ``source`` is a path, the name of a scene that the package brings, or a mapping. ``overrides`` replaces single
    entries, for example ``{"fixed.zeta": 0.002}``; the text then is that of the changed scene.
    """
    if isinstance(source, Mapping):
        tree, text = plain(source), None
    elif isinstance(source, (str, os.PathLike)):
        text = _text(Path(os.path.expanduser(source)))
        try:
            tree = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            hint = "; words and numbers with units stand in quotes" * str(error).startswith("Invalid value")
            raise InputError(f"scene = {str(source)!r}: not valid TOML: {error}{hint}") from None
    else:
        raise InputError(f"scene = {shown(source)}: expected the path of a scene file, or a table")
    if overrides:
        text = None
        if not isinstance(overrides, Mapping) or not all(isinstance(key, str) and key for key in overrides):
            raise InputError(
                f"overrides = {shown(overrides)}: expected a table by dotted keys, {{'fixed.zeta': 0.002}}"
            )
        for key, value in overrides.items():
            _replace(tree, key, plain(value))
            if key.startswith("axes.") and isinstance(fixed := tree.get("fixed"), dict):
                # The axis takes the place of the fixed value.
                fixed.pop(key.split(".")[1], None)
    return tree, write(tree) if text is None else text


def plain(value: Any) -> Any:
    """A copy in the types of TOML: NumPy numbers and arrays, tuples and ranges become numbers and lists."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    value = with_unit(value)
    if hasattr(value, "tolist"):
        try:
            return value.tolist()
        except TypeError:
            raise InputError(
                "scene: does not work under jax.jit, jax.grad or jax.vmap; expected a function such as dt.floquet"
            ) from None
    if isinstance(value, (Decimal, Fraction)):
        return float(value)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "__array__"):
        # Labelled arrays of xarray have no tolist.
        return np.asarray(value).tolist()
    return [plain(entry) for entry in value] if isinstance(value, (list, tuple, range)) else value


def _text(path: Path) -> str:
    """The text of the scene at ``path``, or of the packaged one of this name."""
    names = sorted(packaged.stem for packaged in FOLDER.glob("*.toml"))
    file = FOLDER / f"{path}.toml" if str(path) in names and not path.is_file() else path
    try:
        # Editors on Windows put a byte order mark first.
        return file.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"scene = {str(path)!r}: not a text file in UTF-8") from None
    except OSError as error:
        allowed = f"give the path of a scene file, or a name of `drivetrain list`{did_you_mean(str(path), names)}"
        raise InputError(f"scene = {str(path)!r}: {error.strerror}; {allowed}") from None


def _replace(tree: dict[str, Any], key: str, value: Any) -> None:
    *tables, last = key.split(".")
    first = key.partition(".")[0]
    if first not in tree and (inside := [n for n, t in tree.items() if isinstance(t, dict) and first in t]):
        raise InputError(f"set {key}: not a key of the scene itself; did you mean {inside[0]}.{key}?")
    for name in tables:
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            raise InputError(
                f"set {key}: {name!r} is not a table of the scene; give table.name, for example fixed.zeta"
            )
    tree[last] = value


def converted(tree: Any, kind: type, where: str) -> Any:
    """``tree`` converted to the table ``kind``; ``where`` is the dotted prefix of its fields in messages."""
    names = [field.name for field in msgspec.structs.fields(kind)]
    for key in tree:
        if key not in names:
            raise InputError(f"{where}{key} = {shown(tree[key])}: unknown key{nearest(str(key), names)}")
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        reason, _, path = str(error).partition(" - at `$.")
        name = re.split(r"\W", path, maxsplit=1)[0]
        field = f"{where}{name} = {shown(tree.get(name))}" if name else where.rstrip(".") or "scene"
        raise InputError(f"{field}: {reason[:1].lower()}{reason[1:]}") from None


def parse_value(text: str) -> Any:
    """A TOML value; other text is a number in short form (``.3``), a plain string (``18deg``) or a list of these."""
    try:
        content = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        # Not TOML, a number with too many digits, or lists in lists in lists.
        content = {}
    if list(content) == ["value"]:
        return content["value"]
    with suppress(ValueError):
        return float(text)
    if (inner := text.strip()).startswith("[") and inner.endswith("]") and not set(inner[1:-1]) & set("[]{}\"'"):
        return [parse_value(entry.strip()) for entry in inner[1:-1].split(",")]
    return text


def write(tree: Mapping[str, Any]) -> str:
    """TOML text of ``tree``: plain entries first, then its tables with inline subtables. None entries are left out,
    because TOML has no null."""
    lines = entries({name: value for name, value in tree.items() if not isinstance(value, Mapping)})
    for name, table in tree.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{_key(name)}]", *entries(table)]
    return "\n".join(lines) + "\n"


def entries(table: Mapping[str, Any]) -> list[str]:
    """``name = value`` for every entry of ``table``."""
    return [f"{_key(name)} = {_value(value)}" for name, value in table.items() if value is not None]


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _value(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML requires an escape for one control character that JSON does not escape.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(entries(value)) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)


# In a checkout this is a link to the folder at the top; in a wheel it contains the files.
FOLDER = Path(drivetrain_jax.__file__).parent / "sweeps"
