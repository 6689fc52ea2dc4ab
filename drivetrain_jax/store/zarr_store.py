"""A Zarr v3 store that xarray opens as the Dataset of the HDF5 file, and that many processes write at once.

The sweep is cut into shards: each is one file per variable and has one writer. The group ``checksums``, which xarray leaves
alone, holds a checksum of each shard, written after its data (0 before). Missing shards have the fill value. Damage to data
is detected by the checksum or the CRC-32C of every file, damage to the rest by the digest of a finished store.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError, counted
from drivetrain_jax.store.consolidate import DETAILS, GROUP, Labelled
from drivetrain_jax.store.files import digest, source_digest
from drivetrain_jax.store.parts import Place, Shards

# Folder among the parts in which a store grows, and the one for a store while another one replaces it.
UNFINISHED, FORMER = "store", "former"
# Digest of everything in a store except its shards: an attribute.
SEAL = "checksum"
_CHECKSUMS, _OF_SHARDS, _RESULTS = "checksums", "checksums/shards", "results"
# Exceptions of decoding, which depend on the position of the damage.
_BROKEN = (ValueError, OSError, KeyError, RuntimeError, TypeError, AttributeError, IndexError, ArithmeticError)


def is_store(path: Path) -> bool:
    """True if there is a Zarr v3 group at ``path``, or the folders of a store whose metadata are damaged."""
    return (path / "zarr.json").is_file() or ((path / _OF_SHARDS).is_dir() and (path / "outcome").is_dir())


def create(path: Path, template: Labelled, shards: Shards) -> None:
    """Create an empty store for ``template``, filled with its first values. Raises ``OSError`` without enough space."""
    zarr = _zarr()
    # As strings of variable length: Zarr has no specification of strings of fixed length yet.
    coords = {
        n: replace(c, values=c.values.astype(object)) if c.values.dtype.kind == "U" else c
        for n, c in template.coords.items()
    }
    checked = {name: {"compressors": (zarr.codecs.Crc32cCodec(),)} for name in coords}
    dataset = replace(template, coords=coords, data={}).to_dataset()
    dataset.to_zarr(path, mode="w", zarr_format=3, consolidated=False, encoding=checked)
    root = _root(path, "r+")
    for name, entry in template.data.items():
        inner = entry.values.shape[len(shards.shape) :]
        root.create_array(
            name,
            shape=entry.values.shape,
            dtype=entry.values.dtype,
            chunks=(*shards.lengths, *(max(n, 1) for n in inner)),
            fill_value=next(entry.values.flat, 0),
            compressors=zarr.codecs.Crc32cCodec(),
            dimension_names=entry.dims,
            attributes={
                key: value.tolist() if hasattr(value, "tolist") else value for key, value in entry.attrs.items()
            },
        )
    details = {name: value for name, value in template.attrs.items() if name in DETAILS}
    root.create_group(GROUP, attributes=details)
    apart = root.create_group(_CHECKSUMS, attributes={_RESULTS: list(template.data)})
    apart.create_array("shards", shape=(shards.count,), dtype="uint64", chunks=(1,), compressors=None)
    _consolidate(path)


def shards_of(path: Path) -> Shards:
    """The shards of the store. Raises :class:`InputError` if it has none."""
    try:
        outcome = _root(path)["outcome"]
        return Shards(tuple(outcome.shape), tuple(outcome.chunks))
    except _BROKEN:
        raise _damaged(path) from None


def layout(path: Path) -> dict[str, tuple[np.dtype, tuple[int, ...]]]:
    """Types and shapes of the results by name."""
    root = _root(path)
    return {name: (root[name].dtype, tuple(root[name].shape)) for name in root[_CHECKSUMS].attrs[_RESULTS]}


def write(path: Path, place: Place, arrays: Mapping[str, np.ndarray], shard: int) -> None:
    """Write the results of number ``shard``, then its checksum, which marks it as done if the results agree."""
    root = _root(path, "r+")
    for name, values in arrays.items():
        root[name][(*place, ...)] = values
    root[_OF_SHARDS][shard] = _checksum(arrays)


def done(path: Path) -> np.ndarray:
    """Flags of the shards that are marked done."""
    try:
        return _root(path)[_OF_SHARDS][:] != 0
    except _BROKEN:
        raise _damaged(path) from None


def read(path: Path, shards: Shards, shard: int) -> dict[str, np.ndarray] | None:
    """The results of a shard; None if it is missing or damaged."""
    try:
        root = _root(path)
        place = (*shards.place(shard), ...)
        arrays = {name: np.asarray(root[name][place]) for name in root[_CHECKSUMS].attrs[_RESULTS]}
        return arrays if root[_OF_SHARDS][shard] == _checksum(arrays) else None
    except _BROKEN:
        return None


def intact(path: Path) -> Iterator[bool]:
    """Yield for each shard whether it is complete and not damaged."""
    shards = shards_of(path)
    for shard in range(shards.count):
        yield read(path, shards, shard) is not None


def map_variable(path: Path, name: str) -> np.ndarray:
    """One variable of the store; :class:`InputError` if it cannot be read."""
    try:
        return np.asarray(_root(path)[name][...])
    except _BROKEN:
        raise _damaged(path) from None


def attributes(path: Path) -> dict[str, Any]:
    """The attributes of the store; :class:`InputError` if it has none."""
    _zarr()
    try:
        root = _root(path)
        return {**root.attrs, **(root[GROUP].attrs if GROUP in root else {})}
    except _BROKEN:
        raise InputError(f"store = {str(path)!r}: not a readable Zarr store; give one of --store zarr") from None


def seal(path: Path, attrs: Mapping[str, Any], labels: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the attributes of the finished store and the ``labels`` of variables, and add the digest of everything else."""
    # Temporary files of workers that were killed.
    for file in path.rglob("*.partial"):
        file.unlink()
    root = _root(path, "r+")
    for name, label in labels.items():
        root[name].attrs.update({key: v.tolist() if hasattr(v, "tolist") else v for key, v in label.items()})
    # Replace the attributes, because those of a growing store have no checksum; xarray needs the list of coordinates.
    kept = {name: value for name, value in root.attrs.items() if name == "coordinates"}
    root.attrs.put({**kept, **{name: value for name, value in attrs.items() if name not in DETAILS}})
    root[GROUP].attrs.put({name: value for name, value in attrs.items() if name in DETAILS})
    _consolidate(path)
    content = json.loads((path / "zarr.json").read_text())
    content["attributes"][SEAL] = _digest(path)
    (path / "zarr.json").write_text(json.dumps(content, indent=2))


def _consolidate(path: Path) -> None:
    """Copy the metadata of all arrays into those of the store, where xarray looks first."""
    with warnings.catch_warnings():
        # Consolidated metadata are not yet in the specification of Zarr 3; other readers ignore the copy.
        warnings.simplefilter("ignore")
        _zarr().consolidate_metadata(path)


def damage(path: Path) -> str:
    """The damaged parts of the finished store at ``path``, by all its checksums; empty without damage."""
    try:
        wrong = [*intact(path)].count(False) if is_sealed(path) else -1
    except InputError:
        wrong = -1
    return "its metadata" if wrong < 0 else counted(wrong, "shard", "shards") if wrong else ""


def is_sealed(path: Path) -> bool:
    """True if a finished store is intact apart from its shards; :class:`InputError` if it is not a result."""
    attrs = attributes(path)
    if "digest" not in attrs:
        raise InputError(f"store = {str(path)!r}: not a result of drivetrain_jax; give one of --store zarr")
    if "groups" in attrs:
        raise _damaged(path)
    try:
        return attrs.get(SEAL) == _digest(path)
    except _BROKEN:
        return False


def _digest(path: Path) -> str:
    """Digest of all files except the shards, without the digest itself."""
    content = json.loads((path / "zarr.json").read_text())
    content["attributes"].pop(SEAL, None)
    results = json.loads((path / _CHECKSUMS / "zarr.json").read_text())["attributes"][_RESULTS]
    shards, files = {path / name / "c" for name in (*results, _OF_SHARDS)}, {}
    for folder, names, file_names in os.walk(path):
        names[:] = [name for name in names if Path(folder, name) not in shards]
        files |= {file.relative_to(path).as_posix(): file for file in (Path(folder, name) for name in file_names)}
    unsharded = {name: file for name, file in files.items() if file not in {path / "zarr.json", *shards}}
    return digest([content, source_digest(unsharded)])


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    state = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        state.update(np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8).data)
    # 0 means "not done".
    return int.from_bytes(state.digest(), "little") or 1


def _damaged(path: Path) -> InputError:
    if "groups" in attributes(path):
        made = "a store of an earlier version, which `drivetrain export` of that version reads"
        return InputError(f"store = {str(path)!r}: {made}; expected a store of this one")
    return InputError(f"store = {str(path)!r}: damaged; restore it or compute it again")


def _root(path: Path, mode: str = "r") -> Any:
    """The store, opened by the metadata of every array and not by their consolidated copy."""
    return _zarr().open_group(path, mode=mode, use_consolidated=False)


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise InputError("store = 'zarr': the package zarr is not installed; install drivetrain_jax[zarr]") from None
    return zarr
