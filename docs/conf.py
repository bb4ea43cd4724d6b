"""Build these pages by `make docs`: Markdown by MyST, two tables made from the code, and every reference checked."""

from __future__ import annotations

from importlib import metadata

from spectralzoom.flows import survey
from spectralzoom.flows.settings.documents import settings_table
from spectralzoom.flows.stage import Stage

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

head = "| stage | on terminals | stored as, version |\n|---|---|---|\n"
stages = [one for one in vars(survey).values() if isinstance(one, Stage)]
rows = [f"| `{one.name}` | {one.title} | `stages/{one.product}`, {one.version} |\n" for one in stages]
myst_substitutions = {"settings": settings_table(), "stages": head + "".join(rows)}
