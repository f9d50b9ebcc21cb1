"""README and docs/: links lead somewhere, README stays a page, and the architecture names every module."""

import re
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PAGES = [ROOT / "README.md", ROOT / "scenes" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PLUGINS = {file for file in (ROOT / "integrators").glob("*.py") if "\nmi.register_integrator(" in file.read_text()}


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, in GitHub's form."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page: Path):
    """(file, anchor) of every link of a page to another file of the project or to a heading."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            yield (page.parent / path).resolve() if path else page, anchor


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for file, anchor in links(page):
        assert file.exists(), f"{page.name} links to {file}"
        assert not anchor or anchor in anchors(file), f"{page.name} links to #{anchor} of {file.name}"


def test_readme_is_one_page():
    assert len((ROOT / "README.md").read_text().split()) < 1500


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name == "docs"], ids=lambda page: page.stem)
def test_readme_and_docs_link_to_each_other(page):
    readme = ROOT / "README.md"
    assert page in dict(links(readme))
    assert readme in dict(links(page))


def test_readme_lists_every_plugin():
    """Which plugin to take, with a link to the manual page of each."""
    assert PLUGINS
    assert set(dict(links(ROOT / "README.md"))) >= PLUGINS


@pytest.mark.parametrize(
    "package", ["integrators", *(f"vpl/{path.parent.name}" for path in (ROOT / "vpl").glob("*/__init__.py"))]
)
def test_the_architecture_names_every_module_and_no_other(package):
    _, _, rest = (ROOT / "docs" / "architecture.md").read_text().partition(f"# `{package}/`\n")
    cells = re.findall(r"^\| (`.*?) \|", rest.partition("\n#")[0], re.MULTILINE)
    modules = {file.name for file in (ROOT / package).glob("*.py") if file not in PLUGINS} - {"__init__.py"}
    assert set(re.findall(r"\w+\.py", " ".join(cells))) == modules
