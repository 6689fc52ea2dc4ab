"""The examples of pages that are shown as a session in Python, run as they stand there."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

import matplotlib
import pytest

DOCS = Path(__file__).parents[2] / "docs"


SYSTEMS = [f"systems/{name}.md" for name in ("bicardan", "cardan", "planetary", "rattle", "tripod")]
LONG = [("jax.md", 15), ("notebooks.md", 25), ("extending.md", 20), *((page, 2) for page in SYSTEMS)]


@pytest.mark.parametrize(
    ("page", "fewest"),
    [
        ("scaling.md", 2),
        *(pytest.param(*case, marks=pytest.mark.full) for case in LONG),
    ],
)
def test_the_examples_of_the_page_run(page, fewest, tmp_path, monkeypatch):
    if page == "scaling.md":
        pytest.importorskip("dask_jobqueue")
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    blocks = re.findall(r"^```{doctest}\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S)
    test = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, page, str(DOCS / page), 0)
    assert len(test.examples) > fewest
    report: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(test, out=report.append).failed == 0, "".join(report)
