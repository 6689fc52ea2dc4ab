"""Parts are complete and verified, or ignored."""

from __future__ import annotations

import numpy as np
import pytest

from drivetrain_jax import InputError
from drivetrain_jax.store.chunks import Part, PartsFolder

PLAN = {"digest": "abc", "replaces": None}


def part(first=0):
    rng = np.random.default_rng(first)
    results = {"x": rng.random((5, 2)) + 1j, "outcome": np.zeros(5, np.int8)}
    return Part([first, first + 1], [3, 2], results, 0.5)


@pytest.fixture
def folder(tmp_path):
    parts = PartsFolder(tmp_path / "r.nc")
    parts.open()
    parts.start(PLAN)
    yield parts
    parts.close()


def test_written_parts_are_read(folder):
    folder.write(part())
    folder.write(part(7))
    chunks = {number: results for found in folder.read() for number, results in found}
    assert list(chunks) == [0, 1, 7, 8] and folder.plan() == PLAN and folder.holds_work()
    assert np.array_equal(chunks[0]["x"], part().results["x"][:3]) and chunks[8]["x"].shape == (2, 2)
    assert chunks[1]["x"].dtype == complex and chunks[1]["outcome"].dtype == np.int8
    assert sum(found.seconds for found in folder.read()) == 1.0


def test_every_damaged_byte_is_noticed(folder):
    folder.write(part())
    (file,) = folder.path.glob("*.h5")
    whole = file.read_bytes()
    for position in np.linspace(0, len(whole) - 1, 40).astype(int):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        file.write_bytes(damaged)
        assert list(folder.read()) == []
    for length in (0, 1, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:length])
        assert list(folder.read()) == []


def test_only_repair_deletes(folder):
    folder.write(part())
    (file,) = folder.path.glob("*.h5")
    file.write_bytes(b"rubbish")
    (folder.path / "half.tmp").touch()
    assert list(folder.read()) == [] and file.exists()
    assert list(folder.read(repair=True)) == [] and not file.exists()
    assert not list(folder.path.glob("*.tmp"))


def test_one_run_at_a_time(folder, tmp_path):
    with pytest.raises(InputError, match="another run"):
        PartsFolder(tmp_path / "r.nc").open()
    folder.close()
    again = PartsFolder(tmp_path / "r.nc")
    again.open()
    again.close()


def test_start_deletes_parts_and_close_may_delete_the_folder(folder):
    folder.write(part())
    folder.start({"digest": "def", "replaces": "abc"})
    assert list(folder.read()) == [] and folder.plan()["digest"] == "def"
    folder.close(remove=True)
    assert not folder.path.exists() and not folder.holds_work() and folder.plan() == {}
