"""Exclusive use of objects by a thread: a second thread gets an error instead of a wrong image."""

from __future__ import annotations

from contextlib import contextmanager
from threading import Lock, get_ident

import mitsuba as mi

# Thread that uses an object, by the identity of the object
_USERS: dict[int, int] = {}
_LOCK = Lock()


@contextmanager
def exclusive(**objects):
    """Reserve ``objects`` (keyword: name for messages) for this thread while the block runs.

    Blocks of the same thread may be nested. Raises and logs a RuntimeError that names an object in use by another
    thread.
    """
    thread = get_ident()
    with _LOCK:
        others = [name for name, one in objects.items() if _USERS.get(id(one), thread) != thread]
        taken = [id(one) for one in objects.values() if id(one) not in _USERS and not others]
        _USERS.update(dict.fromkeys(taken, thread))
    if others:
        refusal = (
            f"another thread is rendering with the same {others[0]}: give each thread its own (load the scene once for "
            "each), or render one image after the other"
        )
        mi.Log(mi.LogLevel.Warn, refusal)
        raise RuntimeError(refusal)
    try:
        yield
    finally:
        with _LOCK:
            for key in taken:
                del _USERS[key]
