"""Equal results of threads, processes and a Dask cluster, and results after the death of one of them."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import xarray as xr

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax.analysis import Outcome
from drivetrain_jax.runs import cluster, toml
from drivetrain_jax.runs.cluster import Cluster
from drivetrain_jax.runs.executor import Threads, run_threads
from drivetrain_jax.runs.executors import make_executor
from drivetrain_jax.runs.plan import Chunk
from drivetrain_jax.runs.run import run_to_file

HERE = Path(__file__).parent
SCENE = {
    "system": "fragile",
    "analysis": "floquet",
    "outputs": ["spectral_radius"],
    "options": {"rtol": 1e-7},
    "axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 3000}},
}


@pytest.fixture
def package(tmp_path):
    """The environment in which the system ``fragile`` is an installed package."""
    info = tmp_path / "packages" / "fragile-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fragile\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[drivetrain_jax.systems]\nfragile = fragile:Fragile\n")
    path = os.pathsep.join([str(info.parent), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PYTHONPATH": path, "FRAGILE_FOLDER": str(tmp_path)}


@pytest.fixture
def drivetrain(package, tmp_path):
    """Starts ``drivetrain run`` of a scene into a file of ``tmp_path``."""

    def start(scene, name, *options):
        path = tmp_path / f"{name}.toml"
        path.write_text(toml.write(scene))
        command = [sys.executable, "-m", "drivetrain_jax.cli", "run", str(path), "--out", str(tmp_path / f"{name}.nc")]
        return subprocess.Popen([*command, "--quiet", *options], env=package, stderr=subprocess.PIPE, text=True)

    return start


@pytest.mark.full
def test_two_stores_of_one_scene_are_written_by_the_same_workers(tmp_path):
    """Workers keep the computation of the last run, which must not decide where the next one writes."""
    scene = {"system": "planetary", "analysis": "modes", "outputs": ["natural_frequency"]}
    scene["axes"] = {"k_sp": {"start": 4e8, "stop": 5e8, "num": 40}}
    executor = make_executor(workers=1)
    try:
        for name, store in (("a.nc", "hdf5"), ("b.zarr", "zarr"), ("c.zarr", "zarr")):
            with mock.patch.object(executor, "close"):
                assert run_to_file(scene, tmp_path / name, executor=executor, store=store).computed == 40
    finally:
        executor.close()
    reference = arrays(tmp_path / "a.nc").natural_frequency.values
    for name in ("b.zarr", "c.zarr"):
        assert xr.open_zarr(tmp_path / name).natural_frequency.values.tobytes() == reference.tobytes()


def finished(process, code=0):
    error = process.communicate(timeout=120)[1]
    assert process.returncode == code, error
    return error


def arrays(path):
    with xr.open_dataset(path, engine="h5netcdf") as ds:
        return ds.load()


def state(pid):
    """State letter and parent of a process; it may end meanwhile."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "X", 0
    return fields[0], int(fields[1])


def children(pid):
    return [n for n in (int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit()) if state(n)[1] == pid]


def alive(pid):
    return state(pid)[0] not in "XZ"


def wait_until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.full
def test_processes_and_dask_give_the_same_bits_as_threads(drivetrain, tmp_path):
    distributed = pytest.importorskip("distributed")
    assert distributed.__version__
    for name, options in (("threads", []), ("workers", ["--workers", "2"]), ("dask", ["--dask", "local:2"])):
        assert finished(drivetrain(SCENE, name, *options)).endswith("computed=3000 reused=0 failed=0\n")
    reference = arrays(tmp_path / "threads.nc")
    for name in ("workers", "dask"):
        other = arrays(tmp_path / f"{name}.nc")
        assert other.spectral_radius.values.tobytes() == reference.spectral_radius.values.tobytes()
        assert other.attrs["digest"] == reference.attrs["digest"]


@pytest.mark.full
@pytest.mark.parametrize("store", ["hdf5", "zarr"])
def test_only_the_chunk_that_kills_every_process_is_lost(drivetrain, tmp_path, store):
    scene = SCENE | {"axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 96}, "deadly": {"values": [0, 1]}}}
    error = finished(drivetrain(scene, "deadly", "--workers", "1", "--store", store))
    path = tmp_path / "deadly.nc"
    ds = arrays(path) if store == "hdf5" else xr.open_zarr(path).load()
    lost = ds.outcome.values == Outcome.LOST
    assert lost[:, 1].any() and np.isnan(ds.spectral_radius.values[lost]).all()
    assert (ds.outcome.values[~lost] == Outcome.SUCCESS).all() and (~lost).any()
    assert f"computed={ds.outcome.size} reused=0 failed={lost.sum()}" in error


@pytest.mark.full
def test_a_chunk_whose_process_dies_once_is_computed_again(drivetrain, tmp_path):
    scene = SCENE | {"axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 40}}}
    assert "failed=0" in finished(drivetrain(scene | {"fixed": {"deadly": 2}}, "once", "--workers", "1"))
    assert (tmp_path / "died").exists()
    finished(drivetrain(scene, "never"))
    once, never = (arrays(tmp_path / f"{name}.nc").spectral_radius.values for name in ("once", "never"))
    np.testing.assert_allclose(once, never, rtol=1e-7)


@pytest.mark.full
@pytest.mark.parametrize(("deaths", "code"), [("1", 0), ("9", 3)])
def test_a_process_that_dies_at_its_start_is_started_again(drivetrain, package, deaths, code):
    package["FRAGILE_AT_START"] = deaths
    scene = SCENE | {"axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 40}}}
    error = finished(drivetrain(scene, "starts", "--workers", "1"), code)
    assert ("computed=40 reused=0 failed=0" if code == 0 else "crash during their start") in error


@pytest.mark.full
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_driver(drivetrain, tmp_path, sent):
    scene = SCENE | {"axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 150_000}}}
    driver = drivetrain(scene, "stopped", "--workers", "2")
    wait_until(lambda: len(children(driver.pid)) >= 2 or driver.poll() is not None)
    wait_until(lambda: list((tmp_path / "stopped.nc.parts").glob("*.h5")) or driver.poll() is not None)
    workers = children(driver.pid)
    assert len(workers) >= 2
    driver.send_signal(sent)
    driver.wait(timeout=30)
    wait_until(lambda: not any(map(alive, workers)), 10)
    assert driver.returncode == (130 if sent == signal.SIGINT else -signal.SIGKILL)
    resumed = finished(drivetrain(scene, "stopped", "--workers", "2"))
    assert "failed=0" in resumed and "reused=0" not in resumed


@pytest.mark.full
def test_external_scheduler_and_workers(drivetrain, package, tmp_path):
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    file = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen([*command, "--scheduler-file", str(file)], env=package, stderr=subprocess.DEVNULL)
    options = ["--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path)]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", *options]
    workers = [subprocess.Popen(worker, env=package, stderr=subprocess.DEVNULL) for _ in range(2)]
    try:
        wait_until(file.exists)
        address = json.loads(file.read_text())["address"]
        scene = SCENE | {"axes": {"delta": {"start": 0.1, "stop": 2.0, "num": 150_000}}}
        driver = drivetrain(scene, "cluster", "--dask", address)
        wait_until(lambda: list((tmp_path / "cluster.nc.parts").glob("*.h5")) or driver.poll() is not None)
        workers[0].kill()
        assert "failed=0" in finished(driver)
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()
    finished(drivetrain(scene, "threads"))
    one, other = arrays(tmp_path / "cluster.nc"), arrays(tmp_path / "threads.nc")
    assert one.spectral_radius.values.tobytes() == other.spectral_radius.values.tobytes()


@dataclass
class Digest:
    """A computation with a digest alone, which is never computed."""

    digest: str


def test_runs_on_one_scheduler_do_not_share_chunks(monkeypatch):
    """A grown result and its whole scene have the same digest, but different points under the same chunk numbers."""
    distributed = pytest.importorskip("distributed")

    def slow(_, chunk):
        time.sleep(0.2)
        return {"points": chunk.points}

    monkeypatch.setattr("drivetrain_jax.runs.cluster.worker.compute", slow)
    same = Digest("digest")
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, ThreadPoolExecutor(2) as pool:

        def run(first):
            chunks = [Chunk(number, 0, 1, np.array([first + number]), 1) for number in range(3)]
            with closing(Cluster(cluster.scheduler_address)) as executor:
                return [(c.points, results["points"]) for c, results in executor.run(same, chunks)]

        for found in pool.map(run, (0, 100)):
            assert len(found) == 3
            for wanted, got in found:
                np.testing.assert_array_equal(got, wanted)


class Numbers:
    """Forty tasks with a known length."""

    def __len__(self):
        return 40

    def __getitem__(self, number):
        return Chunk(range(40)[number], 0, 1, np.array([number]), 1)


def test_requests_of_several_tasks_lose_only_the_one_that_kills_workers(monkeypatch):
    distributed = pytest.importorskip("distributed")
    compute_all, take, requests = cluster.worker.compute_all, cluster._Requests.take, []

    def taken(self):
        requests.append([task.number for task in take(self)])
        return tuple(map(Numbers().__getitem__, requests[-1]))

    def deadly(parcel, tasks):
        if any(task.number == 17 for task in tasks):
            raise distributed.KilledWorker("task", SimpleNamespace(address="tcp://"), 3)
        return compute_all(parcel, tasks)

    monkeypatch.setattr(cluster._Requests, "take", taken)
    monkeypatch.setattr(cluster.worker, "compute_all", deadly)
    monkeypatch.setattr(cluster.worker, "compute", lambda _, chunk: {"points": chunk.points})
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**options) as started, closing(Cluster(started.scheduler_address)) as executor:
        found = {chunk.number: results for chunk, results in executor.run(Digest("d"), Numbers())}
    assert found.pop(17) is None and found == {n: {"points": n} for n in range(40) if n != 17}
    requests = [request for request in requests if request]
    assert len(requests) < 30 and [17] in requests and max(map(len, requests)) > 3
    # Requests are small at the start, and small again at the end, so that all workers end at the same time.
    assert len(requests[0]) == len(requests[-1]) == 1


def test_size_of_requests_follows_their_time_and_bytes():
    requests = cluster._Requests(range(100_000), 2)
    assert requests.take() == (0,)
    for _ in range(9):
        count = len(requests.take())
        requests.learn(count, 8, 0.01 * count)
    assert len(requests.take()) == 100
    requests.learn(100, 1 << 25, 1.0)
    assert len(requests.take()) == 50
    unknown = cluster._Requests(iter(x for x in range(9)), 1)
    unknown.learn(1, 8, 0.001)
    assert unknown.take() == (0,) and unknown.take() == (1,)


@pytest.mark.parametrize(("values", "ahead"), [(1, 32), (1 << 20, 2)])
def test_threads_queue_many_chunks_only_if_results_are_small(values, ahead):
    results, begun = {"value": np.zeros(values)}, []

    def chunks():
        for number in range(100):
            begun.append(number)
            yield number

    finished = run_threads(chunks(), lambda _: results, 1)
    next(finished)
    assert len(begun) == 2
    next(finished)
    # One task is finished, and ``ahead`` tasks are queued.
    assert len(begun) == 1 + ahead
    assert sorted(number for number, _ in finished) == sorted({*range(100)} - {0, 1})


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
        ({"threads": 0}, "threads = 0: allowed is threads >= 1"),
        ({"threads": "2"}, "threads = '2': allowed is threads >= 1, an integer"),
        ({"threads": True}, "threads = True: allowed is threads >= 1, an integer"),
        ({"workers": 1.5}, "workers = 1.5: allowed is workers >= 1, an integer"),
        ({"workers": 100_000}, "workers = 100000: allowed is workers <= "),
        ({"dask": 5}, "dask = 5: allowed is tcp://HOST:PORT or local:N"),
        ({"threads": 1, "workers": 1}, "threads: given together with workers"),
        ({"dask": "localhost"}, "dask = 'localhost': allowed is tcp://HOST:PORT or local:N"),
        ({"dask": "tcp://127.0.0.1:1"}, "dask = 'tcp://127.0.0.1:1': no scheduler answers"),
    ],
)
def test_wrong_executor_is_one_clear_line(options, message):
    if "dask" in options:
        pytest.importorskip("distributed")
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        list(make_executor(**options).run(_engine(), [0]))


@pytest.mark.full
def test_a_script_without_guard_is_told_so(tmp_path):
    """Each process imports the script, which would start the run again."""
    script = tmp_path / "script.py"
    script.write_text("import drivetrain_jax as dt\ndt.run('quickstart', workers=2)\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=120)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and last.endswith("of the script, which each process imports")
    assert "workers: the call starts the run again in each process" in last and "bootstrapping" not in done.stderr


def _engine():
    from drivetrain_jax.runs.resolve import resolve
    from drivetrain_jax.runs.scene import load_scene

    point = dict(beta=0.1, Omega=1.0, zeta=0.001, alpha=1.0, mu=1.0, gamma=100.0)
    return resolve(load_scene({"system": "cardan", "analysis": "floquet", "fixed": point}))


@pytest.mark.full
def test_a_process_that_dies_between_two_chunks_is_replaced():
    """Without a chunk in flight no result reports the death; the remaining points must still be computed."""
    seen = []

    def report(progress):
        seen.append(progress.computed)
        if len(seen) == 2:
            time.sleep(1)  # Both chunks in flight are done by then.
        elif len(seen) == 3:
            (worker,) = multiprocessing.active_children()
            worker.kill()
            time.sleep(1)

    axes = {"beta": {"start": 0.1, "stop": 1.0, "num": 40}, "Omega": {"start": 0.5, "stop": 2.0, "num": 40}}
    ds = dt.run(cardan_scene(axes), workers=1, report=report)
    assert seen[:3] == [0, 512, 1024] and seen[-1] == 1600
    assert (ds.outcome.values == Outcome.SUCCESS).all()


def test_missing_chunks_are_an_error(monkeypatch):
    monkeypatch.setattr(Threads, "run", lambda *_: (chunk for chunk in ()))
    with pytest.raises(dt.Incomplete, match=r"^1 chunk returned no result"):
        dt.run(cardan_scene({"beta": {"values": [0.1, 0.2]}, "Omega": {"values": [1.0]}}))


def cardan_scene(axes):
    shaft = {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0}
    return {"system": "cardan", "analysis": "floquet", "axes": axes, "fixed": shaft, "options": {"method": "direct"}}
