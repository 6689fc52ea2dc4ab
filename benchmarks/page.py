"""Generate docs/benchmarks.md from the result files: conclusions, tables and figures, sources.

python -m benchmarks.page      # writes docs/benchmarks.md and the measured parts of README.md and
                               # docs/theory/atlas.md from benchmarks/results/
"""

from __future__ import annotations

import argparse

from benchmarks import page_atlas
from benchmarks.page_text import write_page
from benchmarks.readme import write_readme


def main() -> None:
    """Write the page, and the measured parts of the README and of docs/theory/atlas.md, from the stored results."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    write_page()
    write_readme()
    page_atlas.write_page()


if __name__ == "__main__":
    main()
