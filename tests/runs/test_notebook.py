"""The progress of a run where a notebook would show it."""

from __future__ import annotations

import io
import re
import sys
import time
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import drivetrain_jax as dt
from drivetrain_jax import _programs
from drivetrain_jax._machine import CompilingLine
from drivetrain_jax.runs import run


@pytest.fixture
def shown(monkeypatch):
    """A list of the states that a notebook cell shows, recorded by a substitute for IPython."""
    states = []
    ipython, display = ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = lambda: SimpleNamespace(kernel=object())
    display.HTML = str
    display.display = lambda content, display_id: states.append(content) or SimpleNamespace(update=states.append)
    for name, module in (("IPython", ipython), ("IPython.display", display)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(run, "_PATIENCE", 0.0)
    monkeypatch.setattr(run, "_STEP", 0.0)
    return states


def test_a_notebook_shows_a_bar(shown, grid_scene, tmp_path):
    found = dt.run(grid_scene)
    failed = int((found["outcome"] > 1).sum())
    last = re.fullmatch(r'<progress value="1.0000" max="1"></progress> (.*)', shown[-1])[1]
    assert last.startswith("123/123 points, ") and last.endswith(f" s, {failed} failed") and failed
    assert "123/123 points" not in shown[0]
    before = len(shown)
    dt.run(grid_scene, out=tmp_path / "r.nc")
    assert len(shown) > before


def test_a_report_of_the_caller_replaces_the_bar(shown, grid_scene):
    reports = []
    dt.run(grid_scene, report=reports.append)
    assert reports and not shown


def test_a_terminal_shows_none(shown, grid_scene, monkeypatch):
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: SimpleNamespace())
    dt.run(grid_scene)
    assert not shown


def test_a_short_run_shows_none(shown, grid_scene, monkeypatch):
    monkeypatch.setattr(run, "_PATIENCE", 100.0)
    dt.run(grid_scene)
    assert not shown


def compile_slowly(line, seconds=0.2):
    with line, line:
        time.sleep(seconds)


def test_a_notebook_says_that_it_compiles(shown):
    compile_slowly(CompilingLine(0.02))
    assert shown == ["compiling, 0 s", ""]


@pytest.mark.parametrize(("terminal", "text"), [(True, "\rcompiling, 0 s\x1b[K\r\x1b[K"), (False, "")])
def test_a_terminal_says_that_it_compiles_and_a_pipe_does_not(terminal, text, monkeypatch):
    written = io.StringIO()
    written.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", written)
    monkeypatch.setenv("TERM", "xterm")
    line = CompilingLine(0.02)
    compile_slowly(line, 0.0)
    compile_slowly(line)
    assert written.getvalue() == text


def test_programs_are_compiled_under_this_line(monkeypatch):
    entered = []
    monkeypatch.setattr(_programs, "compiling", contextmanager(lambda: (yield entered.append(1)))())
    _programs.compiled(lambda x: x, (np.float64(0.0),), {}, "")
    assert entered == [1]
