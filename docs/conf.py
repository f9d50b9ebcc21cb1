"""Settings of the documentation site: `./run docs` builds it with Sphinx, in the theme of Mitsuba's own.

The sources are all of the project, so that links between README.md, scenes/ and docs/ are the same on the site as
anywhere else; `include_patterns` says which of its files are pages.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "site")]

project = "Manylights"
copyright = "The Manylights authors"
html_title = "Manylights"
root_doc = "docs/index"
include_patterns = [
    "README.md", "CHANGELOG.md", "scenes/README.md", "notebooks/README.md", "docs/*.md", "docs/plugins/*.rst",
    "docs/code/*.rst",
]  # fmt: skip
exclude_patterns = [".*", "build", "dist", "output", "shared"]

extensions = ["myst_parser", "sphinx_tabs.tabs", "plugin_parameters", "generated", "contents", "formulas"]
myst_heading_anchors = 4  # headings are linked by the anchors that GitHub gives them

html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["gallery.js"]
html_copy_source = False
html_show_sourcelink = False

# What the manual pages of plugins use, as Mitsuba's own define it
rst_prolog = """
.. role:: paramtype
.. role:: monosp

.. |int| replace:: :paramtype:`integer`
.. |float| replace:: :paramtype:`float`
.. |bool| replace:: :paramtype:`boolean`
.. |string| replace:: :paramtype:`string`
"""
