"""Blocks are complete and verified, or ignored."""

from __future__ import annotations

import hashlib
import pickle

import numpy as np
import pytest

from drivetrain_jax import InputError
from drivetrain_jax.store.parts import PartsFolder

PLAN = {"digest": "abc", "replaces": None}
RESULTS = {"x": np.random.default_rng(0).random((5, 2)) + 1j, "outcome": np.zeros(5, np.int8)}


@pytest.fixture
def folder(tmp_path):
    parts = PartsFolder(tmp_path / "r.nc")
    parts.open()
    parts.start(PLAN)
    yield parts
    parts.close()


def test_written_blocks_are_read(folder):
    folder.write(7, RESULTS)
    pickle.loads(pickle.dumps(folder)).write(1, RESULTS)
    assert folder.numbers() == [1, 7] and folder.plan() == PLAN and folder.holds_work()
    for number in (1, 7):
        found = folder.read(number)
        assert all(found[n].dtype == x.dtype and found[n].tobytes() == x.tobytes() for n, x in RESULTS.items())
    assert folder.read(2) is None


def test_every_damaged_byte_is_noticed(folder):
    folder.write(0, RESULTS)
    (file,) = folder.path.glob("*.npz")
    whole = file.read_bytes()
    for position in np.linspace(0, len(whole) - 1, 40).astype(int):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        file.write_bytes(damaged)
        assert folder.read(0) is None
    for length in (0, 1, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        assert folder.read(0) is None
    # The block is computed again, and lies beside the damaged file if its bytes differ.
    folder.write(0, {"outcome": np.ones(5, np.int8)})
    assert folder.numbers() == [0] and folder.read(0)["outcome"].all()


@pytest.mark.parametrize("content", [b"", b"no archive", b"\x93NUMPY\x01\x00junk"])
def test_content_with_its_digest_that_is_no_block_does_not_count(folder, content):
    digest = hashlib.blake2b(content, digest_size=16).hexdigest()
    (folder.path / f"00000000-{digest}.npz").write_bytes(content)
    assert folder.numbers() == [0] and folder.read(0) is None


def test_one_run_at_a_time(folder, tmp_path):
    with pytest.raises(InputError, match="another run"):
        PartsFolder(tmp_path / "r.nc").open()
    folder.close()
    again = PartsFolder(tmp_path / "r.nc")
    again.open()
    again.close()


def test_start_deletes_blocks_and_close_may_delete_the_folder(folder):
    folder.write(0, RESULTS)
    folder.start({"digest": "def", "replaces": "abc"})
    assert folder.numbers() == [] and folder.plan()["digest"] == "def"
    folder.close(remove=True)
    assert not folder.path.exists() and not folder.holds_work() and folder.plan() == {}
