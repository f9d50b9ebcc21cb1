"""Schedulers in separate processes: restarted after a kill, and reached by TLS."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from comparison.cluster import connection
from comparison.images import read_exr
from tests.support.distributed_renders import in_one_process, prepared
from tests.support.paths import CORNELL, ROOT
from tests.support.processes import PATIENCE, wait_until

distributed = pytest.importorskip("distributed")

# A scheduler with a worker, in one process
ALONE = """
import sys, threading
import distributed
with distributed.LocalCluster(
    n_workers=1, threads_per_worker=1, processes=False, host="127.0.0.1", protocol="tcp://", memory_limit=0,
    scheduler_port=int(sys.argv[1]), dashboard_address="127.0.0.1:0",
):
    threading.Event().wait()
"""


@pytest.fixture
def port():
    """A port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@contextmanager
def started(*command, environment=None):
    """Run a process during the block; kill its process group at the end."""
    own = subprocess.Popen(
        command, cwd=ROOT, start_new_session=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield own
    finally:
        end(own)


def end(process):
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_scheduler_that_is_started_anew_during_a_render_changes_nothing(port):
    command, address, again = (sys.executable, "-c", ALONE, str(port)), f"tcp://127.0.0.1:{port}", []

    def progress(took, image):
        if took.passes == 2 and not again:
            end(first)
            again.append(stack.enter_context(started(*command)))

    with ExitStack() as stack:
        first = stack.enter_context(started(*command))
        distributed.Client(address, timeout=PATIENCE).close()
        workers = stack.enter_context(connection.connected(address, 1))
        image, took = prepared(workers, spp=200).render(progress=progress)
    assert again and took.spp == 200
    np.testing.assert_array_equal(image.numpy(), in_one_process())


@pytest.mark.skipif(shutil.which("openssl") is None, reason="there is no openssl to make a certificate")
def test_the_example_of_tls(port, tmp_path):
    """That of the page, with another scene and port; who has no certificate is not let in."""
    page = (ROOT / "docs/cluster.md").read_text()
    (example,) = re.findall(r"```sh\n(openssl.*?)```", page, re.DOTALL)
    prepare, scheduler, worker, render = re.split(r"\./run -- ", example.replace("8786", str(port)))
    prepare = subprocess.run(["bash", "-ec", f"{prepare}\nenv -0"], cwd=tmp_path, capture_output=True, check=True)
    environment = dict(one.split("=", 1) for one in prepare.stdout.decode().split("\0") if one)
    address = f"tls://127.0.0.1:{port}"
    assert address in scheduler and address in worker and address in render
    arguments = render.split()
    arguments[arguments.index("scenes/hall.xml")] = CORNELL
    arguments[arguments.index("hall.exr")] = str(tmp_path / "a.exr")
    programs = Path(sys.executable).parent
    with (
        started(*_command(scheduler, programs), environment=environment),
        started(*_command(worker, programs), environment=environment),
    ):
        with socket.socket() as one:
            wait_until(lambda: one.connect_ex(("127.0.0.1", port)) == 0)
        # A render waits a minute for a worker, which takes longer to start on a busy machine
        waiting = f"import distributed; distributed.Client({address!r}, timeout={PATIENCE}).wait_for_workers(1)"
        subprocess.run([sys.executable, "-c", waiting], env=environment, check=True, timeout=PATIENCE)
        small = ["-D", "resx=16", "-D", "resy=16", "-i", "path"]
        command = [sys.executable, "-m", arguments[0], *arguments[1:], *small]
        subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=PATIENCE, capture_output=True)
        assert read_exr(tmp_path / "a.exr")[2]["spp"] == 64
        refused = subprocess.run(command, cwd=ROOT, timeout=PATIENCE, capture_output=True, text=True)
        assert refused.returncode == 2 and address in refused.stderr and "Traceback" not in refused.stderr


def _command(line, programs):
    """Convert a line of the example to a command of this environment."""
    name, *arguments = line.replace("&", "").split()
    return [str(programs / name), *arguments]
