"""Objects that serve one thread at a time: who else would use them is told, instead of getting a wrong image."""

from __future__ import annotations

from contextlib import contextmanager
from threading import Lock, get_ident

import mitsuba as mi

# By the identity of objects in use: the thread that uses them
_USERS: dict[int, int] = {}
_LOCK = Lock()


@contextmanager
def exclusive(**objects):
    """Use ``objects``, named as they are called, in this thread alone while the block runs.  Blocks of one thread may
    hold each other.

    Raises a RuntimeError, which is logged too, that names an object which another thread is using.
    """
    thread = get_ident()
    with _LOCK:
        others = [name for name, one in objects.items() if _USERS.get(id(one), thread) != thread]
        taken = [id(one) for one in objects.values() if id(one) not in _USERS and not others]
        _USERS.update(dict.fromkeys(taken, thread))
    if others:
        refusal = (
            f"another thread is rendering with the same {others[0]}: give each thread one of its own (load the scene "
            "once for each), or render one image after the other"
        )
        mi.Log(mi.LogLevel.Warn, refusal)
        raise RuntimeError(refusal)
    try:
        yield
    finally:
        with _LOCK:
            for key in taken:
                del _USERS[key]
