"""Build these pages by `make docs`: Markdown by MyST, two tables made from the code, and every reference checked."""

from __future__ import annotations

from importlib import metadata

from spectralzoom.flows.settings.documents import settings_table
from spectralzoom.flows.tasks.open_survey import STAGES

project = "SpectralZoom"
version = release = metadata.version("spectralzoom")
copyright = "Apache-2.0"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "SpectralZoom"
html_copy_source = False

myst_enable_extensions = ["substitution"]
myst_heading_anchors = 3  # links such as own-data.md#labels, which are checked
suppress_warnings = ["config.cache"]

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_custom_sections = ["Raises", "Returns"]  # in words: napoleon wants each name on a line of its own
# Docstrings name more than the reference lists, and types of numpy and xarray, whose pages are not at hand.
nitpick_ignore_regex = [("py:.*", ".*")]

head = "| stage | on terminals | stored as, version |\n|---|---|---|\n"  # rows are in the order of a survey
rows = [f"| `{n}` | {s.title} | `stages/{s.product.name}`, {s.product.version} |\n" for n, s in STAGES.items()]
myst_substitutions = {"settings": settings_table(), "stages": head + "".join(rows)}
