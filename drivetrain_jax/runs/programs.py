"""Compiled kernels, and curves of charts, on disk: later processes neither trace nor compile."""

from __future__ import annotations

import hashlib
import io
import json
import os
import secrets
import threading
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.tree_util import PyTreeDef, default_registry

from drivetrain_jax import _compile_cache
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.runs.identity import program_identity
from drivetrain_jax.runs.scene import find_system
from drivetrain_jax.store.files import write_atomic
from drivetrain_jax.store.provenance import digest
from drivetrain_jax.systems import System

# Number of files that are kept; one takes some 300 kB.
_MOST = 256
_DIGEST = 16
# Errors of a file that is missing, damaged or of no use here.
_UNUSABLE = (OSError, ValueError, TypeError, KeyError, zlib.error, jax.errors.JaxRuntimeError)
# Coordinates of xarray by name: dimensions, values, attributes.
Coordinates = dict[str, tuple[Any, np.ndarray, dict[str, str]]]


def compiled(
    function: Callable[..., Any], kinds: tuple[Any, ...], options: Mapping[str, Any], identity: str
) -> jax.stages.Compiled:
    """``function`` compiled with ``options`` of the compiler for arguments of these ``kinds``.

    ``identity`` is a digest of everything else that the kernel depends on; an empty one keeps nothing on disk.
    """
    folder = _compile_cache.programs() if identity else None
    path = folder / digest([identity, dict(options)]) if folder else None
    if path is None:
        return jax.jit(function).lower(*kinds).compile(dict(options))
    found = _read(path, kinds)
    if found is None:
        # A new name, which JAX's own cache cannot know: what it returns cannot be stored again (jax 0.10.2).
        named = lambda *arguments: function(*arguments)  # noqa: E731
        named.__name__ = f"kernel_{secrets.token_hex(8)}"
        found = jax.jit(named).lower(*kinds).compile(dict(options))
        _write(path, found)
    return found


def kept(system: type[System], kernel: Any, options: Mapping[str, Any], name: str) -> Callable[..., Any]:
    """``kernel``, a function of ``jax.jit`` with these ``options`` of the compiler, with its compiled code on disk.

    Without a cache, and for a system of another package, it is ``kernel`` itself.
    """
    if _compile_cache.programs() is None or find_system(system.name) is not system:
        return kernel
    identity = program_identity(system, get_analysis("floquet").for_system(system), name)
    return _Kept(kernel, tuple(options.items()), identity) if identity else kernel


@lru_cache(maxsize=64)
class _Kept:
    """A kernel that is compiled by :func:`compiled`, once for all arguments of the same kinds."""

    def __init__(self, kernel: Any, options: tuple[tuple[str, Any], ...], identity: str) -> None:
        self._kernel, self._options, self._identity = kernel, dict(options), identity
        self._compiled: dict[tuple[Any, ...], jax.stages.Compiled] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        """The results of the kernel."""
        arguments = jax.tree.map(np.asarray, arguments)
        leaves, tree = jax.tree.flatten(arguments)
        kinds = tuple((x.shape, x.dtype.str) for x in leaves)
        with self._lock:
            if (tree, kinds) not in self._compiled:
                identity = digest([self._identity, str(tree), kinds])
                kernel = compiled(self._kernel.__wrapped__, arguments, self._options, identity)
                self._compiled[tree, kinds] = kernel
        return self._compiled[tree, kinds](*arguments)


def calls(kernel: jax.stages.Compiled, target: str) -> bool:
    """True if ``kernel`` calls a library function whose name begins with ``target``."""
    return f'custom_call_target="{target}' in (kernel.as_text() or "")


def remembered(compute: Callable[[], Coordinates], identity: str) -> Coordinates:
    """``compute()``, stored on disk under ``identity``, as kernels are."""
    folder = _compile_cache.programs() if identity else None
    if folder is None:
        return compute()
    path = folder / identity
    with suppress(*_UNUSABLE), np.load(io.BytesIO(_content(path))) as file:
        head = json.loads(file["head"].item())
        return {name: (dims, file[name], about) for name, (dims, about) in head.items()}
    found = compute()
    head = json.dumps({name: (dims, about) for name, (dims, _, about) in found.items()})
    _store(path, _arrays(head=np.array(head), **{name: np.asarray(values) for name, (_, values, _) in found.items()}))
    return found


def _read(path: Path, kinds: tuple[Any, ...]) -> jax.stages.Compiled | None:
    """The kernel at ``path`` for arguments of these ``kinds``; None if there is none, or if it is damaged."""
    with suppress(*_UNUSABLE), np.load(io.BytesIO(_content(path))) as file:
        if file["lapack"]:
            # JAX loads LAPACK, which takes a quarter of a second, when it lowers the first call.
            jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
        out = PyTreeDef.deserialize_using_proto(default_registry, file["results"].tobytes())
        code, given = file["code"].tobytes(), jax.tree.structure((kinds, {}))
        return serialize_executable.deserialize_and_load(code, given, out, execution_devices=jax.devices()[:1])
    return None


def _write(path: Path, kernel: jax.stages.Compiled) -> None:
    """Store a kernel if that is possible."""
    if calls(kernel, "xla_ffi_python") or calls(kernel, "xla_python"):
        # A call of Python code cannot be stored.
        return
    try:
        code, _, out = serialize_executable.serialize(kernel)
        parts = {"code": code, "results": out.serialize_using_proto()}
    except (ValueError, NotImplementedError, jax.errors.JaxRuntimeError):
        # A backend may be unable to store its kernels, and results of other types than those of Python have no form on disk.
        return
    content = {name: np.frombuffer(part, np.uint8) for name, part in parts.items()}
    _store(path, _arrays(lapack=np.array(calls(kernel, "lapack_")), **content))


def _arrays(**arrays: np.ndarray) -> bytes:
    """``arrays`` in NumPy's format, which holds no code of Python."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _content(path: Path) -> bytes:
    """The content of a stored file; ``ValueError`` if it is damaged."""
    data = path.read_bytes()
    if hashlib.blake2b(data[_DIGEST:], digest_size=_DIGEST).digest() != data[:_DIGEST]:
        raise ValueError(f"{path.name}: damaged")
    path.touch()
    return zlib.decompress(data[_DIGEST:])


def _store(path: Path, content: bytes) -> None:
    """Store a file, and delete those that have not been used for the longest time. A full disk is no error."""
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, exist_ok=True)
        data = zlib.compress(content, 1)
        data = hashlib.blake2b(data, digest_size=_DIGEST).digest() + data
        write_atomic(path, data, path.with_name(f"{path.name}.{os.getpid()}.tmp"))
        programs = sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime)
        for file in programs[:-_MOST]:
            file.unlink(missing_ok=True)
