"""The explorer: an atlas as one HTML page that evaluates it in the browser.

``explore(atlas)`` returns the page. The modules in JavaScript use the algorithms of ``atlas/`` and ``analysis/floquet/``;
pages hold them one after the other.
"""

from __future__ import annotations

from drivetrain_jax.explore.page import Page, explore

__all__ = ["Page", "explore"]
