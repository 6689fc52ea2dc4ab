"""Generate docs/validation/<system>.md: published and computed values, and the reasons of their differences.

    python -m benchmarks.validation [SYSTEM ...] [--full]      # --full: comparisons over whole charts, not samples

Numbers of the package are compared with independent ones by NumPy and SciPy where that is feasible.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module

SYSTEMS = ("cardan", "driveline", "tripod", "bicardan", "planetary", "rattle")


def main(arguments: Sequence[str] | None = None) -> None:
    """Compute and write the pages of the given systems, by default of all systems."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("systems", nargs="*", metavar="SYSTEM", help=f"one or more of {', '.join(SYSTEMS)}")
    parser.add_argument("--full", action="store_true", help="compare whole charts instead of samples")
    given = parser.parse_args(arguments)
    if unknown := set(given.systems) - set(SYSTEMS):
        parser.error(f"SYSTEM = {', '.join(sorted(unknown))}: allowed is {', '.join(SYSTEMS)}")
    for system in given.systems or SYSTEMS:
        page = import_module(f"benchmarks.validation.{system}").page(given.full)
        print(page.write(system, given.full))


if __name__ == "__main__":
    main()
