"""Compiled kernels, and curves of charts, on disk: later processes neither trace nor compile."""

from __future__ import annotations

import hashlib
import os
import pickle
import secrets
import threading
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable

from drivetrain_jax import _compile_cache
from drivetrain_jax.analysis import get_analysis
from drivetrain_jax.runs.identity import program_identity
from drivetrain_jax.runs.scene import find_system
from drivetrain_jax.store.files import write_atomic
from drivetrain_jax.store.provenance import digest
from drivetrain_jax.systems import System

# Number of files that are kept; one takes some 300 kB.
_MOST, _DIGEST = 256, 16
# Errors of a kernel that cannot be stored, or of a file that is missing, damaged or of no use here.
_UNUSABLE = (OSError, ValueError, TypeError, KeyError, AttributeError, NotImplementedError, pickle.PickleError)
_UNUSABLE += (jax.errors.JaxRuntimeError,)


def compiled(
    function: Callable[..., Any], kinds: tuple[Any, ...], options: Mapping[str, Any], identity: str
) -> jax.stages.Compiled:
    """``function`` compiled with ``options`` of the compiler for arguments of these ``kinds``.

    ``identity`` is a digest of everything else that the kernel depends on; an empty one keeps nothing on disk.
    """
    name = digest([identity, dict(options)]) if identity and _compile_cache.programs() else ""
    with suppress(*_UNUSABLE):
        has_lapack, *parts = _read(name)
        if has_lapack:
            # JAX loads LAPACK, which takes a quarter of a second, when it lowers the first call.
            jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
        return serialize_executable.deserialize_and_load(*parts, execution_devices=jax.devices()[:1])
    named = lambda *arguments: function(*arguments)  # noqa: E731
    # A new name for what is stored: JAX's own cache returns kernels that cannot be stored again (jax 0.10.2).
    named.__name__ = f"kernel_{secrets.token_hex(8)}"
    kernel = jax.jit(named if name else function).lower(*kinds).compile(dict(options))
    # A call of Python code cannot be stored.
    if name and not (calls(kernel, "xla_ffi_python") or calls(kernel, "xla_python")):
        with suppress(*_UNUSABLE):
            _write(name, (calls(kernel, "lapack_"), *serialize_executable.serialize(kernel)))
    return kernel


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
        self._compiled: dict[str, jax.stages.Compiled] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        """The results of the kernel."""
        arguments = jax.tree.map(np.asarray, arguments)
        leaves, tree = jax.tree.flatten(arguments)
        kinds = digest([self._identity, str(tree), [(x.shape, x.dtype.str) for x in leaves]])
        with self._lock:
            if kinds not in self._compiled:
                self._compiled[kinds] = compiled(self._kernel.__wrapped__, arguments, self._options, kinds)
        return self._compiled[kinds](*arguments)


def calls(kernel: jax.stages.Compiled, target: str) -> bool:
    """True if ``kernel`` calls a library function whose name begins with ``target``."""
    return f'custom_call_target="{target}' in (kernel.as_text() or "")


def remembered(compute: Callable[[], Any], identity: str) -> Any:
    """``compute()``, stored on disk under ``identity``, as kernels are."""
    with suppress(*_UNUSABLE):
        return _read(identity)
    found = compute()
    _write(identity, found)
    return found


def _read(name: str) -> Any:
    """A stored object; ``OSError`` or ``ValueError`` if there is none, or a damaged one.

    The folder belongs to the user alone, and what it holds is executed anyway.
    """
    folder = _compile_cache.programs()
    if not name or folder is None:
        raise FileNotFoundError(name)
    data = (folder / name).read_bytes()
    if hashlib.blake2b(data[_DIGEST:], digest_size=_DIGEST).digest() != data[:_DIGEST]:
        raise ValueError(f"{name}: damaged")
    (folder / name).touch()
    return pickle.loads(zlib.decompress(data[_DIGEST:]))


def _write(name: str, content: Any) -> None:
    """Store an object, and delete those that have not been used for the longest time. A full disk is no error."""
    folder = _compile_cache.programs()
    if not name or folder is None:
        return
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        data = zlib.compress(pickle.dumps(content), 1)
        data = hashlib.blake2b(data, digest_size=_DIGEST).digest() + data
        write_atomic(folder / name, data, folder / f"{name}.{os.getpid()}.tmp")
        for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime)[:-_MOST]:
            file.unlink(missing_ok=True)
