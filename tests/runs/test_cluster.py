"""A Dask cluster that is not what the run needs: other code on a worker, no package, TLS, no scheduler."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager

import pytest

from drivetrain_jax._errors import InputError
from drivetrain_jax.cli import main
from drivetrain_jax.runs import cluster, identity, toml, worker
from drivetrain_jax.runs.resolve import resolve
from drivetrain_jax.runs.scene import load_scene

SCENE = {
    "system": "cardan",
    "analysis": "floquet",
    "outputs": ["spectral_radius"],
    "axes": {"beta": {"values": [0.1, 0.2]}},
    "fixed": {"zeta": 0.001, "alpha": 1.0, "mu": 1.0, "gamma": 100.0, "Omega": 1.3},
    "options": {"method": "direct"},
}


@pytest.mark.parametrize("name", ["instruction_set", "versions"])
def test_a_worker_of_another_kind_is_refused_before_it_computes(monkeypatch, name):
    sent = pickle.dumps(worker.Parcel.of(resolve(load_scene(SCENE))))
    monkeypatch.setattr(identity, name, {"instruction_set": lambda: {"z80"}, "versions": lambda _: {"jax": "9"}}[name])
    parcel = pickle.loads(sent)
    monkeypatch.setattr(type(parcel.computation), "compute", lambda *_: pytest.fail("it computes"))
    for work in (lambda: worker.prepare(parcel), lambda: worker.compute_all(parcel, [0])):
        with pytest.raises(worker.Mismatch, match=r"^code, versions or instruction set differ from those of the run$"):
            work()


@contextmanager
def silent():
    """Address at which something accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


@contextmanager
def talkative():
    """Address of a server that speaks another protocol."""

    def serve(server):
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server,), daemon=True).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


@contextmanager
def closed():
    """Address at which nothing listens."""
    yield "tcp://127.0.0.1:1"


@contextmanager
def unknown():
    """Protocol that does not exist."""
    yield "gopher://127.0.0.1:1"


@pytest.mark.parametrize("where", [closed, unknown, silent, talkative])
def test_a_wrong_address_is_refused_soon(tmp_path, capsys, monkeypatch, where):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ANSWERED", 1.0)
    (tmp_path / "scene.toml").write_text(toml.write(SCENE))
    with where() as address:
        assert main(["run", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "r.nc"), "--dask", address]) == 2
    said = capsys.readouterr().err
    assert f"dask = {address!r}: no scheduler answers there" in said and len(said.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["scene.toml"]


needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl for a certificate")


def certificate(folder):
    """Files of a new key and its certificate, and the settings with which Dask uses them."""
    key, cert = str(folder / "key.pem"), str(folder / "cert.pem")
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=dask", "-days", "2"]
    subprocess.run([*make, "-keyout", key, "-out", cert], check=True, capture_output=True)
    own = {
        f"tls.{role}.{name}": x
        for role in ("scheduler", "worker", "client")
        for name, x in (("key", key), ("cert", cert))
    }
    return {
        f"distributed.comm.{name}": x for name, x in ({"require-encryption": True, "tls.ca-file": cert} | own).items()
    }


@needs_openssl
@pytest.mark.parametrize("where", [closed, silent, talkative])
def test_a_wrong_address_with_tls_is_refused_soon(tmp_path, monkeypatch, where):
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    monkeypatch.setattr(cluster, "_ANSWERED", 1.0)
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client waits"))
    with where() as address, dask.config.set(certificate(tmp_path)), ExitStack() as stack:
        address = address.replace("tcp", "tls")
        with pytest.raises(InputError, match=f"dask = '{address}': no scheduler answers there"):
            cluster._connect(distributed, address, stack)


@pytest.mark.full
@needs_openssl
def test_a_cluster_with_tls_refuses_other_clients_and_other_workers(tmp_path):
    pytest.importorskip("distributed")
    settings = certificate(tmp_path)
    tls = {f"DASK_{name}".upper().replace(".", "__").replace("-", "_"): str(x) for name, x in settings.items()}
    (tmp_path / "scene.toml").write_text(toml.write(SCENE))
    file = tmp_path / "scheduler.json"

    def start(stack, module, *options, **more):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--scheduler-file", str(file)]
        process = subprocess.Popen(command, env=os.environ | tls | more, stderr=subprocess.DEVNULL)
        stack.callback(process.wait)
        stack.callback(process.kill)

    def run(name, **more):
        command = [sys.executable, "-m", "drivetrain_jax.cli", "run", "scene.toml", "--out", name, "--quiet"]
        command += ["--dask", json.loads(file.read_text())["address"]]
        done = subprocess.run(command, env=os.environ | more, capture_output=True, text=True, cwd=tmp_path, timeout=100)
        return done.returncode, done.stderr.splitlines()

    with ExitStack() as stack:
        start(stack, "dask_scheduler", "--port", "0", "--protocol", "tls", "--no-dashboard")
        while not file.exists():
            time.sleep(0.1)
        common = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
        with ExitStack() as first:
            start(first, "dask_worker", *common, XLA_FLAGS="--xla_cpu_enable_fast_math=true")
            code, lines = run("r.nc", **tls)
            assert code == 3 and len(lines) == 2, lines
            assert "code, versions or instruction set differ from those of the run" in lines[0]
            assert lines[1] == "points: total=2 computed=0 reused=0 failed=0"
        code, lines = run("r.nc")
        assert code == 2 and len(lines) == 1 and "no scheduler answers there" in lines[0], lines
        start(stack, "dask_worker", *common)
        assert run("r.nc", **tls) == (0, ["points: total=2 computed=2 reused=0 failed=0"])
