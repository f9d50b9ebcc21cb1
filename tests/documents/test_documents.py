"""README and docs/: links lead somewhere, README stays a page, and the architecture names every module."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT

FRONT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "scenes/README.md")]
PAGES = [*FRONT, *sorted((ROOT / "docs").glob("*.md"))]
RESULTS = sorted((ROOT / "docs" / "results").glob("*.json"))
PLUGINS = {file for file in (ROOT / "integrators").glob("*.py") if "\nmi.register_integrator(" in file.read_text()}


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page by GitHub's rules."""
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
    assert len(re.sub(r"<!--.*?-->", "", (ROOT / "README.md").read_text()).split()) < 1500


def test_the_citation_in_readme_agrees_with_the_citation_file_and_the_package():
    readme, citation = (ROOT / "README.md").read_text(), (ROOT / "CITATION.cff").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (entry,) = re.findall(r"```bibtex\n(.*?)```", readme, re.DOTALL)
    fields = dict(re.findall(r"^  (\w+) = \{+(.*?)\}+,?$", entry, re.MULTILINE))
    listed = dict(re.findall(r'^([\w-]+): "?(.+?)"?$', citation, re.MULTILINE))
    assert entry.startswith("@software{manylights,")
    assert set(fields) == {"title", "author", "version", "year", "license"}
    assert fields["year"] in (ROOT / "LICENSE").read_text()
    assert (fields["title"], fields["version"], fields["license"]) == (
        listed["title"], listed["version"], listed["license"],
    )  # fmt: skip
    assert (fields["version"], fields["license"]) == (project["version"], project["license"])
    authors = re.findall(r"^  - name: (The .+)$", citation, re.MULTILINE)
    assert authors == [fields["author"]] == [author["name"] for author in project["authors"]]


def check_tables(root):
    """Run the check of tables and figures in a copy of the documents."""
    command = [sys.executable, str(root / "docs" / "tables.py"), "--check"]
    return subprocess.run(command, capture_output=True, text=True)


def test_tables_and_figures_are_those_of_the_result_files():
    done = check_tables(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def copied(folder):
    """A copy of the documents, result files and the program that fills tables."""
    (folder / "docs" / "results").mkdir(parents=True)
    for file in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*tables.py")]:
        (folder / file.relative_to(ROOT)).write_bytes(file.read_bytes())
    for file in RESULTS:
        (folder / file.relative_to(ROOT)).write_bytes(file.read_bytes())
    return folder


def test_a_changed_number_of_a_result_file_is_found_and_written(tmp_path):
    root = copied(tmp_path)
    file = root / "docs" / "results" / "manylights_timed10.json"
    found = json.loads(file.read_text())
    found["rows"]["hall"]["speedup"] = 0.25
    file.write_text(json.dumps(found))
    differing = {line.partition(" ")[0] for line in check_tables(root).stdout.splitlines()}
    assert differing >= {"README.md", "docs/results.md"} and "docs/start.md" not in differing
    subprocess.run([sys.executable, str(root / "docs" / "tables.py")], check=True, capture_output=True)
    assert check_tables(root).returncode == 0
    assert "| **0.25** |" in (root / "docs" / "results.md").read_text()


def test_a_figure_of_an_unknown_row_is_an_error(tmp_path):
    root = copied(tmp_path)
    (root / "README.md").write_text("<!-- value manylights_product nowhere speedup -->1<!-- end -->")
    assert "nowhere" in check_tables(root).stderr


@pytest.mark.parametrize("file", RESULTS, ids=lambda file: file.stem)
def test_result_files_tell_where_their_numbers_come_from(file):
    found = json.loads(file.read_text())
    assert re.fullmatch(r"\./run -- python benchmarks/\w+\.py( .*)?", found["command"])
    assert re.fullmatch(r"[0-9a-f]{7,}", found["commit"]), "measured by sources that no commit has"
    assert found["machine"]["cores"] > 0 and found["rows"]
    assert set(found["units"]) == quantities(found["rows"])


def quantities(rows):
    """Names of the numbers of nested rows."""
    names = set()
    for name, value in rows.items():
        names |= quantities(value) if isinstance(value, dict) else {name}
    return names


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent == ROOT / "docs"], ids=lambda page: page.stem)
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
    modules = {file.name for file in (ROOT / package).rglob("*.py") if file not in PLUGINS} - {"__init__.py"}
    assert set(re.findall(r"\w+\.py", " ".join(cells))) == modules
