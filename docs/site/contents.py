"""Contents of the site, from the lists of links of docs/index.md, and what pages need only outside of the site.

Each part of the front page with links to pages of docs/ becomes a part of the sidebar; pages that it does not name are
added to the last. Plugins are below the page docs/choosing.md.
"""

import re
from pathlib import Path

from docutils import nodes
from sphinx.transforms import SphinxTransform

from integrators import PLUGINS

DOCS = Path(__file__).resolve().parents[1]
PARENT_OF_PLUGINS = "docs/choosing"
REDIRECTION = '<!doctype html><meta http-equiv="refresh" content="0; url={0}"><a href="{0}">{1}</a>\n'


def add_contents(_app, page, source):
    """Append contents to the front page and to the parent page of plugins."""
    if page == "docs/index":
        source[0] += "".join(_toctree(entries, title) for title, entries in parts(source[0]).items())
    elif page == PARENT_OF_PLUGINS:
        source[0] += _toctree(f"plugins/{name}" for name in PLUGINS)


def parts(text):
    """Entries of the toctree of each part of the front page, {title: entries}. Unnamed pages are in the last part."""
    found, rest = {}, {file.stem for file in DOCS.glob("*.md")} - {"index"}
    for part in text.split("\n## ")[1:]:
        title, _, body = part.partition("\n")
        links = re.findall(r"^- \[([^]]+)\]\(([\w./]+)\.md\)", body, re.MULTILINE)
        found[title] = [f"{name} <{page}>" for name, page in links]
        rest -= {page for _, page in links}
    found[title] += sorted(rest)
    return found


def _toctree(entries, caption=None):
    options = [":hidden:"] + ([f":caption: {caption}"] if caption else [])
    return "\n".join(["\n\n```{toctree}", *options, "", *entries, "```\n"])


class Navigation(SphinxTransform):
    """Removal of the line of links above a page's title, which is for viewers of single files: there is a sidebar."""

    default_priority = 400

    def apply(self):
        first = self.document.children[0] if self.document.children else None
        if isinstance(first, nodes.paragraph) and first.astext().startswith("README · "):
            self.document.remove(first)


def redirect(app, error):
    """Let the folder that the site is built into lead to the front page."""
    if error is None:
        target = f"{app.config.root_doc}.html"
        (Path(app.outdir) / "index.html").write_text(REDIRECTION.format(target, app.config.project))


def setup(app):
    app.connect("source-read", add_contents)
    app.connect("build-finished", redirect)
    app.add_transform(Navigation)
    return {"parallel_read_safe": True}
