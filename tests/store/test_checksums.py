"""Checksums of a finished file: every change that a reader would see is found and named."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import xarray as xr

from drivetrain_jax import InputError
from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.store import checksums
from drivetrain_jax.store.consolidate import Entry, Labelled, open_result, write_result
from tests.sizes import full_after


@pytest.fixture
def path(tmp_path):
    axis = Entry(("x",), np.linspace(0, 1, 40), {"units": "m", "long_name": "place"})
    rng = np.random.default_rng(1)
    results = [
        (Variable("z", "1", "complex", ("k",), "complex128"), rng.random((40, 2)) + 1j),
        (Variable("v", "1", "flag", dtype="int8", flags=("no", "yes")), np.zeros(40, np.int8)),
    ]
    # HDF5 stores more than eight attributes in another way.
    attrs = {"title": "one", "analysis": "toy", "numerics_detail": "long"} | {
        f"attribute_{i}": "some" for i in range(9)
    }
    result = Labelled.build(("x",), {"x": axis}, (Dimension("k", "number", ("up", "down")),), results, attrs)
    write_result(result, tmp_path / "r.nc", tmp_path / "tmp")
    return tmp_path / "r.nc"


def test_an_intact_file(path):
    assert checksums.damaged(path) == []


@pytest.mark.parametrize(
    ("change", "named"),
    full_after(
        6,
        [
            (lambda f: f["z"].__setitem__((3, 1), 0), ["z"]),
            (lambda f: f["x"].__setitem__(0, 1e-300), ["x"]),
            (lambda f: f["k"].__setitem__(0, "sideways"), ["k"]),
            (lambda f: f["v"].attrs.modify("units", "m"), ["v"]),
            (lambda f: f.attrs.modify("title", "two"), ["/"]),
            (lambda f: f["provenance"].attrs.modify("numerics_detail", "other"), ["provenance"]),
            (lambda f: f.__delitem__("provenance"), ["provenance"]),
            (lambda f: f.__delitem__("v"), ["v"]),
            (lambda f: f.create_dataset("new", data=1.0), ["new"]),
            (lambda f: f["z"].dims[0].detach_scale(f["x"]), ["z"]),
            (lambda f: f.attrs.modify("checksums", np.bytes_(b"{}")), ["/", "k", "provenance", "v", "x", "z"]),
            (lambda f: f.attrs.modify("checksums", np.bytes_(b"rubbish")), ["/", "k", "provenance", "v", "x", "z"]),
        ],
        several=True,
    ),
)
def test_a_change_is_named(path, change, named):
    with h5py.File(path, "r+") as file:
        change(file)
    assert checksums.damaged(path) == named


def test_large_variables_are_checked_to_their_end(path, monkeypatch):
    """Checksums do not depend on the size of the blocks in which values are read."""
    with h5py.File(path, "r+") as file:
        whole = checksums.checksums(file)
        monkeypatch.setattr(checksums, "_BLOCK", 100)
        assert checksums.checksums(file) == whole
        file["z"][39, 1] = 0
    assert checksums.damaged(path) == ["z"]


def test_a_file_of_another_program_has_no_checksums(tmp_path):
    xr.Dataset({"x": 1.0}).to_netcdf(tmp_path / "f.nc", engine="h5netcdf")
    assert checksums.damaged(tmp_path / "f.nc") is None


def seen(path):
    """The content that a reader sees, as bytes so that NaN and -0 count; None if it cannot read the file."""
    try:
        ds = open_result(path)
    except InputError:
        return None
    return {n: (v.dims, v.dtype.str, v.values.tobytes(), str(v.attrs)) for n, v in ds.variables.items()}, str(ds.attrs)


def test_a_flipped_bit_in_the_name_of_the_checksums_is_one_line(path):
    content = path.read_bytes()
    for bit in range(72):
        damaged = bytearray(content)
        damaged[content.index(b"checksums") + bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="not a readable"):
            open_result(path)


def test_every_flipped_bit_that_a_reader_could_see_is_found(path):
    """Only bytes that no reader reads (gaps of the format) may change unnoticed."""
    whole, content = path.read_bytes(), seen(path)
    rng = np.random.default_rng(7)
    found = 0
    for position in rng.integers(0, len(whole), 120):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            noticed = checksums.damaged(path) != []
        except InputError:
            noticed = True
        found += noticed
        assert noticed or seen(path) == content, position
    assert found > 12


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_truncation_is_found(path, part):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match="not a readable"):
        checksums.damaged(path)
