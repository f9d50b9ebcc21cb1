"""Settings of the documentation site: `./run docs` builds it with Sphinx, in the theme of Mitsuba's own.

The source folder is the root of the project, so that links between README.md, scenes/ and docs/ stay valid.
`include_patterns` lists the pages.
"""

import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "site")]

project = "Manylights"
copyright = "The Manylights authors"
release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
html_title = f"Manylights {release}"
root_doc = "docs/index"
include_patterns = [
    "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "scenes/README.md", "notebooks/README.md",
    "docs/*.md", "docs/plugins/*.rst", "docs/code/*.rst",
]  # fmt: skip
exclude_patterns = [".*", "build", "dist", "output", "shared"]

extensions = [
    "myst_parser",
    "sphinx_tabs.tabs",
    "sphinx_copybutton",
    "plugin_parameters",
    "generated",
    "contents",
    "formulas",
]
myst_heading_anchors = 4  # anchors of headings as on GitHub

html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["gallery.js"]
html_copy_source = False
html_show_sourcelink = False

# Roles and substitutions of Mitsuba's manual, which manual pages of plugins use
rst_prolog = """
.. role:: paramtype
.. role:: monosp

.. |int| replace:: :paramtype:`integer`
.. |float| replace:: :paramtype:`float`
.. |bool| replace:: :paramtype:`boolean`
.. |string| replace:: :paramtype:`string`
"""
