"""The command ./run, with stand-ins for Python and apt: nothing is downloaded or installed here."""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.processes import PATIENCE

# Log the request, and answer as files beside the project prescribe.
PYTHON = r"""#!/bin/sh
printf '%s\n' "python $*" | head -n 1 >>"$STATE/log"
case $* in
    -V) echo 'Python 3.11.9' ;;
    *version_info?:2*) echo 3.11 ;;
    *'-m venv'*) for folder; do :; done; mkdir -p "$folder/bin"; cp "$0" "$folder/bin/python" ;;
    *'-m pip'*) [ ! -e "$STATE/slow" ] || sleep 3; [ ! -e "$STATE/kill" ] || kill -9 0; [ ! -e "$STATE/offline" ] ;;
    *llvm_version*)
        case $DRJIT_LIBLLVM_PATH in */.venv/system/*) ;; *) [ ! -e "$STATE/old_llvm" ] ;; esac ;;
    *'import drjit'*) [ ! -e "$STATE/no_libatomic" ] ;;
    *compare.py* | *pytest* | *sphinx*) pwd; printf '<%s>' "$@" ;;
esac
"""

# Can fetch but not install, whoever asks.
APT_GET = r"""#!/bin/sh
echo "apt-get $*" >>"$STATE/log"
[ ! -e "$STATE/offline" ] || { echo 'E: no network' >&2; exit 100; }
case $* in
    *--download-only*libatomic1) rm -f "$STATE/no_libatomic" ;;
    *--download-only*) ;;
    *) exit 100 ;;
esac
for option; do
    case $option in
        Dir::Cache=*) touch "${option#*=}/archives/libc6_2_amd64.deb" "${option#*=}/archives/some.deb" ;;
    esac
done
"""

DPKG_DEB = r"""#!/bin/sh
echo "dpkg-deb ${2##*/}" >>"$STATE/log"
mkdir -p "$3/usr/lib/x86_64-linux-gnu"
touch "$3/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"
"""


class Project:
    """A copy of the script in a folder of its own, with everything that it may call on the PATH."""

    def __init__(self, folder: Path):
        self.folder = folder / "the project"  # a space, as in many a home
        self.state = folder / "state"
        tools = folder / "tools"
        for new in (self.folder, self.state, tools, folder / "elsewhere"):
            new.mkdir()
        for name in ("run", "pyproject.toml"):
            shutil.copy(ROOT / name, self.folder)
        pythons = ("python3", *(f"python3.{minor}" for minor in range(11, 15)))
        for name, text in {**dict.fromkeys(pythons, PYTHON), "apt-get": APT_GET, "dpkg-deb": DPKG_DEB}.items():
            (tools / name).write_text(text)
            (tools / name).chmod(0o755)
        self.elsewhere = folder / "elsewhere"
        self.llvm = self.state / "libLLVM.so"
        self.llvm.touch()
        self.environment = {
            **{k: v for k, v in os.environ.items() if k not in ("PYTHON", "LD_LIBRARY_PATH", "VIRTUAL_ENV")},
            "PATH": f"{tools}:/usr/bin:/bin",
            "STATE": str(self.state),
            "DRJIT_LIBLLVM_PATH": str(self.llvm),
        }

    def run(self, *arguments: str, status: int = 0, stdin: str = "", **variables: str):
        result = subprocess.run(
            [self.folder / "run", *arguments],
            cwd=self.elsewhere,
            env={**self.environment, **variables},
            input=stdin,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            start_new_session=True,  # the stand-in for pip kills the whole process group
        )
        assert result.returncode == status, result.stderr
        return result

    def set(self, condition: str, on: bool = True):
        (self.state / condition).touch() if on else (self.state / condition).unlink()

    def calls(self, what: str) -> int:
        """How often something was asked since the last look."""
        log = self.state / "log"
        text = log.read_text() if log.exists() else ""
        log.unlink(missing_ok=True)
        return text.count(what)


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",), ("help",)])
def test_usage_on_request(project, arguments):
    result = project.run(*arguments)
    assert "./run demo" in result.stdout and result.stderr == ""
    assert not (project.folder / ".venv").exists()


@pytest.mark.parametrize("arguments", [("dmeo",), ("--",), ("-x", "demo")])
def test_usage_errors(project, arguments):
    result = project.run(*arguments, status=2)
    assert "./run demo" in result.stderr and result.stdout == ""
    assert not (project.folder / ".venv").exists()


def test_sets_up_once(project):
    first = project.run("--", "echo", "hello")
    assert first.stdout == "hello\n" and "Setting up (once): " in first.stderr
    assert project.calls("-e .[test]") == 1
    second = project.run("--", "echo", "hello")
    assert (second.stdout, second.stderr) == ("hello\n", "")
    assert project.calls("python -V") == 1 and project.calls("python") == 0


def test_command_is_handed_over_untouched(project):
    program = 'cat; pwd; printf "<%s>" "$@"; exit 7'
    result = project.run("--", "sh", "-c", program, "sh", "a b", "", "*", status=7, stdin="piped\n")
    assert result.stdout == f"piped\n{project.elsewhere}\n<a b><><*>"


@pytest.mark.parametrize("command, call", [("demo", "<compare.py><--demo>"), ("test", "<-m><pytest>")])
def test_demo_and_test_run_in_the_project(project, command, call):
    assert project.run(command, "-k", "a b").stdout == f"{project.folder}\n{call}<-k><a b>"


def test_docs_builds_the_site_and_says_where_it_is(project):
    first, call, last = project.run("docs", "-j", "2").stdout.partition("<-m><sphinx><--fail-on-warning>")
    assert first == f"{project.folder}\n" and "<-j><2>" in last
    assert last.endswith(f"{project.folder}/output/docs/index.html\n") and call


def test_works_through_a_link_and_by_name(project):
    link = project.elsewhere / "link"
    link.symlink_to(project.folder / "run")
    for call in ([link], ["sh", "run"], ["sh", "./run"]):
        result = subprocess.run(
            [*call, "demo"], cwd=project.folder, env=project.environment, stdin=subprocess.DEVNULL, capture_output=True
        )
        assert result.stdout.decode().startswith(f"{project.folder}\n<compare.py>")


def test_becomes_the_command_so_that_signals_reach_it(project):
    project.run("--", "true")
    call = [project.folder / "run", "--", "sh", "-c", "echo $$; exec sleep 1000"]
    with subprocess.Popen(call, env=project.environment, stdout=subprocess.PIPE, text=True) as process:
        assert int(process.stdout.readline()) == process.pid
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=PATIENCE) == -signal.SIGINT


def test_completes_after_an_error_and_after_being_killed(project):
    project.set("offline")
    result = project.run("--", "true", status=1)
    assert "run: pip could not" in result.stderr and "Check the network" in result.stderr
    project.set("offline", False)
    project.set("kill")
    project.run("--", "true", status=-signal.SIGKILL)
    project.set("kill", False)
    assert project.calls("-m pip") == 2
    project.run("--", "true")
    assert project.calls("-e .[test]") == 1
    assert project.run("--", "true").stderr == ""


def test_a_long_step_counts_seconds_on_a_terminal_only(project):
    project.set("slow")
    assert "\r" not in project.run("--", "true").stderr
    shutil.rmtree(project.folder / ".venv")
    terminal, process_end = os.openpty()
    call = [project.folder / "run", "--", "true"]
    subprocess.run(call, env=project.environment, stderr=process_end, timeout=PATIENCE, check=True)
    os.close(process_end)
    shown = os.read(terminal, 10_000).decode()
    os.close(terminal)
    assert "\r1 s " in shown and "\r2 s " in shown
    lines = [line.strip() for line in re.split(r"[\r\n]+", shown) if line.strip()]
    assert all(re.match(r"\d+ s$|Setting up \(once\): ", line) for line in lines) and lines[-1].endswith(": done")


def test_ctrl_c_during_a_long_step_ends_the_counter(project):
    project.set("slow")
    terminal, process_end = os.openpty()
    call = [project.folder / "run", "--", "true"]
    with subprocess.Popen(call, env=project.environment, stderr=process_end, start_new_session=True) as process:
        os.close(process_end)
        shown = ""
        while "1 s " not in shown:
            shown += os.read(terminal, 10_000).decode()
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=PATIENCE) in (130, -signal.SIGINT)
        with pytest.raises(OSError):  # the terminal reports an error once no process has it open
            while os.read(terminal, 10_000):
                pass
    os.close(terminal)


def test_sets_up_again_when_what_it_depends_on_changes(project):
    project.run("--", "true")
    assert project.calls("-e .[test]") == 1

    with (project.folder / "pyproject.toml").open("a") as file:
        file.write("# another dependency\n")
    project.set("offline")
    assert "Check the network" in project.run("--", "true", status=1).stderr
    project.set("offline", False)
    project.run("--", "true")
    log = (project.state / "log").read_text()
    assert log.count("-e .[test]") == 2 and log.count("-m venv") == 0
    project.calls("")

    # A change of the script alone needs no new packages.
    with (project.folder / "run").open("a") as file:
        file.write("# another step\n")
    assert "Setting up" in project.run("--", "true").stderr
    assert project.calls("-e .[test]") == 0

    # A virtual environment does not survive a move, nor being copied along with the project.
    project.folder = project.folder.rename(project.folder.with_name("moved"))
    project.run("--", "true")
    assert project.calls("-m venv") == 1

    # The library went away with an upgrade of the system.
    other = project.llvm.rename(project.llvm.with_name("other.so"))
    assert "Setting up" in project.run("--", "true", DRJIT_LIBLLVM_PATH=str(other)).stderr
    assert project.run("--", "true").stderr == ""


def test_two_calls_at_once_set_up_once(project):
    call = [project.folder / "run", "--", "true"]
    both = [subprocess.Popen(call, env=project.environment, stderr=subprocess.DEVNULL) for _ in range(2)]
    assert [process.wait(timeout=PATIENCE) for process in both] == [0, 0]
    assert project.calls("-e .[test]") == 1


def test_old_or_missing_python(project):
    assert "PYTHON=/no/python is not a Python 3.11" in project.run("demo", status=1, PYTHON="/no/python").stderr
    for python in (project.state.parent / "tools").glob("python3*"):
        python.write_text('#!/bin/sh\n[ "$*" != -V ] || echo Python 3.10.4\nexit 1\n')
    message = project.run("demo", status=1).stderr
    assert "Python 3.11 or newer is needed" in message and "apt install python3" in message


def test_old_llvm_is_replaced_without_root(project):
    project.set("old_llvm")
    result = project.run(
        "--", "sh", "-c", 'echo "$DRJIT_LIBLLVM_PATH"; echo "$LD_LIBRARY_PATH"', LD_LIBRARY_PATH="/mine"
    )
    llvm, search_path = result.stdout.splitlines()
    assert llvm == str(project.llvm)  # the caller's own choice stays
    libraries = project.folder / ".venv/system/usr/lib/x86_64-linux-gnu"
    assert search_path == f"{libraries}:/mine"

    # Otherwise the unpacked library is used, without dependencies that would shadow the C library.
    del project.environment["DRJIT_LIBLLVM_PATH"]
    result = project.run("--", "sh", "-c", 'echo "$DRJIT_LIBLLVM_PATH"; echo "$LD_LIBRARY_PATH"')
    assert result.stdout.splitlines() == [f"{libraries}/libLLVM.so.19.1", str(libraries)]
    log = (project.state / "log").read_text()
    assert "install libllvm19" in log and "Debug::NoLocking=1" in log and "dpkg-deb some.deb" in log
    assert "dpkg-deb libc6" not in log


def test_missing_libatomic(project):
    project.set("no_libatomic")
    project.run("--", "true")
    assert project.calls("--download-only -y --no-install-recommends install libatomic1") == 1


def test_libraries_that_cannot_be_had(project):
    project.run("--", "true")
    project.set("offline")
    for condition, fix in (("no_libatomic", "apt install libatomic1"), ("old_llvm", "apt install libllvm19")):
        project.set(condition)
        (project.folder / ".venv/.ready").unlink(missing_ok=True)
        message = project.run("--", "true", status=1).stderr
        assert fix in message and "no network" in message
        project.set(condition, False)
    project.run("--", "true")


@pytest.mark.skipif(Path(sys.prefix) != ROOT / ".venv", reason="these tests do not run in the environment of ./run")
def test_the_real_environment():
    call = [ROOT / "run", "--", "python", "-c", "import mitsuba, sys; print(sys.prefix)"]
    result = subprocess.run(call, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE)
    assert result.stdout == f"{ROOT / '.venv'}\n", result.stderr
