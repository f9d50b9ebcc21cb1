"""Reading an integrator's properties with type and range checked: Mitsuba itself passes any type through."""

from __future__ import annotations

import math


def _fail(props, name: str, allowed: str, value):
    raise ValueError(f'{props.plugin_name()}: property "{name}" must be {allowed}, got {value!r}')


def integer(props, name: str, default: int, minimum: int, maximum: float = math.inf) -> int:
    """An integer from ``minimum`` to ``maximum``; a ValueError names property, value and what is allowed."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= maximum:
        limits = f"of at least {minimum}" if maximum == math.inf else f"from {minimum} to {maximum}"
        _fail(props, name, f"an integer {limits}", value)
    return value


def number(props, name: str, default: float, minimum: float) -> float:
    """A finite number of at least ``minimum``."""
    value = props.get(name, default)
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    if not numeric or not math.isfinite(value) or value < minimum:
        _fail(props, name, f"a number of at least {minimum:g}", value)
    return float(value)


def boolean(props, name: str, default: bool) -> bool:
    """True or false."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        _fail(props, name, "true or false", value)
    return value


def choice(props, name: str, default: str, allowed: tuple[str, ...]) -> str:
    """One of a few words."""
    value = props.get(name, default)
    if value not in allowed:
        _fail(props, name, "one of " + ", ".join(f'"{word}"' for word in allowed), value)
    return value


def words(props, name: str, allowed: tuple[str, ...], default: str = "") -> tuple[str, ...]:
    """A comma-separated list of words out of ``allowed``, each at most once; by default that of ``default``.

    An empty one is allowed where it is the default.
    """
    value = props.get(name, default)
    found = [word.strip() for word in value.split(",")] if isinstance(value, str) and value.strip() else []
    known = all(word in allowed for word in found) and len(set(found)) == len(found)
    if not isinstance(value, str) or not known or (default and not found):
        _fail(props, name, "a comma-separated list out of " + ", ".join(f'"{word}"' for word in allowed), value)
    return tuple(found)


def depth(props, default: int) -> float:
    """``max_depth`` as Mitsuba's ``path`` has it: -1 (returned as infinity) or a count of at least 0."""
    value = props.get("max_depth", default)
    if isinstance(value, bool) or not isinstance(value, int) or value < -1:
        _fail(props, "max_depth", "-1 (no limit) or an integer of at least 0", value)
    return math.inf if value == -1 else value
