"""Compiled code on disk, shared by the processes of a user: JAX's own cache, and programs that need no tracing either.

Programs are stored under a digest of everything that affects them.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import pickle
import secrets
import tempfile
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
from filelock import FileLock, Timeout
from jax.experimental import serialize_executable

import drivetrain_jax
from drivetrain_jax._machine import instruction_set
from drivetrain_jax.analysis import Analysis, get_analysis
from drivetrain_jax.store.files import digest, source_digest, versions, write_atomic
from drivetrain_jax.systems import System

_VARIABLE = "DRIVETRAIN_JAX_CACHE"
_MAX_BYTES = 1 << 29
# With a limit of size jax reads a date for each entry whenever it keeps a program: 7 us an entry.
_MAX_ENTRIES = 1000


def enable(*, short: bool = False) -> None:
    """Turn on jax's compilation cache. ``DRIVETRAIN_JAX_CACHE=0`` turns it off; any other value names its folder.

    A cache that the user has configured stays unchanged. Without a writable folder there is no cache. With ``short``
    programs that compile in less than a second are kept too; until then the user's own small programs are not.
    """
    wanted = os.environ.get(_VARIABLE, "")
    folder = _folder(wanted)
    used = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if wanted == "0" or (used and used != str(folder)):
        return
    if not used:
        if not _writable(folder):
            return
        _prune(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if short:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def programs() -> Path | None:
    """The folder of stored programs; None without a cache, or with one that the user has configured."""
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    wanted = os.environ.get(_VARIABLE, "")
    return Path(folder) / "programs" if wanted != "0" and folder == str(_folder(wanted)) else None


def _folder(wanted: str) -> Path:
    """One folder per instruction set and jax version, because compiled code is not portable."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = Path(wanted) if wanted else base / "drivetrain_jax"
    content = " ".join((*sorted(instruction_set()), jax.__version__))
    return root / hashlib.blake2b(content.encode(), digest_size=16).hexdigest()


def _prune(folder: Path) -> None:
    """Remove entries without a date, with which jax stores no further program, and of too many those used longest ago."""
    entries = {path.name.removesuffix("-cache") for path in folder.glob("*-cache")}
    dates = {path.name.removesuffix("-atime"): path for path in folder.glob("*-atime")}
    surplus = entries - dates.keys()
    try:
        if len(entries) > _MAX_ENTRIES:
            by_use = sorted(entries & dates.keys(), key=lambda key: dates[key].stat().st_mtime_ns)
            surplus |= set(by_use[: -_MAX_ENTRIES // 2])
        if surplus:
            # The lock of jax's own cache.
            with FileLock(folder / ".lockfile", timeout=0):
                for key in surplus:
                    (folder / f"{key}-cache").unlink(missing_ok=True)
                    (folder / f"{key}-atime").unlink(missing_ok=True)
    except (OSError, Timeout):
        return


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Compiled code is executed, so a folder of another user is not trusted.
        if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
_ROOT = Path(drivetrain_jax.__file__).parent
# Folders and files of this package that compute numbers, and the files in these folders that only read results.
_FOLDERS = ("systems", "analysis", "atlas")
_ENGINE = ("axes", "job", "kernel", "over", "resolve", "through_atlas")
_FILES = ("_quantities", "functions", "resonances", "store/parts", *(f"runs/{name}" for name in _ENGINE))
_READER = "figure.py"


def numerics_of(system: type[System], analysis: Analysis, route: str) -> dict[str, Any]:
    """Everything that affects the bits: route, numeric code, package versions, and instruction set.

    The code includes this package, and the packages of the system and of the analysis.
    """
    sources = dict(_own_sources())
    for file in _files(system, analysis):
        sources |= _sources_of(_package_of(file)) if file else {}
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
    own = system.__module__.startswith(f"{drivetrain_jax.__name__}.")
    if not own or not all(file and _package_of(file) == _ROOT for file in _files(system, analysis)):
        return ""
    return digest([numerics_of(system, analysis, ""), system.name, analysis.name, drivetrain_jax.__version__, content])


def _files(system: type[System], analysis: Analysis) -> list[Path | None]:
    """Files of the code of a system and of an analysis."""
    found: list[Path | None] = []
    for function in (analysis.model(system).build, analysis.solvers):
        # A partial, or a wrapper around a method, has no source of its own.
        file = inspect.getsourcefile(inspect.unwrap(getattr(function, "func", function)))
        found.append(Path(file) if file else None)
    return found


# Cached: later edits of the files do not change the imported code.
@cache
def _own_sources() -> dict[str, str]:
    """Digests of the numeric code of this package, by folder or file."""
    parts = {f"{name}.py": [_ROOT / f"{name}.py"] for name in _FILES}
    for path in sorted(path for name in _FOLDERS for path in (_ROOT / name).rglob("*.py")):
        if path.name != _READER:
            parts.setdefault(path.parent.relative_to(_ROOT).as_posix(), []).append(path)
    return {part: source_digest({path.name: path for path in paths}) for part, paths in parts.items()}


@cache
def _sources_of(package: Path) -> dict[str, str]:
    """Digest of a package (a folder or one file) by its name; empty for this package."""
    if package == _ROOT or not package.exists():
        return {}
    files = package.rglob("*.py") if package.is_dir() else [package]
    return {package.name: source_digest({path.relative_to(package.parent).as_posix(): path for path in files})}


def _package_of(path: Path) -> Path:
    """The outermost package that contains a source file, or the file itself without one."""
    while (path.parent / "__init__.py").is_file():
        path = path.parent
    return path


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
    identity = program_identity(system, get_analysis("floquet").for_system(system), name) if programs() else ""
    return _kept(kernel, tuple(options.items()), identity) if identity else kernel


@lru_cache(maxsize=64)
def _kept(kernel: Any, options: tuple[tuple[str, Any], ...], identity: str) -> Program:
    return Program(kernel.__wrapped__, dict(options), identity)


class Program:
    """A function that is compiled by :func:`compiled`, once for all arguments of the same kinds."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any], identity: str) -> None:
        self._function, self._options, self._identity = function, options, identity
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
    folder = programs()
    if not name or folder is None:
        raise FileNotFoundError(name)
    data = (folder / name).read_bytes()
    if hashlib.blake2b(data[_DIGEST:], digest_size=_DIGEST).digest() != data[:_DIGEST]:
        raise ValueError(f"{name}: damaged")
    (folder / name).touch()
    return pickle.loads(zlib.decompress(data[_DIGEST:]))


def _write(name: str, content: Any) -> None:
    """Store an object, and delete those that have not been used for the longest time. A full disk is no error."""
    folder = programs()
    if not name or folder is None:
        return
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        data = zlib.compress(pickle.dumps(content), 1)
        data = hashlib.blake2b(data, digest_size=_DIGEST).digest() + data
        write_atomic(folder / name, data, folder / f"{name}.{os.getpid()}.tmp")
        for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime)[:-_MOST]:
            file.unlink(missing_ok=True)
