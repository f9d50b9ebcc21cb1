"""Pages generated before Sphinx reads its sources: manual pages from docstrings of plugins, listings of linked code.

Links to files of code lead to these pages.
"""

import re
from pathlib import Path

import mitsuba as mi
from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

ROOT = Path(__file__).resolve().parents[2]
PLUGIN_PAGES, CODE_PAGES = ROOT / "docs" / "plugins", ROOT / "docs" / "code"
CODE_PAGE = """\
:orphan:

{name}
{line}

.. literalinclude:: /{name}
   :linenos:
"""


def code_page(file):
    """Path of the page with the listing of a file of code."""
    return CODE_PAGES / (".".join(file.relative_to(ROOT).with_suffix("").parts) + ".rst")


def write_pages(_app):
    """Write changed pages of plugins and of linked files of code, and remove obsolete pages."""
    mi.set_variant("llvm_ad_rgb")
    import integrators

    pages = {}
    for name in integrators.PLUGINS:
        page = type(mi.load_dict({"type": name})).__doc__.rstrip()
        code = f"/{code_page(ROOT / 'integrators' / f'{name}.py').relative_to(ROOT).with_suffix('').as_posix()}"
        pages[PLUGIN_PAGES / f"{name}.rst"] = f"{page}\n\nCode: :doc:`integrators/{name}.py <{code}>`.\n"
    for file in sorted(linked_code()):
        name = file.relative_to(ROOT).as_posix()
        pages[code_page(file)] = CODE_PAGE.format(name=name, line="=" * len(name))
    for folder in (PLUGIN_PAGES, CODE_PAGES):
        folder.mkdir(exist_ok=True)
        for file in set(folder.glob("*.rst")) - set(pages):
            file.unlink()
    for file, page in pages.items():
        if not file.exists() or file.read_text() != page:
            file.write_text(page)


def linked_code():
    """Files of Python that pages link to."""
    for page in (ROOT / "README.md", ROOT / "scenes" / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([\w./]+\.py)\)", page.read_text()):
            yield (page.parent / target).resolve()


class FileLinks(SphinxTransform):
    """Links to Python files: to the listing if the link names the file, otherwise to the manual page of the plugin."""

    default_priority = 500

    def apply(self):
        for link in list(self.document.findall(addnodes.download_reference)):
            file = ((ROOT / self.env.docname).parent / link["reftarget"]).resolve()
            page = PLUGIN_PAGES / f"{file.stem}.rst"
            if file.suffix != ".py":
                continue
            if file.parent != ROOT / "integrators" or not page.exists() or link.astext().endswith(".py"):
                page = code_page(file)
            to = addnodes.pending_xref(
                "", nodes.inline("", "", *link.children), refdomain="std", reftype="doc", refexplicit=True,
                reftarget=f"/{page.relative_to(ROOT).with_suffix('').as_posix()}", refwarn=True,
            )  # fmt: skip
            link.replace_self(to)


def setup(app):
    app.connect("builder-inited", write_pages)
    app.add_transform(FileLinks)
    return {"parallel_read_safe": True}
