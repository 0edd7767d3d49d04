"""Sphinx: `sphinx-build -W docs docs/_build` makes the site; pages are Markdown, the API pages come from docstrings."""

from oasis_warp import __version__

project = "oasis_warp"
project_copyright = "2026 the oasis_warp developers"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_static_path: list[str] = []
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": True, "exclude-members": "__init__, __new__"}
python_maximum_signature_line_length = 100
