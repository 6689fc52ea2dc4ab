"""Signals to the command line: never a traceback, and no answer once the command is over."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from drivetrain_jax.cli import main
from drivetrain_jax.cli.signals import stop_on_signals

NUMBERS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    before = {number: signal.getsignal(number) for number in NUMBERS}
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Interrupted:
    """Its destructor swallows the exception of a signal that comes meanwhile."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass


@pytest.mark.parametrize("disturbed", [True, False])
def test_a_swallowed_interrupt_is_raised_again_and_not_shown(monkeypatch, disturbed):
    shown = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)
    with stop_on_signals() as check:
        if disturbed:
            Interrupted()
            with pytest.raises(KeyboardInterrupt):
                check()
        else:
            check()
    assert shown == [] and (sys.unraisablehook == shown.append) is not disturbed


@pytest.mark.parametrize("stopped", [True, False])
def test_the_handlers_of_before_are_back(stopped):
    mine = [lambda *_: None, signal.SIG_IGN]
    for number, handler in zip(NUMBERS, mine, strict=True):
        signal.signal(number, handler)
    with suppress(KeyboardInterrupt), stop_on_signals():
        assert not {signal.getsignal(number) for number in NUMBERS} & set(mine)
        if stopped:
            os.kill(os.getpid(), signal.SIGTERM)
    assert [signal.getsignal(number) for number in NUMBERS] == mine


def test_other_errors_in_destructors_are_shown(monkeypatch):
    class Broken:
        def __del__(self):
            raise ValueError

    shown = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)
    with stop_on_signals():
        Broken()
    assert len(shown) == 1


def test_a_command_that_is_over_cannot_be_stopped(monkeypatch, capsys):
    """The process is on its way out and its exit code is that of what it did."""
    monkeypatch.setattr(sys, "argv", ["drivetrain", "list"])
    assert main() == 0
    assert [signal.getsignal(number) for number in NUMBERS] == [signal.SIG_IGN] * 2
    assert "Systems" in capsys.readouterr().out
    for number in NUMBERS:
        signal.signal(number, signal.SIG_DFL)
    assert main(["list"]) == 0
    assert [signal.getsignal(number) for number in NUMBERS] == [signal.SIG_DFL] * 2


def test_a_command_ends_soon_after_an_interrupt_of_a_compiler():
    """Python itself would see the interrupt only after the compilation; a long hash stands for it."""
    busy = "import hashlib, threading; from drivetrain_jax.cli.signals import leave_on_interrupt; leave_on_interrupt(130); "
    # The line is printed while the hash is computed.
    busy += "threading.Timer(0.5, lambda: print(1, flush=True)).start(); hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"
    with subprocess.Popen([sys.executable, "-c", busy], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"1\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130


@pytest.mark.full
def test_a_point_of_many_minutes_is_interrupted():
    command = [sys.executable, "-m", "drivetrain_jax.cli", "point", "tripod", "lyapunov", "element=input", "beta=.3"]
    command += ["zeta=.0016", "max_time=3000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        time.sleep(10)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        assert process.returncode == 130
        assert b"Traceback" not in said
