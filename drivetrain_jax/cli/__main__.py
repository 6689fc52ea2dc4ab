"""``python -m drivetrain_jax.cli``."""

from __future__ import annotations

import sys

from drivetrain_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
