"""The packages of vpl/: imports run one way, so each package can be read alone; and the maps of packages."""

import ast
from pathlib import Path

import pytest

from tests.support.paths import ROOT

# What a package may import from, besides itself
BELOW = {
    "core": (),
    "lights": ("core",),
    "points": ("core", "lights"),
    "transport": ("core", "lights", "points"),
    "direct": ("core", "lights", "points"),
    "cuts": ("core", "lights", "points", "transport"),
    "matrix": ("core", "lights", "points", "transport", "cuts"),
    "split": ("core", "lights", "points", "transport", "direct", "cuts"),
}


def imported(file: Path):
    """(package, line) of every import of another module of vpl/."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            if node.level != 1:
                yield (node.module or "").partition(".")[0], node.lineno
        elif isinstance(node, ast.Import):
            yield from ((alias.name.partition(".")[0], node.lineno) for alias in node.names)


def test_every_package_has_its_place():
    """A new package must declare its imports."""
    packages = {folder.parent.name for folder in (ROOT / "vpl").glob("*/__init__.py")}
    assert packages == set(BELOW)


@pytest.mark.parametrize("package", BELOW)
def test_imports_run_one_way(package):
    """Nothing imports from a package above its own, from the plugins or from the tools."""
    others = ({*BELOW, "vpl", "integrators", "comparison", "compare", "manylights"} - {package}) - {*BELOW[package]}
    wrong = [
        f"{file.relative_to(ROOT)}:{line} imports {name}"
        for file in sorted((ROOT / "vpl" / package).glob("*.py"))
        for name, line in imported(file)
        if name in others
    ]
    assert not wrong


@pytest.mark.parametrize("package", BELOW)
def test_a_map_names_every_module(package):
    """The folders of the sources match the maps in the documents."""
    folder = ROOT / "vpl" / package
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
    modules = {file.stem for file in folder.glob("*.py")} - {"__init__"}
    assert not [name for name in sorted(modules) if f"``{name}``" not in text]


def test_the_map_of_all_names_every_package():
    """And says what is in it."""
    text = ast.get_docstring(ast.parse((ROOT / "vpl" / "__init__.py").read_text()))
    assert not [package for package in BELOW if f"``{package}``" not in text]
