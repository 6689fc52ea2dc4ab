"""A Zarr v3 store that many processes write at once: each shard is one file per variable and has one writer.

Rows are points in the order of computation, ``width`` rows per chunk; the chunks of one group of the plan form one Zarr
group. The array ``point`` holds the number of each row's point in the grid (-1: padding). The array ``done`` holds a
checksum of each shard, written after its data (0 before). Damage to data is detected by this checksum or the CRC-32C of
every chunk, damage to attributes by the digest of a finished store.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivetrain_jax._errors import InputError
from drivetrain_jax.store.provenance import digest

POINT, DONE = "point", "done"
# Folder among the parts in which a store grows.
UNFINISHED = "store"
# Folder among the parts for a store while another one replaces it.
FORMER = "former"
# Attributes of a store: number of points and layout of its shards, and the digest of all other attributes.
GROUPS, HELD, SEAL = "groups", "held_points", "checksum"
# Exceptions of decoding, which depend on the position of the damage.
_BROKEN = (ValueError, OSError, KeyError, RuntimeError, TypeError, AttributeError, IndexError, ArithmeticError)
_MOST_CHUNKS = 64
_FEWEST_SHARDS = 8


@dataclass(frozen=True)
class Group:
    """``count`` chunks of ``width`` rows, ``per_shard`` of them written at once."""

    name: str
    count: int
    width: int

    @property
    def per_shard(self) -> int:
        """Chunks per shard: few files, but enough to keep many workers busy."""
        return max(1, min(_MOST_CHUNKS, self.count // _FEWEST_SHARDS))

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.count // self.per_shard)


@dataclass(frozen=True)
class Field:
    """A variable: type, and shape of its results in one row."""

    name: str
    dtype: str
    shape: tuple[int, ...]


def is_store(path: Path) -> bool:
    """True if there is a Zarr v3 group at ``path``."""
    return (path / "zarr.json").is_file()


def create(path: Path, groups: Sequence[Group], fields: Sequence[Field], attrs: Mapping[str, Any]) -> None:
    """Create an empty store. Raises ``OSError`` without enough space."""
    zarr = _zarr()
    root = zarr.create_group(path, zarr_format=3, attributes=dict(attrs))
    for group in groups:
        own = root.create_group(group.name)
        for name, layout in _layouts(group, fields).items():
            own.create_array(name, **layout, compressors=None if name == DONE else zarr.codecs.Crc32cCodec())


def _layouts(group: Group, fields: Sequence[Field]) -> dict[str, dict[str, Any]]:
    """Shape, type and chunks of every array of ``group``."""
    layouts = {}
    for field in (*fields, Field(POINT, "int64", ())):
        own = tuple(max(n, 1) for n in field.shape)
        layouts[field.name] = {
            "shape": (group.count * group.width, *field.shape),
            "dtype": field.dtype,
            "chunks": (group.width, *own),
            "shards": (group.per_shard * group.width, *own),
        }
    return layouts | {DONE: {"shape": (group.shards,), "dtype": "uint64", "chunks": (1,), "shards": None}}


def check_layout(path: Path, groups: Sequence[Group], fields: Sequence[Field]) -> None:
    """Raise :class:`InputError` unless the layout of the unfinished store is that of :func:`create`.

    Data written into arrays of another layout would be lost silently.
    """
    try:
        root = _zarr().open_group(path, mode="r")
        same = all(
            getattr(root[group.name][name], what) == value
            for group in groups
            for name, layout in _layouts(group, fields).items()
            for what, value in layout.items()
        )
    except _BROKEN:
        same = False
    if not same:
        raise InputError(f"store = {str(path)!r}: its metadata are damaged; allowed is to restore them, or --fresh")


def write(path: Path, group: Group, shard: int, arrays: Mapping[str, np.ndarray]) -> None:
    """Write shard number ``shard`` of ``group`` with all its rows, and mark it done."""
    own = _zarr().open_group(path, mode="r+")[group.name]
    rows = _rows(group, shard)
    for name, values in arrays.items():
        own[name][rows] = values
    own[DONE][shard] = _checksum(arrays)


def done(path: Path, group: Group) -> np.ndarray:
    """Flags of the shards of ``group`` that are marked done."""
    return _zarr().open_group(path, mode="r")[group.name][DONE][:] != 0


def read(path: Path, group: Group, shard: int, names: Sequence[str]) -> dict[str, np.ndarray] | None:
    """The arrays ``names`` of a shard; None if it is damaged. Checking the checksum needs all arrays."""
    zarr, rows = _zarr(), _rows(group, shard)
    try:
        own = zarr.open_group(path, mode="r")[group.name]
        arrays = {name: own[name][rows] for name in names}
        return arrays if own[DONE][shard] == _checksum(arrays) else None
    except _BROKEN:
        return None


def without_padding(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The points of a shard and their results, without padding."""
    rows = arrays[POINT] >= 0
    return arrays[POINT][rows], {name: values[rows] for name, values in arrays.items() if name != POINT}


def attributes(path: Path) -> dict[str, Any]:
    """The attributes of the store; :class:`InputError` if it has none."""
    zarr = _zarr()
    try:
        return dict(zarr.open_group(path, mode="r").attrs)
    except _BROKEN:
        raise InputError(f"store = {str(path)!r}: not a readable Zarr store; give one of --store zarr") from None


def seal(path: Path, attrs: Mapping[str, Any]) -> None:
    """Replace the attributes of the finished store, and add their digest."""
    _zarr().open_group(path, mode="r+").attrs.put({**attrs, SEAL: digest(dict(attrs))})


def is_sealed(path: Path) -> bool:
    """True if the attributes of a finished store are intact; :class:`InputError` if it is not a result."""
    attrs = attributes(path)
    if "digest" not in attrs:
        raise InputError(f"store = {str(path)!r}: not a result of drivetrain_jax; give one of --store zarr")
    return attrs.pop(SEAL, None) == digest(attrs)


def finished(path: Path, name: str) -> Iterator[np.ndarray]:
    """Yield the values of one variable at all finished points, group by group, in stored order."""
    try:
        root = _zarr().open_group(path, mode="r")
        for group in groups_of(root.attrs):
            own = root[group.name]
            flags = np.repeat(own[DONE][:] != 0, group.per_shard * group.width)[: group.count * group.width]
            yield own[name][:][flags & (own[POINT][:] >= 0)]
    except InputError:
        raise
    except _BROKEN:
        raise InputError(f"store = {str(path)!r}: damaged; allowed is to restore it or to compute it again") from None


def tally(path: Path) -> tuple[int, int, int]:
    """Numbers of intact shards, of shards marked done, and of shards of a finished store."""
    intact = marked = count = 0
    for group in groups_of(attributes(path)):
        names = _names(path, group)
        count += group.shards
        intact += sum(read(path, group, shard, names) is not None for shard in range(group.shards))
        marked += _marked(path, group)
    return intact, marked, count


def _names(path: Path, group: Group) -> list[str]:
    """The arrays of a group that its checksums cover."""
    return [file.parent.name for file in (path / group.name).glob("*/zarr.json") if file.parent.name != DONE]


def _marked(path: Path, group: Group) -> int:
    try:
        return int(done(path, group).sum())
    except _BROKEN:
        return 0


def groups_of(attrs: Mapping[str, Any]) -> list[Group]:
    """The groups of a store with these attributes."""
    try:
        return [Group(*entry) for entry in json.loads(attrs[GROUPS])]
    except (KeyError, ValueError, TypeError):
        raise InputError(f"store: its attribute {GROUPS!r} is damaged; allowed is to run its scene again") from None


def describe(groups: Sequence[Group]) -> str:
    """The attribute from which :func:`groups_of` restores them."""
    return json.dumps([[group.name, group.count, group.width] for group in groups])


def _rows(group: Group, shard: int) -> slice:
    size = group.per_shard * group.width
    return slice(shard * size, min((shard + 1) * size, group.count * group.width))


def _checksum(arrays: Mapping[str, np.ndarray]) -> int:
    state = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        state.update(np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8).data)
    # 0 means "not done".
    return int.from_bytes(state.digest(), "little") or 1


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise InputError("store = 'zarr': the package zarr is not installed; install drivetrain_jax[zarr]") from None
    return zarr
