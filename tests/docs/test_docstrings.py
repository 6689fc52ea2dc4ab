"""The examples in the docstrings of the public names give what they show."""

from __future__ import annotations

import doctest
import inspect
import sys

import pytest

import drivetrain_jax as dt
from tests.sizes import but_full

EXCEPTIONS = {"ChunkError", "Incomplete", "InputError", "Interrupted"}
NAMES = [name for name in dt.__all__ if name != "__version__" and name not in EXCEPTIONS]
SLOW = "Planetary", "basins", "forced", "harmonic_response", "lyapunov", "poincare", "steady_state"


@pytest.mark.parametrize("name", but_full(NAMES, *SLOW))
def test_examples_give_what_they_show(name):
    item = getattr(dt, name)
    scope = dict(vars(sys.modules[item.__module__]))
    example = doctest.DocTestParser().get_doctest(inspect.cleandoc(item.__doc__), scope, name, None, 0)
    assert example.examples
    report: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(example, out=report.append).failed == 0, "".join(report)
