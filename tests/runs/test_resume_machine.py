"""The protocol of resuming as a state machine: runs, interrupts, kills, damage, other scenes, growth, two runs at once."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import toy
import xarray as xr
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule, run_state_machine_as_test

import drivetrain_jax as dt
from drivetrain_jax import InputError
from drivetrain_jax.runs.output import status
from drivetrain_jax.runs.run import Interrupted, run_to_file
from drivetrain_jax.runs.work import Threads
from drivetrain_jax.store import zarr_store
from drivetrain_jax.store.parts import PartsFolder
from tests.sizes import full_after

COUNTS, NUMBERS = (8, 24, 40), (3, 4)


def copied_if_there(source, target):
    """Another thread may rename a temporary file between the list of a folder and the copy of the file."""
    with suppress(FileNotFoundError):
        shutil.copy2(source, target)


class ResumeMachine(RuleBasedStateMachine):
    """One output, and the scene that the user wants there."""

    store, name = "hdf5", "r.nc"

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="machine-"))
        self.path = self.folder / "work" / self.name
        self.path.parent.mkdir()
        self.parts = PartsFolder(self.path)
        self.held = None

    def teardown(self):
        shutil.rmtree(self.folder, ignore_errors=True)

    @initialize(count=st.sampled_from(COUNTS), number=st.sampled_from(NUMBERS))
    def choose(self, count, number):
        self.count, self.number = count, number

    @property
    def scene(self):
        axes = {"b": {"values": [1.0, 3.0]}, "a": {"values": [k / 8 for k in range(self.count)]}}
        return {"system": "toy", "analysis": "toy", "outputs": ["value"], "axes": axes, "fixed": {"n": self.number}}

    def expected(self):
        b, a = np.meshgrid([1.0, 3.0], np.arange(self.count) / 8, indexing="ij")
        return a + b * self.number + 321.0

    def start(self, **how):
        return run_to_file(self.scene, self.path, executor=Threads(1), store=self.store, **how)

    def judge(self, progress, before):
        """A run that ends has every point, right values, and computes no finished point again."""
        assert progress.computed + progress.reused == progress.total == 2 * self.count and progress.failed == 0
        assert progress.reused >= before
        found = status(self.scene, self.path)
        assert (found.state, found.done) == ("complete", 2 * self.count)
        # Parts of an interrupted ``--fresh`` stay beside a complete result: only ``--fresh`` resumes them.
        assert progress.computed == 0 or not self.parts.path.exists()
        value = self.opened()["value"].values
        np.testing.assert_allclose(value, self.expected(), rtol=1e-14)
        self.held = (self.count, self.number)

    def opened(self):
        return dt.open_result(self.path)

    def allowed(self):
        """True if a run without ``fresh`` may begin, and the number of points that it finds."""
        found = status(self.scene, self.path)
        return found.state != "stale", found.done

    @rule()
    def run(self):
        may, before = self.allowed()
        if may:
            self.judge(self.start(), before)
        else:
            kept = self.content()
            with pytest.raises(InputError, match="--fresh"):
                self.start()
            assert self.content() == kept

    @rule()
    def run_afresh(self):
        self.judge(self.start(fresh=True), 0)

    @rule(chunks=st.integers(0, 4), kill=st.booleans(), fresh=st.booleans())
    def stop(self, chunks, kill, fresh):
        """Interrupt after some chunks; what lies there after a kill is a copy from that moment."""
        may, before = self.allowed()
        if not (may or fresh):
            return
        copy, left = self.folder / "copy", iter(range(chunks + 1))

        def report(_):
            if next(left, None) is None:
                if kill and not copy.exists():
                    shutil.copytree(self.path.parent, copy, copy_function=copied_if_there)
                raise KeyboardInterrupt

        try:
            self.judge(self.start(fresh=fresh, report=report), 0 if fresh else before)
        except Interrupted:
            if kill:
                # Not removed: threads may still write there for a moment.
                self.path.parent.rename(Path(tempfile.mkdtemp(dir=self.folder)) / "killed")
                copy.rename(self.path.parent)
            now = status(self.scene, self.path)
            assert fresh or now.state == "stale" or now.done >= before

    @rule(count=st.sampled_from(COUNTS))
    def resize(self, count):
        self.count = count

    @rule(number=st.sampled_from(NUMBERS))
    def change(self, number):
        self.number = number

    @precondition(lambda self: any(self.parts.path.glob("*-*.npz")))
    @rule(data=st.data())
    def damage(self, data):
        part = data.draw(st.sampled_from(sorted(self.parts.path.glob("*-*.npz"))))
        content = bytearray(part.read_bytes())
        at = data.draw(st.integers(0, max(len(content) - 1, 0)))
        if data.draw(st.booleans()) and content:
            content[at] ^= 1 << data.draw(st.integers(0, 7))
        else:
            del content[at:]
        part.write_bytes(content)

    @rule()
    def run_while_another_runs(self):
        other = PartsFolder(self.path)
        other.open()
        try:
            may, _ = self.allowed()
            if may and status(self.scene, self.path).state == "complete":
                return
            with pytest.raises(InputError):
                self.start()
        finally:
            other.close()

    def content(self):
        """All files but locks."""
        return {
            p.relative_to(self.folder): p.read_bytes()
            for p in self.path.parent.rglob("*")
            if p.is_file() and p.name != "lock"
        }


class StoreMachine(ResumeMachine):
    """The same with a Zarr store of several shards."""

    store, name = "zarr", "r.zarr"

    def opened(self):
        assert zarr_store.damage(self.path) == ""
        return xr.open_zarr(self.path, consolidated=False).load()


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    toy.names(monkeypatch.setattr)
    toy.small_blocks(monkeypatch.setattr)


HOW = {"deadline": None, "suppress_health_check": list(HealthCheck), "database": None, "phases": (Phase.generate,)}


@pytest.mark.parametrize("machine", full_after(1, [ResumeMachine, StoreMachine]))
def test_no_order_of_events_gives_a_wrong_value(machine):
    pytest.importorskip("zarr")
    short = settings(max_examples=3, stateful_step_count=10, derandomize=True, **HOW)
    run_state_machine_as_test(machine, settings=short)


@pytest.mark.full
@pytest.mark.parametrize("machine", [ResumeMachine, StoreMachine])
def test_no_long_order_of_events_gives_a_wrong_value(machine):
    pytest.importorskip("zarr")
    run_state_machine_as_test(machine, settings=settings(max_examples=20, stateful_step_count=20, **HOW))
