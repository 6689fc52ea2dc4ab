"""Files in the netCDF4 format: for every reader equal to the file that h5netcdf writes of the same result."""

from __future__ import annotations

import errno
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

from drivetrain_jax._quantities import Dimension, Variable
from drivetrain_jax.store.consolidate import Entry, Labelled, ResultFile, write_result

OWN = {"_NCProperties", "checksums"}


@pytest.fixture
def result():
    """A result with and without coordinates, an empty dimension, texts, codes, complex numbers, an auxiliary coordinate."""
    x = Entry(("x",), np.array([1.0, 2.0]), {"units": "m", "long_name": "place"})
    time = Entry(("x",), np.array([0.0, 5.0]), {"units": "s", "long_name": "instant"})
    results = [
        (Variable("z", "1", "complex", ("k",), "complex128"), np.array([[1 + 2j, np.nan], [0, -1j]])),
        (Variable("e", "s", "empty", ("none",)), np.empty((2, 0))),
        (Variable("n", "s", "many", ("a", "b", "number")), np.arange(48.0).reshape(2, 3, 2, 4)),
        (Variable("v", "1", "flag", dtype="int8", flags=("no", "not at all")), np.array([0, 1], np.int8)),
    ]
    dims = (Dimension("k", "name", ("up", "é")), Dimension("number", "number", (), "s"))
    attrs = {"digest": "abc", "scene": "é = 1\n" * 30_000, "wall_time_s": 1.5, "solves": 3, "none": ""}
    return Labelled.build(("x",), {"x": x, "t0": time}, dims, results, attrs)


@pytest.fixture
def path(result, tmp_path):
    write_result(result, tmp_path / "r.nc", tmp_path / "tmp")
    return tmp_path / "r.nc"


def kind(of):
    """A type of HDF5, and a flag for a named type of the file."""
    text = of.get_cset() if isinstance(of, h5py.h5t.TypeStringID) else None
    return str(of.dtype), of.get_class(), text, of.committed()


def shown(file, key, value):
    """The value of an attribute, with references to dimensions and variables replaced by their names."""
    if isinstance(value, h5py.Reference):
        return file[value].name
    if key.startswith("_Netcdf4"):
        numbers = {int(v.attrs["_Netcdf4Dimid"]): name for name, v in file.items() if "CLASS" in v.attrs}
        return [numbers[number] for number in np.atleast_1d(value)]
    if isinstance(value, (np.ndarray, np.void)):
        parts = [shown(file, key, part) for part in value]
        # The order of the links between variables and a dimension does not matter.
        return sorted(parts) if key == "REFERENCE_LIST" and isinstance(value, np.ndarray) else parts
    return repr(value)


def listing(path):
    """The content of a file by name: types, shapes, values, and all attributes, hidden ones included."""
    with h5py.File(path) as file:
        found = {}
        for name, item in {"/": file, **file}.items():
            if isinstance(item, h5py.Dataset):
                found[name] = kind(item.id.get_type()), item.shape, item.maxshape, repr(item.fillvalue), repr(item[()])
            if isinstance(item, h5py.Datatype):
                found[name] = kind(item.id)
            for key in item.attrs:
                of = item.attrs.get_id(key)
                found[f"{name}@{key}"] = kind(of.get_type()), of.shape, shown(file, key, item.attrs[key])
        return {key: value for key, value in found.items() if key.removeprefix("/@") not in OWN}


def test_the_file_is_what_h5netcdf_writes(result, path, tmp_path):
    result.to_dataset().to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    ours, theirs = listing(path), listing(tmp_path / "x.nc")
    # Our file also lists the auxiliary coordinate in a global attribute.
    assert ours.pop("/@coordinates")[2] == "'t0'"
    assert ours == theirs


def test_netcdf4_reads_what_was_written(result, path):
    with netCDF4.Dataset(path, auto_complex=True) as file:
        assert {name: dim.size for name, dim in file.dimensions.items()} == result.sizes
        # The order of dimensions is the same in every process.
        assert list(file.dimensions) == ["x", "k", "number", "none", "a", "b"]
        assert file.data_model == "NETCDF4" and file.wall_time_s == 1.5 and file.solves == 3 and file.none == ""
        for name, entry in {**result.coords, **result.data}.items():
            assert file[name].dimensions == entry.dims
            np.testing.assert_array_equal(np.ma.filled(file[name][...], np.nan), entry.values)
            assert {"units", "long_name"} <= set(file[name].ncattrs())


def test_a_scalar_without_any_dimension(tmp_path):
    scalars = [(Variable("f", "s", "time"), np.array(np.pi)), (Variable("z", "1", "c", (), "complex128"), np.array(2j))]
    write_result(Labelled.build((), {}, (), scalars, {"digest": "abc"}), tmp_path / "r.nc", tmp_path / "tmp")
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as again:
        assert (again["f"].item(), again["z"].item(), dict(again.sizes)) == (np.pi, 2j, {})


def test_data_are_contiguous_and_allocated(result, path):
    with h5py.File(path) as file:
        for name, entry in result.data.items():
            variable = file[name]
            assert variable.id.get_storage_size() == entry.values.nbytes
            assert variable.chunks is None or not variable.size


def test_lengths_that_disagree_are_refused():
    results = [(Variable("f", "s", "time", ("k",)), np.ones(3))]
    labelled = Labelled.build((), {}, (Dimension("k", "name", ("up", "down")),), results, {})
    with pytest.raises(ValueError, match="f: length 3 along 'k', which has length 2"):
        _ = labelled.sizes


def test_a_finished_file_stays_finished_on_a_failing_disk(result, tmp_path, monkeypatch):
    """An export whose file was in place ended with an error, and could not be repeated."""

    def unlink(*_, **__):
        raise OSError(errno.EIO, "Input/output error")

    with ResultFile(tmp_path / "r.tmp") as file:
        for name, array in file.lay_out(result).items():
            array[...] = result.data[name].values
        file.finish(tmp_path / "r.nc")
        monkeypatch.setattr(Path, "unlink", unlink)
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as again:
        assert again.attrs["digest"] == "abc"
