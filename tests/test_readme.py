"""The README's Python block is run as it stands, its output is the block that follows; its figures are the files'."""

import re
import subprocess
import sys
from pathlib import Path

from benchmarks.readme import written

ROOT = Path(__file__).parents[1]


def test_python_block_prints_what_the_readme_shows():
    text = (ROOT / "README.md").read_text()
    code, shown = re.search(r"```python\n(.*?)```\n\nprints\n\n```text\n(.*?)```", text, re.S).groups()
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # The bound depends on the instruction set in its last digits: compare it as a magnitude.
    bound = re.compile(r"spectral_radius_error = (\S+)")
    ours, printed = (float(bound.search(t).group(1)) for t in (done.stdout, shown))
    assert 0.5 < ours / printed < 2
    assert bound.sub("", done.stdout) == bound.sub("", shown)


def test_the_measured_part_is_what_the_stored_files_give(tmp_path):
    text = (ROOT / "README.md").read_text()
    assert written(text) == text, "run `python -m benchmarks.page`"
    assert "Not measured: `throughput.csv` is missing." in written(text, tmp_path)


def test_no_figure_of_a_measurement_is_typed():
    """Outside the measured part: no rate, no time, no ratio."""
    text = re.sub(r"<!-- Written by.*?<!-- End", "", (ROOT / "README.md").read_text(), flags=re.S)
    text = re.sub(r"```(python|text).*?```", "", text, flags=re.S)
    assert not re.findall(r"[\d,.]+ (?:s|ms|us|MB|GB|minutes|seconds|times)\b|[\d,.]+\s?%|[\d,.]+/s", text)
