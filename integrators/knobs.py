"""Knobs: properties of plugins, with allowed values, description and default declared once.

A plugin class has a tuple ``knobs``, which adds to or replaces knobs of its base classes.  Its constructor calls
:func:`read_knobs`, which checks the given values and sets an attribute of the same name for each knob.  Its
``to_string`` prints the knobs by :func:`show_knobs`, and its manual page lists them (:mod:`integrators.manual`).
"""

from __future__ import annotations

import difflib
import math
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

# Columns of an entry in the manual page; the page's indentation adds up to two
_PAGE_WIDTH = 118
# Error above which a percentage was probably intended
_LARGEST_FRACTION = 0.5
# Properties read by Mitsuba's base class
_OF_MITSUBA = ("timeout", "samples_per_pass", "block_size")


@dataclass(frozen=True)
class Knob:
    """Property of a plugin.

    ``default``: default value, or a function of the plugin, whose previously declared knobs are already set;
    ``text``: description in reStructuredText; ``{allowed}`` in it is replaced by the allowed words; ``stated_default``:
    text of the default in the manual page, if different from its value.
    """

    name: str
    default: bool | int | float | str | Callable
    text: str
    stated_default: str = field(default="", kw_only=True)

    type: ClassVar[str]  # name of the type in Mitsuba's manual

    @property
    def allowed(self) -> str:
        """Description of the allowed values, for error messages."""
        raise NotImplementedError

    def parse(self, value):
        """Attribute for a given value; None if the value is not allowed."""
        raise NotImplementedError

    def show(self, value):
        """Value to give for an attribute: inverse of :meth:`parse`."""
        return value

    def read(self, plugin, props):
        """Attribute for the given value or the default; ValueError with property, value and allowed values."""
        value = props.get(self.name, self.default(plugin) if callable(self.default) else self.default)
        parsed = self.parse(value)
        if parsed is None:
            raise ValueError(f'{props.plugin_name()}: property "{self.name}" must be {self.allowed}, got {value!r}')
        return parsed

    def entry(self) -> str:
        """The property's entry in Mitsuba's directive ``pluginparameters``."""
        default = self.stated_default or self._stated(self.default)
        text = f"{self.text.replace('{allowed}', self._stated_words())} (Default: {default}{self._stated_limits()})"
        wrapped = textwrap.fill(
            text, _PAGE_WIDTH, initial_indent="  - ", subsequent_indent="    ", break_long_words=False,
            break_on_hyphens=False,
        )  # fmt: skip
        return f"* - {self.name}\n  - |{self.type}|\n{wrapped}\n"

    def _stated(self, default) -> str:
        return str(default)

    def _stated_words(self) -> str:
        return ""

    def _stated_limits(self) -> str:
        return ""


@dataclass(frozen=True)
class _Limited(Knob):
    """Number from ``minimum`` to ``maximum``, both included."""

    minimum: float = field(kw_only=True)
    maximum: float = field(default=math.inf, kw_only=True)

    noun: ClassVar[str]  # kind of number, for error messages

    @property
    def allowed(self) -> str:
        if self.maximum == math.inf:
            return f"{self.noun} of at least {self.minimum:g}"
        return f"{self.noun} from {self.minimum:g} to {self.maximum:g}"

    def _stated_limits(self) -> str:
        return f"; at least {self.minimum:g}" + (f", at most {self.maximum:g}" if self.maximum < math.inf else "")

    def _within(self, value) -> bool:
        return self.minimum <= value <= self.maximum


class Integer(_Limited):
    """Whole number."""

    type, noun = "int", "an integer"

    def parse(self, value):
        whole = isinstance(value, int) and not isinstance(value, bool)
        return value if whole and self._within(value) else None


class Number(_Limited):
    """Finite number."""

    type, noun = "float", "a number"

    def parse(self, value):
        numeric = isinstance(value, int | float) and not isinstance(value, bool)
        return float(value) if numeric and math.isfinite(value) and self._within(value) else None


class Fraction(Number):
    """Relative error; warns of values that look like percentages."""

    def read(self, plugin, props):
        value = super().read(plugin, props)
        doubt_percentage(f'{props.plugin_name()}: property "{self.name}"', value)
        return value


class Boolean(Knob):
    """True or false."""

    type = "bool"
    allowed = "true or false"

    def parse(self, value):
        return value if isinstance(value, bool) else None

    def _stated(self, default):
        return "yes" if default else "no"


class Depth(Knob):
    """Number of edges; -1 for no limit, stored as infinity."""

    type = "int"
    allowed = "-1 (no limit) or an integer of at least 0"

    def parse(self, value):
        if isinstance(value, bool) or not isinstance(value, int) or value < -1:
            return None
        return math.inf if value == -1 else value

    def show(self, value):
        return -1 if value == math.inf else value


@dataclass(frozen=True)
class _Worded(Knob):
    """Property with the allowed words ``words``."""

    words: tuple[str, ...] = field(kw_only=True)

    type = "string"

    def _quoted(self) -> str:
        return ", ".join(f'"{word}"' for word in self.words)

    def _stated_words(self) -> str:
        return ", ".join(f"``{word}``" for word in self.words)


class Choice(_Worded):
    """One of the words."""

    @property
    def allowed(self):
        return f"one of {self._quoted()}"

    def parse(self, value):
        return value if value in self.words else None

    def _stated(self, default):
        return f"``{default}``"


class Words(_Worded):
    """Comma-separated list of distinct words, stored as a tuple."""

    @property
    def allowed(self):
        return f"a comma-separated list out of {self._quoted()}"

    def parse(self, value):
        if not isinstance(value, str):
            return None
        found = tuple(word.strip() for word in value.split(",")) if value.strip() else ()
        return found if set(found) <= set(self.words) and len(set(found)) == len(found) else None

    def show(self, value):
        return ",".join(value)

    def _stated(self, default):
        return f"``{default}``" if default else "none"


@dataclass(frozen=True)
class Groups(Knob):
    """Named lists of words, such as ``"lamps=lamp*,bulb; sky=env"``, stored as a dict of tuples by name.

    ``reserved``: names that are not allowed.
    """

    reserved: tuple[str, ...] = field(default=(), kw_only=True)

    type = "string"

    @property
    def allowed(self):
        return (
            'groups such as "lamps=lamp*,bulb; sky=env" with distinct names of letters, digits, "_" and "-", except '
            f"{', '.join(self.reserved)}"
        )

    def parse(self, value):
        """Patterns by name of the group, in order, from text such as ``lamps=lamp*,bulb; sky=env``; None if the text is
        not allowed."""
        if not isinstance(value, str):
            return None
        found: dict[str, tuple[str, ...]] = {}
        for entry in value.split(";") if value.strip() else ():
            name, _, words = (part.strip() for part in entry.partition("="))
            patterns = tuple(word.strip() for word in words.split(","))
            if not re.fullmatch(r"[\w-]+", name) or name in (*found, *self.reserved) or not all(patterns):
                return None
            found[name] = patterns
        return found

    def show(self, value):
        return "; ".join(f"{name}={','.join(patterns)}" for name, patterns in value.items())

    def _stated(self, default):
        return "none"


# Path settings of every integrator, with the defaults of Mitsuba's ``path``
PATH_KNOBS = (
    Depth(
        "max_depth", -1,
        "Longest path from camera to emitter, in edges, as counted by Mitsuba's ``path``: 1 shows emitters only, 2 "
        "adds direct light, and -1 is no limit.",
    ),
    Integer("rr_depth", 5, "Number of edges from which Russian roulette may end paths.", minimum=1),
    Boolean("hide_emitters", False, "Hide area emitters and environments from the camera."),
)  # fmt: skip


def doubt_percentage(name: str, value: float) -> None:
    """Log a warning for a fraction that looks like a percentage; ``name``: name of the value in the message."""
    import mitsuba as mi  # local, because manual pages are filled without Mitsuba

    if value > _LARGEST_FRACTION:
        said = f"{name} is a fraction, {value:g} means {value:.0%}; {value:g}% would be {value / 100:g}"
        mi.Log(mi.LogLevel.Warn, said)


def knobs_of(plugin: type) -> tuple[Knob, ...]:
    """Knobs of a class, then the knobs of its base classes with different names."""
    found: dict[str, Knob] = {}
    for base in plugin.__mro__:
        for knob in vars(base).get("knobs", ()):
            found.setdefault(knob.name, knob)
    return tuple(found.values())


def read_knobs(plugin, props) -> None:
    """Set an attribute of ``plugin`` for each of its knobs, after Mitsuba's constructor has read its properties.

    Raises ValueError for values that are not allowed, and for unknown properties, with the closest known name.
    """
    knobs = knobs_of(type(plugin))
    for knob in knobs:
        setattr(plugin, knob.name, knob.read(plugin, props))
    for name in props.unqueried():
        names = [*(knob.name for knob in knobs), *_OF_MITSUBA]
        near = difflib.get_close_matches(name, names, 1)
        help = f'did you mean "{near[0]}"?' if near else "there are " + ", ".join(f'"{known}"' for known in names)
        raise ValueError(f'{props.plugin_name()}: unknown property "{name}"; {help}')


def show_knobs(plugin) -> str:
    """One line per knob, in the format of Mitsuba's plugins."""
    lines = [f"  {knob.name} = {knob.show(getattr(plugin, knob.name))}" for knob in knobs_of(type(plugin))]
    return f"{type(plugin).__name__}[\n" + ",\n".join(lines) + "\n]"
