"""Files that a scene names, found by reading its XML as Mitsuba's parser (pugixml) does.

Mitsuba reports the XML files that it has read only if they contain objects, and spectra without the files that they
come from. Python's XML parser refuses documents that pugixml accepts: an `&` that begins no entity, undeclared
entities, two hyphens in a comment.
"""

import os
import re
from pathlib import Path

from ..scene_files import FILE_PROPERTIES

_MARKUP = re.compile(
    r"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<!DOCTYPE[^\[>]*(?:\[.*?\])?[^>]*>
    |<(?P<tag>[\w:.-]+)(?P<attributes>(?:\s+[\w:.-]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*/?>""",
    re.DOTALL | re.VERBOSE,
)
_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_ENTITY = re.compile(r"&(?:#(\d+)|#x([0-9a-fA-F]+)|(amp|lt|gt|quot|apos));")
_NAMED_ENTITIES = {"amp": "&", "lt": "<", "gt": ">", "quot": '"', "apos": "'"}


def named_files(path, defines):
    """Return the files that the scene file at `path` names, with `defines` for its parameters: a dict from the absolute
    path (str) to whether the scene names the file by a relative path. Names without a file are left out.

    Files are named by `<include filename>`, `<spectrum filename>` and `<string>` elements that have a name of
    `FILE_PROPERTIES`. Other attributes, such as identifiers, name no files.
    """
    main = Path(os.path.abspath(path))
    reader = _Reader(main.parent, dict(defines))
    reader.read(main, [])
    return reader.found


class _Reader:
    """Elements of a scene in document order, includes among them; `found` as `named_files` returns it."""

    def __init__(self, folder, parameters):
        self.found, self._folder, self._parameters = {}, folder, parameters
        self._added = []  # (folder of a <path> element, whether it has a relative path), the last one first

    def read(self, file, outer):
        """Read an XML file; `outer` are the folders of the files that include it. Mitsuba looks for included files
        beside the file that includes them, then beside the outer ones, for others only beside the main file."""
        beside = [(file.parent, True), *outer]
        for tag, attributes in _elements(file):
            attributes = {name: substitute(value, self._parameters) for name, value in attributes.items()}
            if tag == "default":
                self._parameters.setdefault(attributes.get("name"), attributes.get("value", ""))
            elif tag == "path":
                folder = attributes.get("value", "")
                self._added = [(base / folder, not os.path.isabs(folder)) for base, _ in beside] + self._added
            elif tag == "include" and (included := self._find(attributes.get("filename"), beside)):
                self.read(included, beside)
            elif tag == "spectrum":
                self._find(attributes.get("filename"), [(self._folder, True)])
            elif tag == "string" and attributes.get("name") in FILE_PROPERTIES:
                self._find(attributes.get("value"), [(self._folder, True)])

    def _find(self, name, folders):
        """Add the file of a name and return its path; None if no folder has it."""
        for folder, relative in [*folders, *self._added] if name else []:
            file = os.path.normpath(folder / name)
            if os.path.isfile(file):
                self.found[file] = self.found.get(file, False) or (relative and not os.path.isabs(name))
                return Path(file)
        return None


def _elements(file):
    """Yield the tag and the attributes (a dict) of all elements of an XML file."""
    for match in _MARKUP.finditer(_decode(file.read_bytes())):
        if match["tag"]:
            found = _ATTRIBUTE.findall(match["attributes"])
            yield match["tag"], {name: _ENTITY.sub(_character, double or single) for name, double, single in found}


def _decode(content):
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", "replace")
    if re.match(rb"<\?xml[^>]*encoding\s*=\s*[\"'](iso-8859-1|latin1)", content, re.IGNORECASE):
        return content.decode("latin-1")
    return content.decode("utf-8-sig", "surrogateescape")  # as names of files are


def _character(entity):
    decimal, hexadecimal, name = entity.groups()
    return _NAMED_ENTITIES[name] if name else chr(int(decimal or hexadecimal, 10 if decimal else 16))


def substitute(text, parameters):
    r"""Replace `$name` in a text by the values of `parameters`, the longest names first, wherever the name stands:
    `$p_a` has the parameter `p` unless there is one called `p_a`. `\$` stands for a dollar sign."""
    if "$" not in text:
        return text
    for name in sorted(parameters, key=len, reverse=True):
        text = re.sub(rf"(?<!\\)\${re.escape(name)}", lambda _, name=name: parameters[name], text)
    return text.replace("\\$", "$")
