"""Manual pages of the plugins: whole, valid, and the same whatever a Python does with docstrings."""

import inspect
import io
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import mitsuba as mi
import pytest
from docutils import core, nodes
from docutils.parsers.rst import Directive, directives, roles

import integrators
from integrators.knobs import Integer, knobs_of
from integrators.manual import manual_page

FOLDER = Path(integrators.__file__).parent
# Knobs that several plugins have in common
SHARED = ("ManyLightIntegrator", "GatheringIntegrator")
MOST_OF_ITS_OWN = 8

plugins = pytest.mark.parametrize("name", integrators.PLUGINS)


def python_of(version):
    """A Python of that version, of the system or of pyenv; None if there is none that works."""
    found = [shutil.which(f"python{version}"), *Path.home().glob(f".pyenv/versions/{version}.*/bin/python")]
    works = (one for one in found if one and subprocess.run([one, "-V"], capture_output=True).returncode == 0)
    return next(works, None)


def plugin_class(name):
    return type(mi.load_dict({"type": name}))


class Nested(Directive):
    """Directive of Mitsuba's manual whose content is more of the page."""

    has_content = True

    def run(self):
        parent = nodes.container()
        self.state.nested_parse(self.content, self.content_offset, parent)
        return [parent]


class Code(Directive):
    """Directive whose content is code."""

    has_content = True
    required_arguments = 1

    def run(self):
        return [nodes.literal_block(text="\n".join(self.content))]


def parsed(page):
    """Return (parsed document, errors)."""
    directives.register_directive("pluginparameters", Nested)
    directives.register_directive("tabs", Nested)
    directives.register_directive("code-tab", Code)
    for role in ("monosp", "ref", "mod", "func", "class"):
        roles.register_generic_role(role, nodes.literal)
    types = "\n".join(f".. |{name}| replace:: {name}" for name in ("int", "float", "bool", "string"))
    complaints = io.StringIO()
    settings = {"report_level": 2, "halt_level": 5, "warning_stream": complaints}
    document = core.publish_doctree(types + "\n\n" + page, settings_overrides=settings)
    return document, complaints.getvalue().splitlines()


@plugins
def test_every_page_is_valid_and_lists_every_knob(name):
    plugin = plugin_class(name)
    document, complaints = parsed(plugin.__doc__)
    assert complaints == []
    entries = document.next_node(nodes.bullet_list)
    listed = [[part.astext() for part in entry[0]] for entry in entries]
    knobs = knobs_of(plugin)
    assert [entry[:2] for entry in listed] == [[knob.name, knob.type] for knob in knobs]
    assert all(re.search(r"\(Default:\s.+\)$", entry[2], re.DOTALL) for entry in listed)
    assert len(list(document.findall(nodes.literal_block))) == 2, "how to use it in XML and in Python"


def said(knob):
    """The entry of a knob in one line."""
    return " ".join(knob.entry().split())


@plugins
def test_pages_state_the_defaults(name):
    plugin = mi.load_dict({"type": name})
    for knob in knobs_of(type(plugin)):
        default = knob.default(plugin) if callable(knob.default) else knob.default
        assert getattr(plugin, knob.name) == knob.parse(default)
        shown = {False: "no", True: "yes"}.get(default) if isinstance(default, bool) else str(default) or "none"
        assert f"(Default: {shown}" in said(knob) or f"(Default: ``{shown}``" in said(knob)


@plugins
def test_pages_are_indented_alike_and_filled(name):
    page = plugin_class(name).__doc__
    assert inspect.cleandoc(page) == page.strip()
    assert not re.search(r"^ *\{[a-z ]+\}$", page, re.MULTILINE)
    assert max(map(len, page.splitlines())) <= 120


@plugins
def test_no_plugin_has_many_knobs_of_its_own(name):
    plugin = plugin_class(name)
    shared = {knob for base in plugin.__mro__ if base.__name__ in SHARED for knob in vars(base)["knobs"]}
    own = {knob.name for knob in knobs_of(plugin)} - {knob.name for knob in shared} - {"aovs"}
    assert len(own) <= MOST_OF_ITS_OWN, own


def test_a_page_does_not_depend_on_the_indentation_of_its_docstring():
    page = """
    Title

    .. pluginparameters::

     {knobs}

    {what is estimated}

    .. code-tab:: python

        {"type": "vpl"}
    """
    knobs = (Integer("count", 3, "How many.", minimum=1),)
    shapes = (page, inspect.cleandoc(page), textwrap.dedent(page), textwrap.indent(page, "    "))
    found = {manual_page(type("Plugin", (), {"__doc__": shape, "knobs": knobs})).__doc__ for shape in shapes}
    (found,) = found
    assert "\n.. pluginparameters::\n\n * - count\n   - |int|\n   - How many. (Default: 3; at least 1)\n" in found
    assert "\n\nWhat is estimated: " in found and '\n\n    {"type": "vpl"}\n' in found


def test_texts_that_nobody_wrote_are_refused_and_no_docstring_is_none():
    with pytest.raises(ValueError, match='no text is called "who wrote it": there are what is estimated'):
        manual_page(type("Plugin", (), {"__doc__": "Title\n\n{who wrote it}\n"}))
    assert manual_page(type("Plugin", (), {"__doc__": None})).__doc__ is None


# Docstring operations at import of the plugins, on compiled docstrings, for Pythons without Mitsuba
_FILL = """
import ast, sys, types
from pathlib import Path
folder = Path(sys.argv[1])
package = sys.modules["integrators"] = types.ModuleType("integrators")
package.__path__ = [str(folder)]
from integrators.manual import manual_page
for name in sys.argv[2:]:
    (plugin,) = [node for node in ast.parse((folder / f"{name}.py").read_text()).body if isinstance(node, ast.ClassDef)
                 and "manual_page" in map(ast.unparse, node.decorator_list)]
    plugin.bases, plugin.decorator_list, plugin.body = [], [], plugin.body[:1]
    exec(compile(ast.Module([plugin], []), name, "exec"), found := {})
    print(manual_page(found[plugin.name]).__doc__)
"""


@pytest.mark.parametrize("version", ["3.12", "3.13", "3.14"])
def test_other_pythons_fill_the_same_pages(version):
    python = python_of(version)
    if python is None:
        pytest.skip(f"there is no Python {version}")
    command = ["-c", _FILL, str(FOLDER), *integrators.PLUGINS]
    theirs, ours = (
        subprocess.run([one, *command], capture_output=True, text=True, check=True).stdout
        for one in (python, sys.executable)
    )
    assert theirs == ours
    assert ours.count(".. pluginparameters::") == len(integrators.PLUGINS)
