"""Signals to the command line: never a traceback, and finished chunks are written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from drivetrain_jax.cli import _stop_on_signals

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Interrupted:
    """Its destructor swallows the exception of a signal that comes meanwhile."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass


class Broken:
    def __del__(self):
        raise ZeroDivisionError


def test_a_swallowed_interrupt_is_raised_again_and_not_reported(monkeypatch):
    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)
    with _stop_on_signals() as check:
        check()
        Interrupted()
        with pytest.raises(KeyboardInterrupt):
            check()
        assert not reported
        Broken()
    assert [type(swallowed.exc_value) for swallowed in reported] == [ZeroDivisionError]
    assert sys.unraisablehook.__self__ is reported


@pytest.mark.parametrize("stopped", [True, False])
def test_the_handlers_of_before_are_back(stopped):
    before = [signal.getsignal(number) for number in NUMBERS]
    with suppress(KeyboardInterrupt), _stop_on_signals():
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
