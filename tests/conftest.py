"""Fixtures of all tests, and the number of processes of a run."""

import os
import signal

import drjit as dr
import mitsuba as mi
import pytest

from tests.support.comparisons import SWEEP
from tests.support.marks import VARIANT
from tests.support.processes import wait_until
from tests.support.rendering import plugin_with_model

MOST_PROCESSES = 4  # each holds some 2 GiB


def pytest_configure():
    """Hear Ctrl-C, which the background processes of a script ignore, with all processes that tests start."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_auto_num_workers(config):
    """One process per core for the whole suite, and none besides this one for a few files: each imports for seconds."""
    is_whole = config.args_source == pytest.Config.ArgsSource.TESTPATHS
    return min(len(os.sched_getaffinity(0)), MOST_PROCESSES) if is_whole else 0


@pytest.fixture(scope="session", autouse=True)
def variant():
    """Every test starts in the same variant, with the plugins registered."""
    mi.set_variant(VARIANT)
    import integrators  # noqa: F401

    return VARIANT


@pytest.fixture(scope="session")
def threads():
    """The number of threads that tests start with."""
    return dr.thread_count()


@pytest.fixture(autouse=True)
def restore_threads(threads):
    """Restore the number of threads, which a command sets for the whole process: with one thread, Mitsuba hangs when it
    reads EXR files."""
    yield
    dr.set_thread_count(threads)


@pytest.fixture
def restore_variant():
    """For tests that change the variant."""
    yield
    mi.set_variant(VARIANT)


@pytest.fixture(scope="session")
def swept(tmp_path_factory, variant):
    """The output folder of compare.py for `SWEEP`, made by the first process of the run that needs it."""
    import compare

    base = tmp_path_factory.getbasetemp()
    out = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "sweep"
    try:
        out.mkdir()
    except FileExistsError:
        wait_until(lambda: (out / "finished").exists() or (out / "failed").exists())
    else:
        succeeded = False
        try:
            succeeded = compare.main([*SWEEP, "-o", str(out), "--cache", str(out / "cache")]) == 0
        finally:
            (out / ("finished" if succeeded else "failed")).touch()
    assert (out / "finished").exists(), "compare.py failed in the first process that made the sweep"
    return out


@pytest.fixture
def lights_cost_nothing():
    """Let ``manylights`` use virtual lights wherever lights can carry anything."""
    with plugin_with_model(pays_below=1e30, fewest_light_paths=4000):
        yield
