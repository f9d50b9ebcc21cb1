"""Knobs: accepted values, error messages, and inheritance by plugins."""

import math

import mitsuba as mi
import pytest

from integrators.knobs import Boolean, Choice, Depth, Integer, Number, Words, knobs_of, read_knobs, show_knobs

COUNT = Integer("count", 3, "How many.", minimum=1)
BOUNDED = Integer("bounded", 3, "How many.", minimum=1, maximum=9)
SIZE = Number("size", 0.5, "How large.", minimum=0)
SHARE = Number("share", 0.5, "How much.", minimum=0, maximum=1)
SHOWN = Boolean("shown", False, "Whether.")
DEPTH = Depth("depth", -1, "How deep.")
KIND = Choice("kind", "a", "Which, out of {allowed}.", words=("a", "b"))
PARTS = Words("parts", "a,b", "Which.", words=("a", "b", "c"))

ACCEPTED = [
    (COUNT, 1, 1), (BOUNDED, 9, 9), (SIZE, 0, 0.0), (SIZE, 1e9, 1e9), (SHARE, 1, 1.0), (SHOWN, True, True),
    (DEPTH, -1, math.inf), (DEPTH, 0, 0), (KIND, "b", "b"), (PARTS, " c , a", ("c", "a")), (PARTS, "", ()),
]  # fmt: skip
REFUSED = [
    (COUNT, 0), (COUNT, 1.0), (COUNT, True), (COUNT, "1"), (BOUNDED, 10), (SIZE, -0.1), (SIZE, math.nan),
    (SIZE, math.inf), (SIZE, True), (SIZE, "x"), (SHARE, 1.5), (SHOWN, 1), (SHOWN, "yes"), (DEPTH, -2), (DEPTH, 1.5),
    (DEPTH, True), (KIND, "c"), (KIND, 3), (PARTS, "a,d"), (PARTS, "a,a"), (PARTS, "a,,b"), (PARTS, 3),
]  # fmt: skip


class Base:
    knobs = (COUNT, SIZE)

    def __init__(self, **given):
        self.given = given
        properties = mi.Properties("some")
        for name, value in given.items():
            properties[name] = value
        read_knobs(self, properties)


class Derived(Base):
    knobs = (KIND, Integer("count", lambda plugin: 7 if plugin.kind == "b" else 5, "How many.", minimum=1), PARTS)


@pytest.mark.parametrize(("knob", "value", "kept"), ACCEPTED)
def test_accepted_values(knob, value, kept):
    assert knob.parse(value) == kept and type(knob.parse(value)) is type(kept)


@pytest.mark.parametrize(("knob", "value"), REFUSED)
def test_refused_values(knob, value):
    assert knob.parse(value) is None


def test_what_is_allowed_is_said():
    assert [knob.allowed for knob in (COUNT, BOUNDED, SIZE, SHARE, SHOWN, DEPTH, KIND, PARTS)] == [
        "an integer of at least 1", "an integer from 1 to 9", "a number of at least 0", "a number from 0 to 1",
        "true or false", "-1 (no limit) or an integer of at least 0", 'one of "a", "b"',
        'a comma-separated list out of "a", "b", "c"',
    ]  # fmt: skip


def test_entries_of_the_page():
    assert KIND.entry() == "* - kind\n  - |string|\n  - Which, out of ``a``, ``b``. (Default: ``a``)\n"
    assert SHARE.entry().endswith("(Default: 0.5; at least 0, at most 1)\n")
    assert SHOWN.entry().endswith("(Default: no)\n")


def test_own_knobs_come_first_and_replace_those_of_base_classes():
    assert [knob.name for knob in knobs_of(Derived)] == ["kind", "count", "parts", "size"]
    assert (Base().count, Derived().count, Derived(kind="b").count, Derived(count=2).count) == (3, 5, 7, 2)


def test_values_become_attributes_and_are_shown_as_they_are_given():
    plugin = Derived(size=2, parts="b, c")
    assert (plugin.size, plugin.parts) == (2.0, ("b", "c"))
    assert show_knobs(plugin) == "Derived[\n  kind = a,\n  count = 5,\n  parts = b,c,\n  size = 2.0\n]"


def test_a_value_that_is_not_allowed_is_named():
    with pytest.raises(ValueError, match='some: property "size" must be a number of at least 0, got -1'):
        Base(size=-1.0)


@pytest.mark.parametrize(
    ("name", "help"),
    [("cuont", 'did you mean "count"?'), ("timout", 'did you mean "timeout"?'), ("zzz", 'there are "kind", "count",')],
)
def test_unknown_properties_are_refused_with_those_that_may_have_been_meant(name, help):
    with pytest.raises(ValueError) as error:
        Derived(**{name: 1})
    assert str(error.value).startswith(f'some: unknown property "{name}"; {help}')


@pytest.mark.parametrize("value", [0.5, 2.0])
def test_errors_that_look_like_percentages_are_doubted(value, capfd):
    plugins = {"lightcuts", "mdlightcuts", "illuminationcut", "adaptivedirect", "unoccludeddirect"}
    for plugin in plugins:
        mi.load_dict({"type": plugin, "error": value})
        said = f'{plugin}: property "error" is a fraction, 2 means 200%; 2% would be 0.02'
        assert (said in "".join(capfd.readouterr())) == (value > 0.5)
