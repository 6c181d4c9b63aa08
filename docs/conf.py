"""How Sphinx builds the site; ``make docs`` stages the pages for it."""

import re

from sphinx.application import Sphinx

import sb3_torcs

project = "sb3-torcs"
release = version = sb3_torcs.__version__
copyright = "the authors of sb3-torcs, GPL-2.0-or-later"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
myst_heading_anchors = 4  # links to headings, as on GitHub
autodoc_typehints = "none"  # signatures stay short; docstrings give units and ranges
autodoc_preserve_defaults = True
exclude_patterns = ["files"]

html_theme = "furo"
html_title = f"sb3-torcs {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_sphinx = False
copybutton_prompt_text = r">>> |\$ "
copybutton_prompt_is_regexp = True


def escape_dashes(*event: list[str]) -> None:
    """Let a dash alone in the last column of a table be a dash, not an empty list."""
    lines = event[-1]
    lines[:] = [re.sub(r"(?<=  )-$", r"\\-", line) for line in lines]


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    app.connect("autodoc-process-docstring", escape_dashes)
