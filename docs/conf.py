"""The documentation site: `make docs` builds it, checks its links and runs its examples."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import drivetrain_jax

project = "drivetrain_jax"
author = "the authors of drivetrain_jax"
version = release = drivetrain_jax.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.doctest", "sphinx.ext.napoleon", "generated"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 3
# Notebooks run once and are kept beside the pages; an error in one stops the build.
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parent.parent / "out" / "docs" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_output_stderr = "remove"
myst_dmath_double_inline = True
# Every reference must lead somewhere; names of types in signatures need not.
nitpicky = False
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
default_role = "code"

doctest_global_setup = """
import os, tempfile
from pathlib import Path
import drivetrain_jax as dt
import numpy as np
import xarray as xr
os.chdir(tempfile.mkdtemp())
"""

html_theme = "pydata_sphinx_theme"
html_title = "drivetrain_jax"
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "show_prev_next": True,
    "header_links_before_dropdown": 8,
    "footer_start": [],
    "footer_end": [],
}
html_show_sourcelink = False
html_copy_source = False
