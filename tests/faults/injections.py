"""Faults of processes, disks and folders: functions from a bench to the record of one injection."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

from harness import Bench, Ended, Record, Run, resume, settle, wait

WORKERS = ["--workers", "2"]
ZARR = ["--store", "zarr"]


def stopped_by(number: int) -> Callable[[Ended], bool]:
    """Ended by this signal, or already finished."""
    return lambda ended: ended.code in (-number, 0)


def resumable(ended: Ended) -> bool:
    """Finished, or incomplete with one line that says why."""
    return ended.code == 0 or (ended.code == 3 and len(ended.lines) == 2)


def refused(ended: Ended, why: str = "") -> bool:
    """Wrong input, said in one line."""
    return ended.code == 2 and len(ended.lines) == 1 and why in ended.lines[0]


def strike(run: Run, out: Path, moment: float, blow: Callable[[], object]) -> bool:
    """``blow`` at ``moment`` if the run is still at work on ``out`` then."""
    if not wait(moment, run, out):
        return False
    blow()
    return True


def signalled(bench: Bench, kind: str, number: int, options: list[str], allowed: Callable[[Ended], bool]) -> Record:
    out, moment = bench.place(), bench.moment()
    run = bench.run(out, options)
    hit = strike(run, out, moment, lambda: run.process.send_signal(number))
    ended = run.end()
    return resume(bench, kind, out, moment, hit, ended, settle(run), options, allowed)


def interrupted(ended: Ended) -> bool:
    # Started by -m, CPython ends by the signal itself (130 to a shell as well) if that interrupted the code of a string,
    # such as the methods of a dataclass that is imported, although the interrupt was handled.
    return ended.code in (0, 130, -signal.SIGINT) and len(ended.lines) <= 2


def kill_worker(bench: Bench, kind: str, options: list[str]) -> Record:
    """One of the spawned processes; the run goes on without help."""
    out, moment = bench.place(), bench.moment()
    run = bench.run(out, options)
    victims: list[int] = []

    def blow() -> None:
        victims.extend(workers(run))
        if victims:
            os.kill(int(bench.rng.choice(victims)), signal.SIGKILL)

    hit = strike(run, out, moment, blow) and bool(victims)
    ended = run.end()
    return resume(bench, kind, out, moment, hit, ended, settle(run), options, lambda e: e.code == 0)


def kill_idle(bench: Bench, kind: str, options: list[str]) -> Record:
    """All spawned processes, when they have done what they were given and the driver, held still, has not noticed."""
    out, moment = bench.place(), bench.moment()
    run = bench.run(out, options)
    victims: list[int] = []

    def blow() -> None:
        workers(run)
        run.process.send_signal(signal.SIGSTOP)
        try:
            victims.extend(resting(run))
            for pid in victims:
                os.kill(pid, signal.SIGKILL)
        finally:
            run.process.send_signal(signal.SIGCONT)

    hit = strike(run, out, moment, blow) and bool(victims)
    ended = run.end()
    return resume(bench, kind, out, moment, hit, ended, settle(run), options, lambda e: e.code == 0)


def workers(run: Run) -> list[int]:
    """The spawned processes, once there are any."""
    deadline = time.monotonic() + 60
    while run.process.poll() is None and time.monotonic() < deadline:
        if found := [pid for pid in run.others() if is_worker(pid)]:
            return found
        time.sleep(0.02)
    return []


def resting(run: Run) -> list[int]:
    """The spawned processes, once none of them has used its core for a while."""
    before, deadline = None, time.monotonic() + 60
    while time.monotonic() < deadline:
        used = {pid: cpu_time(pid) for pid in run.others() if is_worker(pid)}
        if used == before:
            return list(used)
        before = used
        time.sleep(0.3)
    return []


def cpu_time(pid: int) -> int:
    """What a process has used so far, in ticks of the system."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])


def is_worker(pid: int) -> bool:
    """A spawned process, not the tracker of resources beside it."""
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def kill_replacing(bench: Bench, kind: str) -> Record:
    """A former result at the output is whole until the new one is."""
    out, moment = bench.place(), bench.moment()
    shutil.copy(bench.reference, out)
    former = out.read_bytes()
    run = bench.run(out, ["--fresh", "--set", "options.rtol=1e-8"])
    hit = strike(run, out, moment, run.process.kill)
    ended = run.end()
    settle(run)
    damaged = hit and ended.code != 0 and out.read_bytes() != former
    shutil.rmtree(out.with_name(out.name + ".parts"), ignore_errors=True)
    out.unlink()
    record = resume(bench, kind, out, moment, hit, ended, 0)
    record.problem += "the former result was damaged" if damaged else ""
    return record


@contextmanager
def small_disk(bench: Bench, size: int):
    """A file system of this size, None where mounting is not permitted."""
    folder = bench.place().parent
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if done.returncode:
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def full_disk(bench: Bench, kind: str) -> Record:
    """The disk fills up at some moment; when there is room again the run is resumed."""
    size, moment = bench.reference.stat().st_size, bench.moment()
    with small_disk(bench, 6 * size) as folder:
        if folder is None:
            return file_limit(bench, kind)
        out, ballast = folder / "r.nc", folder / "ballast"
        run = bench.run(out)

        def blow() -> None:
            with open(ballast, "wb", buffering=0) as file:
                while True:
                    try:
                        file.write(bytes(1 << 16))
                    except OSError:
                        return

        hit = strike(run, out, moment, blow)
        ended = run.end()
        ballast.unlink(missing_ok=True)
        return resume(bench, kind, out, moment, hit, ended, settle(run), (), resumable)


def file_limit(bench: Bench, kind: str) -> Record:
    """No file may grow beyond a random size."""
    out, size = bench.place(), bench.reference.stat().st_size
    limit = int(bench.rng.uniform(0.02, 0.95) * size)
    # The shell counts in blocks of 512 bytes.
    run = bench.run(out, before=["sh", "-c", 'ulimit -f "$0"; exec "$@"', str(limit // 512)])
    ended = run.end()
    return resume(bench, kind, out, 0.0, ended.code != 0, ended, settle(run), (), resumable)


def read_only(bench: Bench, kind: str) -> Record:
    """The file system turns read-only at some moment; where mounting is not permitted, the folder is from the start."""
    moment = bench.moment()
    with small_disk(bench, 64 << 20) as folder:
        if folder is None:
            return read_only_folder(bench, kind)
        out = folder / "r.nc"
        run = bench.run(out)

        def blow() -> None:
            # Open for writing are files of the run itself; a busy file system stays as it is.
            subprocess.run(["mount", "-o", "remount,ro", str(folder)], capture_output=True)

        hit = strike(run, out, moment, blow)
        ended = run.end()
        subprocess.run(["mount", "-o", "remount,rw", str(folder)], check=True)
        return resume(bench, kind, out, moment, hit, ended, settle(run), (), resumable)


def read_only_folder(bench: Bench, kind: str) -> Record:
    """Who may not write there is told so at once. An administrator may write everywhere but on a read-only file system."""
    with small_disk(bench, 64 << 20) if os.getuid() == 0 else nullcontext() as folder:
        out = bench.place() if folder is None else folder / "r.nc"
        if folder is None:
            out.parent.chmod(0o555)
        else:
            subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        run = bench.run(out)
        ended = run.end()
        if folder is None:
            out.parent.chmod(0o755)
        else:
            subprocess.run(["mount", "-o", "remount,rw", str(folder)], check=True)
        return resume(bench, kind, out, 0.0, True, ended, settle(run), (), lambda e: refused(e, "not writable"))


def vanished(bench: Bench, kind: str, whole: bool) -> Record:
    """The folder of parts is deleted under the run, or the output's folder with everything in it."""
    out, moment = bench.place(), bench.moment()
    run = bench.run(out)
    gone = out.parent if whole else out.with_name(out.name + ".parts")
    hit = strike(run, out, moment, lambda: shutil.rmtree(gone, ignore_errors=True))
    ended = run.end()
    out.parent.mkdir(exist_ok=True)
    allowed = (lambda e: resumable(e) or refused(e)) if hit else resumable
    return resume(bench, kind, out, moment, hit, ended, settle(run), (), allowed)


def two_runs(bench: Bench, kind: str) -> Record:
    """The second of two runs on one output is refused, the first is not disturbed."""
    out, moment = bench.place(), bench.moment()
    run = bench.run(out)
    ended = []

    def blow() -> None:
        second = bench.run(out)
        ended.append(second.end())

    hit = strike(run, out, moment, blow)
    first = run.end()

    def allowed(_: Ended) -> bool:
        return first.code == 0 and all(e.code == 0 or refused(e, "another run") for e in ended)

    return resume(bench, kind, out, moment, hit, (ended or [first])[0], settle(run), (), allowed)


def sharded(bench: Bench, kind: str, victim: str) -> Record:
    """A run whose workers write a Zarr store; what it exports to is the same file."""
    out, moment = bench.place().with_name("r.zarr"), bench.moment()
    run = bench.run(out, [*ZARR, *WORKERS])

    def blow() -> None:
        workers = [pid for pid in run.others() if is_worker(pid)]
        os.kill(int(bench.rng.choice(workers)) if victim == "worker" and workers else run.process.pid, signal.SIGKILL)

    hit = strike(run, out, moment, blow)
    ended = run.end()
    orphans = settle(run)
    done = bench.status(out).done
    again = bench.run(out, [*ZARR, *WORKERS])
    finished = again.end()
    orphans += settle(again)
    counts, exported = finished.counts(), out.with_name("e.nc")
    command = [sys.executable, "-m", "drivetrain_jax.cli", "export", str(out), str(exported)]
    code = subprocess.run(command, env=bench.environment, capture_output=True).returncode
    wrong = bench.wrong(exported) if code == 0 else len(bench.arrays)
    reused, computed = counts.get("reused", 0), counts.get("computed", 0)
    problem = "" if finished.code == 0 else f"resume ended with {finished.code}: {finished.lines[-2:]}"
    return Record(kind, moment, hit, ended.code, reused, computed, max(done - reused, 0), wrong, orphans, problem)


def cluster(bench: Bench, kind: str, victim: str) -> Record:
    """A scheduler and two workers of Dask, started as separate commands on loopback."""
    out, moment = bench.place(), bench.moment()
    with ExitStack() as stack:
        address, processes = start_cluster(bench, out.parent, stack)
        run = bench.run(out, ["--dask", address])
        processes["driver"] = run.process
        hit = strike(run, out, moment, lambda: processes[victim].kill())
        ended = run.end()
    return resume(
        bench, kind, out, moment, hit, ended, settle(run), (), lambda e: e.code in (0, 3, -9) or refused(e, "dask")
    )


def start_cluster(bench: Bench, folder: Path, stack: ExitStack) -> tuple[str, dict[str, subprocess.Popen]]:
    """Address and processes; they end with ``stack``."""
    file = folder / "scheduler.json"

    def start(module: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *options, "--no-dashboard"]
        process = subprocess.Popen(command, env=bench.environment, stderr=subprocess.DEVNULL, cwd=folder)
        stack.callback(process.wait)
        stack.callback(process.kill)
        return process

    processes = {"scheduler": start("dask_scheduler", "--port", "0", "--scheduler-file", str(file))}
    common = ("--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--local-directory", str(folder / "dask"))
    processes["worker"], _ = (start("dask_worker", *common) for _ in range(2))
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    return json.loads(file.read_text())["address"], processes
