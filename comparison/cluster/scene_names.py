"""Files that a scene names, by a reader of XML with the rules of Mitsuba's parser (pugixml).

Mitsuba's parser reports neither included files without objects nor the files of spectra. Python's XML parser refuses
documents that pugixml accepts: with a bare `&`, undeclared entities, or two hyphens in a comment.
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
    """Return the files that a scene file names, with the parameters `defines`: a dict from the absolute path (str) to
    whether the scene names the file by a relative path. Missing files are ignored.

    Files are named by `<include filename>`, by `<spectrum filename>`, and by `<string>` properties in
    `FILE_PROPERTIES`. Identifiers and the remaining attributes name no files.
    """
    main = Path(os.path.abspath(path))
    reader = _Reader(main.parent, dict(defines))
    reader.read(main, [])
    return reader.found


class _Reader:
    """Reads elements in document order, with included files in place; `found` is the result of `named_files`."""

    def __init__(self, folder, parameters):
        self.found, self._folder, self._parameters = {}, folder, parameters
        self._added = []  # (folder of a <path> element, whether its path is relative), latest first

    def read(self, file, outer):
        """Read an XML file; `outer`: folders of the including files. Mitsuba searches an included file beside the
        including file, then in `outer`; other files beside the main file; all files finally in the folders of <path>
        elements."""
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
        """Add the first file of a given name in `folders` and return its path, None if there is none."""
        for folder, relative in [*folders, *self._added] if name else []:
            file = os.path.normpath(folder / name)
            if os.path.isfile(file):
                self.found[file] = self.found.get(file, False) or (relative and not os.path.isabs(name))
                return Path(file)
        return None


def _elements(file):
    """Yield tag and attributes (a dict) of each element of an XML file."""
    for match in _MARKUP.finditer(_decode(file.read_bytes())):
        if match["tag"]:
            found = _ATTRIBUTE.findall(match["attributes"])
            yield match["tag"], {name: _ENTITY.sub(_character, double or single) for name, double, single in found}


def _decode(content):
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", "replace")
    if re.match(rb"<\?xml[^>]*encoding\s*=\s*[\"'](iso-8859-1|latin1)", content, re.IGNORECASE):
        return content.decode("latin-1")
    return content.decode("utf-8-sig", "surrogateescape")  # the encoding of file names


def _character(entity):
    decimal, hexadecimal, name = entity.groups()
    return _NAMED_ENTITIES[name] if name else chr(int(decimal or hexadecimal, 10 if decimal else 16))


def substitute(text, parameters):
    r"""Replace each `$name` in a text by the value of the parameter, longest names first. A name may end within a word:
    `$p_a` contains the parameter `p` unless `p_a` is defined. `\$` is a dollar sign."""
    if "$" not in text:
        return text
    for name in sorted(parameters, key=len, reverse=True):
        text = re.sub(rf"(?<!\\)\${re.escape(name)}", lambda _, name=name: parameters[name], text)
    return text.replace("\\$", "$")
