"""Signals to the command line: never a traceback, and finished chunks are written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import jax
import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax._machine import stop_on_signals

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Interrupted:
    """Its destructor swallows the exception of a signal that comes meanwhile."""

    def __init__(self, number=signal.SIGTERM):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)
        for _ in range(1000):
            pass


@pytest.fixture(autouse=True)
def interrupts():
    """The handler of an interactive shell; a program that a script starts in the background ignores interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Broken:
    def __del__(self):
        raise ZeroDivisionError


def test_a_swallowed_interrupt_is_raised_again_and_not_reported(monkeypatch):
    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)
    with stop_on_signals(*NUMBERS) as check:
        check()
        Interrupted()
        with pytest.raises(KeyboardInterrupt):
            check()
        assert not reported
        Broken()
    assert [type(swallowed.exc_value) for swallowed in reported] == [ZeroDivisionError]
    assert sys.unraisablehook.__self__ is reported


@pytest.mark.full
def test_an_interrupt_in_a_callback_of_jax_stops_python(tmp_path):
    sent = []

    def twice(values):
        def host(x):
            if not sent:
                sent.append(x)
                os.kill(os.getpid(), signal.SIGINT)
            return np.asarray(2 * x)

        return jax.pure_callback(host, jax.ShapeDtypeStruct((), float), values["x"], vmap_method="sequential")

    with pytest.raises(dt.Interrupted, match="interrupted; the same call resumes"):
        dt.sweep(twice, {"x": 0.0}, over={"x": [1.0, 2.0]}, out=tmp_path / "twice.nc")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_that_a_destructor_swallows_stops_python_too(tmp_path):
    def report(_):
        Interrupted(signal.SIGINT)

    scene = {"system": "tripod", "analysis": "parameters", "fixed": {"element": "input", "beta": 0.1}}
    with pytest.raises(dt.Interrupted, match="interrupted; the same call resumes"):
        dt.run(scene, tmp_path / "tripod.nc", report=report)


@pytest.mark.parametrize("stopped", [True, False])
def test_the_handlers_of_before_are_back(stopped):
    before = [signal.getsignal(number) for number in NUMBERS]
    with suppress(KeyboardInterrupt), stop_on_signals(*NUMBERS):
        assert not {signal.getsignal(number) for number in NUMBERS} & set(before)
        if stopped:
            os.kill(os.getpid(), signal.SIGTERM)
    assert [signal.getsignal(number) for number in NUMBERS] == before


@pytest.mark.full
def test_a_point_of_many_minutes_is_interrupted():
    command = [sys.executable, "-m", "drivetrain_jax.cli", "point", "tripod", "lyapunov", "element=input", "beta=.3"]
    command += ["zeta=.0016", "max_time=3000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        time.sleep(10)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        # A shell reports 130.
        assert process.returncode == -signal.SIGINT and b"Traceback" not in said
