"""The README's Python block is run as it stands, its output is the block that follows; its figures are the files'."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.measure import RESULTS
from benchmarks.page import between_marks, not_measured, readme_part

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parents[1]


def test_python_blocks_print_what_the_readme_shows(tmp_path):
    """One after the other in one process, as a reader would run them."""
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```\n\nprints\n\n```text\n(.*?)```", text, re.S)
    assert len(blocks) == 2
    code = "".join(code for code, _ in blocks).replace('"chart.png"', repr(str(tmp_path / "chart.png")))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # Last digits depend on the instruction set.
    number = re.compile(r"-?\d+\.\d{9,}")
    shown = "".join(shown for _, shown in blocks)
    ours, printed = ([float(x) for x in number.findall(t)] for t in (done.stdout, shown))
    assert ours == pytest.approx(printed, rel=1e-8)
    assert number.sub("", done.stdout) == number.sub("", shown) and (tmp_path / "chart.png").stat().st_size > 20_000


def test_the_measured_part_is_what_the_stored_files_give(tmp_path):
    text = (ROOT / "README.md").read_text()
    assert between_marks(text, readme_part(RESULTS)) == text, "run `python -m benchmarks.page`"
    assert readme_part(tmp_path) == not_measured("precision_chart")


def test_no_figure_of_a_measurement_is_typed():
    """Outside the measured part: no rate, no time, no ratio."""
    text = re.sub(r"<!-- Written by.*?<!-- End", "", (ROOT / "README.md").read_text(), flags=re.S)
    text = re.sub(r"```(python|text).*?```", "", text, flags=re.S)
    assert not re.findall(r"[\d,.]+ (?:s|ms|us|MB|GB|minutes|seconds|times)\b|[\d,.]+\s?%|[\d,.]+/s", text)
