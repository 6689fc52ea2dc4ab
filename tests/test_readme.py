"""The README's Python block is run as it stands; its output is the block that follows."""

import re
import subprocess
import sys
from pathlib import Path

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
