"""Compiled code on disk, shared by the processes of a user: JAX's own cache, and programs that need no tracing either.

Programs are stored under a digest of everything that affects them. JAX's own cache finds compiled code only after tracing,
which takes two thirds of the time of an answer.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import secrets
import sys
import threading
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable

import drivetrain_jax
from drivetrain_jax._machine import compiling, instruction_set
from drivetrain_jax.analysis import Analysis, get_analysis
from drivetrain_jax.store.files import digest, source_digest, versions, write_atomic
from drivetrain_jax.systems import System

# Most entries of JAX's cache and most programs; a program takes some 300 kB.
_ENTRIES, _PROGRAMS = 1000, 256
# Errors of a kernel that cannot be stored, or of a file that is missing, damaged or of no use here.
_UNUSABLE = (OSError, ValueError, TypeError, KeyError, AttributeError, NotImplementedError, pickle.PickleError)
_UNUSABLE += (zlib.error, jax.errors.JaxRuntimeError)


def enable(*, short: bool = False) -> None:
    """Turn on jax's compilation cache. ``DRIVETRAIN_JAX_CACHE=0`` turns it off; any other value names its folder.

    A cache that the user has configured stays unchanged. Without a writable folder there is no cache. With ``short``
    programs that compile in less than a second are kept too; until then the user's own small programs are not.
    """
    used = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not used and (folder := _folder()) is not None and _is_private(folder):
        _trim(folder, _ENTRIES)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if short and programs():
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def programs() -> Path | None:
    """The folder of stored programs; None without a cache, or with one that the user has configured."""
    used = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    return Path(used) / "programs" if used and used == str(_folder()) else None


def _folder() -> Path | None:
    """One folder per instruction set and jax version, because compiled code is not portable; None if it is turned off."""
    wanted = os.environ.get("DRIVETRAIN_JAX_CACHE", "")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "drivetrain_jax"
    content = " ".join((*sorted(instruction_set()), jax.__version__))
    name = hashlib.blake2b(content.encode(), digest_size=16).hexdigest()
    return None if wanted == "0" else Path(wanted or base) / name


def _is_private(folder: Path) -> bool:
    """True if ``folder`` is writable and belongs to this user: compiled code is executed, so no other one is trusted."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return os.access(folder, os.W_OK | os.X_OK) and folder.stat().st_uid == getattr(os, "getuid", lambda: 0)()
    except OSError:
        return False


def _trim(folder: Path, most: int) -> None:
    """Delete the oldest of too many files."""
    with suppress(OSError):
        files = [path for path in folder.iterdir() if path.is_file()]
        for path in sorted(files, key=lambda path: path.stat().st_mtime)[:-most]:
            path.unlink(missing_ok=True)


PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
_ROOT = Path(drivetrain_jax.__file__).parent
# Folders and files of this package that compute numbers.
_FOLDERS = ("systems", "analysis", "atlas")
_ENGINE = ("axes", "job", "kernel", "over", "resolve", "through_atlas")
_FILES = ("_quantities", "analyses", "resonances", "store/parts", *(f"runs/{name}" for name in _ENGINE))


def numerics_of(system: type[System], analysis: Analysis, route: str) -> dict[str, Any]:
    """Everything that affects the bits: route, numeric code, package versions, and instruction set.

    The code includes this package, and the packages of the system and of the analysis.
    """
    sources = dict(_own_sources())
    for package in _packages(system, analysis) - {drivetrain_jax.__name__}:
        sources |= _sources_of(package) or {package: _word_of(system)}
    return {
        "route": route,
        "sources": sources,
        "versions": versions(PACKAGES),
        "x64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
        "backend": jax.default_backend(),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "instructions": " ".join(sorted(instruction_set())),
    }


def program_identity(system: type[System], analysis: Analysis, content: object) -> str:
    """Digest of everything that affects a program; empty for code outside of this package.

    Such code may depend on more than its files, such as the arguments of a script.
    """
    if _packages(system, analysis) != {drivetrain_jax.__name__}:
        return ""
    return digest([numerics_of(system, analysis, ""), system.name, analysis.name, drivetrain_jax.__version__, content])


def _packages(system: type[System], analysis: Analysis) -> set[str]:
    """Names of the outermost packages, or of the scripts, that contain the code of a system, its bases, and an analysis."""
    bases = [base for base in system.__mro__ if issubclass(base, System)]
    code = (*bases, *(getattr(x, "func", x) for x in (analysis.model(system).build, analysis.solvers)))
    return {str(x.__module__).partition(".")[0] for x in code}


@cache
def _word_of(system: type[System]) -> str:
    """A word for the code of a class without a file, as in a notebook: its results do not resume in another process."""
    return secrets.token_hex(8)


# Cached: later edits of the files do not change the imported code.
@cache
def _own_sources() -> dict[str, str]:
    """Digests of the numeric code of this package, by folder or file."""
    parts = {f"{name}.py": [_ROOT / f"{name}.py"] for name in _FILES}
    for path in sorted(path for name in _FOLDERS for path in (_ROOT / name).rglob("*.py")):
        parts.setdefault(path.parent.relative_to(_ROOT).as_posix(), []).append(path)
    return {part: source_digest({path.name: path for path in paths}) for part, paths in parts.items()}


@cache
def _sources_of(package: str) -> dict[str, str]:
    """Digest of an imported package (a folder or one file) by its name; empty without files."""
    module = sys.modules.get(package)
    path = Path(getattr(module, "__file__", None) or "")
    if hasattr(module, "__path__"):
        path = path.parent
    elif not path.is_file():
        return {}
    files = path.rglob("*.py") if path.is_dir() else [path]
    return {path.name: source_digest({file.relative_to(path.parent).as_posix(): file for file in files})}


class Program:
    """A function that is compiled with ``options`` of the compiler, once for all arguments of the same kinds.

    ``identity`` is a digest of everything else that the program depends on. Its compiled code is kept on disk unless the
    identity is empty.
    """

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any], identity: str) -> None:
        self._function, self._options, self._identity = function, dict(options), identity
        self._compiled: dict[Any, jax.stages.Compiled] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        """The results of the function."""
        leaves, tree = jax.tree.flatten(arguments)
        leaves = [x if isinstance(x, jax.Array) else np.asarray(x) for x in leaves]
        kinds = (tree, *((x.shape, x.dtype.str) for x in leaves))
        arguments = jax.tree.unflatten(tree, leaves)
        with self._lock:
            if kinds not in self._compiled:
                identity = self._identity and digest([self._identity, str(kinds)])
                self._compiled[kinds] = compiled(self._function, arguments, self._options, identity)
        return self._compiled[kinds](*arguments)


def kept(system: type[System], kernel: Any, options: Mapping[str, Any], name: str) -> Callable[..., Any]:
    """``kernel``, a function of ``jax.jit``, as a :class:`Program` for all who ask; itself if it is not kept on disk."""
    identity = program_identity(system, get_analysis("floquet").for_system(system), name) if programs() else ""
    return _kept(kernel, tuple(options.items()), identity) if identity else kernel


@lru_cache(maxsize=64)
def _kept(kernel: Any, options: tuple[tuple[str, Any], ...], identity: str) -> Program:
    return Program(kernel.__wrapped__, dict(options), identity)


def compiled(
    function: Callable[..., Any], kinds: tuple[Any, ...], options: Mapping[str, Any], identity: str
) -> jax.stages.Compiled:
    """``function`` compiled for arguments of these ``kinds``; for ``options`` and ``identity`` see :class:`Program`."""
    name = digest([identity, dict(options)]) if identity and programs() else ""
    with suppress(*_UNUSABLE):
        has_lapack, *parts = _read(name)
        if has_lapack:
            # JAX loads LAPACK, which takes a quarter of a second, when it lowers the first call.
            jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
        return serialize_executable.deserialize_and_load(*parts, execution_devices=jax.devices()[:1])
    named = lambda *arguments: function(*arguments)  # noqa: E731
    # A new name for what is stored: JAX's own cache returns kernels that cannot be stored again (jax 0.10.2).
    named.__name__ = f"kernel_{secrets.token_hex(8)}"
    with compiling:
        kernel = jax.jit(named if name else function).lower(*kinds).compile(dict(options))
    # A call of Python code cannot be stored.
    if name and not (calls(kernel, "xla_ffi_python") or calls(kernel, "xla_python")):
        with suppress(*_UNUSABLE):
            _write(name, (calls(kernel, "lapack_"), *serialize_executable.serialize(kernel)))
    return kernel


def calls(kernel: jax.stages.Compiled, target: str) -> bool:
    """True if ``kernel`` calls a library function whose name begins with ``target``."""
    return f'custom_call_target="{target}' in (kernel.as_text() or "")


def remembered(compute: Callable[[], Any], identity: str) -> Any:
    """``compute()``, stored on disk under ``identity``, as programs are."""
    with suppress(*_UNUSABLE):
        return _read(identity)
    content = compute()
    _write(identity, content)
    return content


def _read(name: str) -> Any:
    """A stored object; one of ``_UNUSABLE`` if there is none, or a damaged one.

    The folder belongs to the user alone, and what it holds is executed anyway.
    """
    folder = programs()
    if not name or folder is None:
        raise FileNotFoundError(name)
    # The checksum of zlib finds damage.
    data = zlib.decompress((folder / name).read_bytes())
    (folder / name).touch()
    return pickle.loads(data)


def _write(name: str, content: Any) -> None:
    """Store an object. A full disk is no error."""
    folder = programs()
    if name and folder is not None:
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            write_atomic(folder / name, zlib.compress(pickle.dumps(content), 1), folder / f"{name}.{os.getpid()}.tmp")
            _trim(folder, _PROGRAMS)
