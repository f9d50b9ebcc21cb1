"""`import manylights`: the plugins for any variant, and modules of other people by the names of its packages."""

import os
import subprocess
import sys

import pytest

import integrators
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE
from tests.support.registration import FIRST, LATER, LOAD


def script(folder, text):
    """Run a script that lies in a folder, while this project is somewhere on Python's path."""
    (folder / "script.py").write_text(text)
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, str(folder / "script.py")], cwd=folder, env=os.environ | {"PYTHONPATH": path},
        capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip


@pytest.mark.parametrize("begin", [FIRST, LATER])
def test_the_plugins_are_there_for_variants_set_before_and_after(tmp_path, begin):
    done = script(tmp_path, begin + LOAD)
    lines = done.stdout.splitlines()
    count = len(integrators.PLUGINS)
    assert done.returncode == 0 and len(lines) == 3 * count, done.stderr
    assert all(line.endswith("Integrator") for line in lines[:count] + lines[2 * count :])
    assert lines[count : 2 * count] == ["True"] * count


@pytest.mark.parametrize(
    ("package", "place"),
    [("integrators", "integrators.py"), ("vpl", "vpl.py"), ("comparison", "comparison/__init__.py")],
)
@pytest.mark.parametrize("imported", [False, True])
def test_a_module_that_hides_a_package_is_an_error_that_names_both(tmp_path, package, place, imported):
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).touch()
    done = script(tmp_path, f"import {package}\nimport manylights" if imported else "import manylights")
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: the package '{package}' of manylights, {ROOT / package}, is hidden by")
    assert str(tmp_path / place) in last


def test_modules_of_other_names_do_no_harm(tmp_path):
    (tmp_path / "vpl_tools.py").touch()
    (tmp_path / "integrators").mkdir()  # not a package
    assert script(tmp_path, "import manylights").returncode == 0
