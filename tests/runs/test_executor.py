"""Equal results of threads and Dask workers, and results after the death of a worker."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import toy
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax import InputError, systems
from drivetrain_jax._errors import ChunkError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.runs import toml, work
from drivetrain_jax.runs.job import Block
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene
from drivetrain_jax.runs.work import Threads, make_executor, run_threads
from drivetrain_jax.store.parts import PartsFolder

HERE = Path(__file__).parent
DELTA = {"start": 0.1, "stop": 2.0, "num": 3000}
SCENE = {
    "system": "fragile",
    "analysis": "floquet",
    "outputs": ["spectral_radius"],
    "options": {"rtol": 1e-7, "method": "direct"},
    "axes": {"delta": DELTA},
}


@pytest.fixture
def drivetrain(tmp_path):
    """Starts ``drivetrain run`` of a scene of the installed package ``fragile``, with small blocks."""
    info = tmp_path / "packages" / "fragile-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fragile\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[drivetrain_jax.systems]\nfragile = fragile:Fragile\n")
    path = os.pathsep.join([str(info.parent), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
    package = os.environ | {"PYTHONPATH": path, "FRAGILE_FOLDER": str(tmp_path)}

    def start(scene, name, *options):
        file = tmp_path / f"{name}.toml"
        file.write_text(toml.write(scene))
        command = [sys.executable, toy.__file__, "run", str(file), "--out", str(tmp_path / name), "--quiet", *options]
        return subprocess.Popen(command, env=package, stderr=subprocess.PIPE, text=True)

    return start


def finished(process, code=0):
    error = process.communicate(timeout=300)[1]
    assert process.returncode == code, error
    return error


def arrays(path):
    with xr.open_dataset(path, engine="h5netcdf" if path.suffix == ".nc" else "zarr") as ds:
        return ds.load()


@pytest.mark.full
def test_stores_and_executors_give_the_same_bits(drivetrain, tmp_path):
    pytest.importorskip("distributed")
    reference = None
    for name, options in (
        ("threads.nc", []),
        ("threads.zarr", ["--threads", "1"]),
        ("workers.nc", ["--workers", "2"]),
        ("dask.zarr", ["--dask", "local:2"]),
    ):
        assert finished(drivetrain(SCENE, name, *options)).endswith("computed=3000 reused=0 failed=0\n")
        found = arrays(tmp_path / name)
        reference = found if reference is None else reference
        assert found.spectral_radius.values.tobytes() == reference.spectral_radius.values.tobytes()
        assert found.attrs["digest"] == reference.attrs["digest"]


@pytest.mark.full
@pytest.mark.parametrize("name", ["deadly.nc", "deadly.zarr"])
def test_only_the_block_that_kills_every_worker_is_lost(drivetrain, tmp_path, name):
    pytest.importorskip("distributed")
    scene = SCENE | {"axes": {"deadly": {"values": [0, 1]}, "delta": DELTA | {"num": 1000}}}
    error = finished(drivetrain(scene, name, "--workers", "1"))
    found = arrays(tmp_path / name)
    lost = found.outcome.values == Outcome.LOST
    assert lost[1].any() and not lost[0].any() and np.isnan(found.spectral_radius.values[lost]).all()
    assert (found.outcome.values[~lost] == Outcome.SUCCESS).all()
    assert f"computed={found.outcome.size} reused=0 failed={lost.sum()}" in error


@pytest.mark.full
def test_a_killed_driver_resumes(drivetrain, tmp_path):
    pytest.importorskip("distributed")
    scene = SCENE | {"axes": {"delta": DELTA | {"num": 100_000}}}
    driver = drivetrain(scene, "stopped.nc", "--workers", "2")
    while not list((tmp_path / "stopped.nc.parts").glob("*.npz")):
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.05)
    driver.send_signal(signal.SIGKILL)
    driver.wait(timeout=30)
    resumed = finished(drivetrain(scene, "stopped.nc"))
    assert "failed=0" in resumed and "reused=0" not in resumed
    finished(drivetrain(scene, "threads.nc"))
    one, other = arrays(tmp_path / "stopped.nc"), arrays(tmp_path / "threads.nc")
    assert one.spectral_radius.values.tobytes() == other.spectral_radius.values.tobytes()


def test_threads_queue_a_few_chunks():
    begun = []

    def chunks():
        for number in range(100):
            begun.append(number)
            yield number

    computed = run_threads(chunks(), lambda _: {"value": np.zeros(1)}, 1)
    for finished in range(2):
        next(computed)
        assert len(begun) == finished + 8
    assert sorted(number for number, _ in computed) == sorted({*range(100)} - {0, 1})


def test_threads_are_reused_except_after_an_interrupt():
    """A chunk that still runs after an interrupt does not delay the next run."""
    result, stop = {"value": np.zeros(1)}, threading.Event()

    def threads_of_a_run():
        used = set()
        chunks = run_threads(range(4), lambda _: used.add(threading.current_thread()) or result, 1)
        assert sorted(number for number, _ in chunks) == [0, 1, 2, 3]
        return used

    first = threads_of_a_run()
    assert first == threads_of_a_run() and len(first) == 1
    left = run_threads(range(2), lambda number: result if number == 0 else stop.wait(60) and result, 1)
    next(left)
    left.close()
    assert threads_of_a_run().isdisjoint(first)
    stop.set()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"threads": 0}, "threads = 0: expected threads >= 1"),
        ({"threads": "2"}, "threads = '2': expected threads >= 1, an integer"),
        ({"threads": True}, "threads = True: expected threads >= 1, an integer"),
        ({"workers": 1.5}, "workers = 1.5: expected workers >= 1, an integer"),
        ({"dask": 5}, "dask = 5: expected tcp://HOST:PORT or local:N"),
        ({"threads": 1, "workers": 1}, "threads: given together with workers"),
        ({"dask": "localhost"}, "dask = 'localhost': expected tcp://HOST:PORT or local:N"),
        ({"dask": "tcp://127.0.0.1:1"}, "dask = 'tcp://127.0.0.1:1': no scheduler answers"),
    ],
)
def test_wrong_executor_is_one_clear_line(monkeypatch, options, message):
    if "dask" in options:
        pytest.importorskip("distributed")
        monkeypatch.setattr(work, "_ANSWERED", 1.0)
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        make_executor(**options).check(dt.Cardan)


def test_a_class_of_a_session_is_refused_before_workers_start(monkeypatch):
    """Workers import the module of a class; that of a notebook has no file."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", "<cell>", raising=False)
    own = type("Own", (dt.Rattle,), {"name": "own", "__module__": "__main__"})
    with pytest.raises(InputError, match=r"^system = 'own': workers cannot import a class of this session; expected"):
        make_executor(workers=1).check(own)


def test_a_worker_imports_the_module_of_a_registered_class(grid_scene, monkeypatch):
    """The class is registered in a worker as it is in the driver."""
    own = load_scene(grid_scene).system
    monkeypatch.setattr("drivetrain_jax.systems._REGISTERED", {})
    monkeypatch.setattr("drivetrain_jax.systems.system_names", lambda: ("cardan",))
    dt.register(own)
    sent = pickle.dumps(resolve(load_scene(grid_scene)))
    systems._REGISTERED.clear()
    assert pickle.loads(sent).problem.system is own is systems.get_system(own.name)
    assert own.name in systems._REGISTERED


def test_a_worker_of_another_kind_is_refused_before_it_computes(grid_scene, monkeypatch):
    job = resolve(load_scene(grid_scene))
    sent, expected = pickle.dumps(job), job.digest
    monkeypatch.setattr("drivetrain_jax._programs.versions", lambda _: {"jax": "9"})
    copy = pickle.loads(sent)
    monkeypatch.setattr(type(job), "compute", lambda *_: pytest.fail("it computes"))
    with pytest.raises(ChunkError, match=r"^code, versions or instruction set differ from those of the run$"):
        work.compute(copy, None, expected, Block(0), 0)


@pytest.mark.usefixtures("small_blocks")
def test_a_worker_stores_its_block_and_returns_outcomes(grid_scene, tmp_path):
    job = resolve(load_scene(grid_scene))
    store = PartsFolder(tmp_path / "r.nc")
    store.path.mkdir()
    copy, stored = pickle.loads(pickle.dumps((job, store)))
    block = Block(1, np.array([25, 27]))
    assert list(work.compute(copy, stored, job.digest, block, 7)) == ["outcome"]
    for name, values in job.compute_block(block).items():
        assert values.tobytes() == store.read(7)[name].tobytes()


def test_missing_blocks_are_an_error(grid_scene, monkeypatch):
    monkeypatch.setattr(Threads, "run", lambda *_: (block for block in ()))
    with pytest.raises(dt.Incomplete, match=r"^some blocks returned no result"):
        dt.run(grid_scene)


@pytest.mark.full
@pytest.mark.parametrize("system", ["planetary", "toy"])
def test_a_local_cluster_without_workers_gets_new_ones(monkeypatch, system):
    """Dask gives up workers that die while they start; here they do not know the toy."""
    pytest.importorskip("distributed")
    toy.names(monkeypatch.setattr)
    monkeypatch.setattr(work, "_PATIENCE", 5.0)
    analysis, fixed = ("modes", {}) if system == "planetary" else ("toy", {"a": 1.0})
    job = resolve(load_scene({"system": system, "analysis": analysis, "fixed": fixed}))
    cluster = work.make_executor(workers=1)
    try:
        cluster._client = work._connect(work._distributed(), "local:1", cluster._connection)
        for nanny in cluster._client.cluster.workers.values():
            cluster._client.cluster.sync(nanny.kill)
        assert not cluster._client.nthreads()
        blocks = cluster.run(job, job.blocks(), None, 0, lambda _: None)
        if system == "toy":
            with pytest.raises(ChunkError, match="end as soon as they start"):
                next(blocks)
        else:
            ((_, results),) = blocks
            assert (results["outcome"] == Outcome.SUCCESS).all()
    finally:
        cluster.close()
