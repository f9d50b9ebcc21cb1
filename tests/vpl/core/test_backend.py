"""Checks of the libraries below Mitsuba, against the libraries of this machine."""

import glob
import os
import subprocess
import sys

import pytest

from tests.support.paths import ROOT
from vpl.core.backend import check_backend, import_drjit

# What a user would run, with the kernel that aborts LLVM 15 and 16 behind the check.
RENDER = """
from vpl.core.backend import check_backend
check_backend("llvm_ad_rgb")
import drjit as dr
from drjit.llvm import Float
print(dr.minimum(dr.arange(Float, 3), 1))
"""


def python(code: str, llvm: str | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter, because a process loads libLLVM once."""
    environment = {**os.environ, **variables}
    if llvm is not None:
        environment["DRJIT_LIBLLVM_PATH"] = llvm
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )


def find_llvm(major: int) -> str:
    # Up to 17 the version comes before the suffix, from 18 on behind it.
    folders = ("/usr/lib/*-linux-gnu", f"/usr/lib/llvm-{major}/lib", "/usr/lib64", "/usr/lib")
    names = (f"libLLVM-{major}.so*", f"libLLVM.so.{major}*")
    found = [path for folder in folders for name in names for path in glob.glob(f"{folder}/{name}")]
    if not found:
        pytest.skip(f"this machine has no libLLVM {major}")
    return found[0]


@pytest.mark.parametrize("major", [13, 14, 15, 16])
def test_old_llvm_is_one_error_with_the_fix(major):
    path = find_llvm(major)
    result = python(RENDER, llvm=path)
    assert result.returncode == 1, result.stderr  # an exception, not an abort by a signal
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("RuntimeError: The variant 'llvm_ad_rgb' needs libLLVM 17 or newer")
    for fix in ("apt install libllvm19", "DRJIT_LIBLLVM_PATH", "./run", path):
        assert fix in last


@pytest.mark.parametrize("major", [17, 18, 19, 20, 21, 22])
def test_newer_llvm_passes_and_compiles(major, tmp_path):
    # An empty kernel cache, or nothing would be compiled.
    result = python(RENDER, llvm=find_llvm(major), DRJIT_CACHE_DIR=str(tmp_path))
    assert (result.returncode, result.stdout) == (0, "[0, 1, 1]\n"), result.stderr


def test_missing_llvm_is_one_error_with_the_fix():
    result = python(RENDER, llvm="/nowhere/libLLVM.so")
    assert result.returncode == 1, result.stderr
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("RuntimeError: The variant 'llvm_ad_rgb' needs libLLVM 17 or newer")
    assert "apt install libllvm19" in last and "DRJIT_LIBLLVM_PATH is '/nowhere/libLLVM.so'" in last


@pytest.mark.parametrize("version", [(15, 0, 6), (16, 0, 6), (-1, -1, -1)])
def test_versions_refused_without_the_libraries(version, monkeypatch):
    monkeypatch.setattr(import_drjit().detail, "llvm_version", lambda: version)
    with pytest.raises(RuntimeError, match="apt install libllvm19"):
        check_backend("llvm_mono")


@pytest.mark.parametrize("version", [(17, 0, 0), (19, 1, 7), (30, 0, 0)])
def test_versions_accepted_without_the_libraries(version, monkeypatch):
    monkeypatch.setattr(import_drjit().detail, "llvm_version", lambda: version)
    check_backend("llvm_ad_rgb")


@pytest.mark.parametrize("variant", ["cuda_ad_rgb", "scalar_rgb"])
def test_other_variants_need_no_llvm(variant):
    code = f"from vpl.core.backend import check_backend; check_backend({variant!r})"
    assert python(code, llvm="/nowhere/libLLVM.so").returncode == 0


def test_import_drjit_returns_the_module():
    assert import_drjit().__name__ == "drjit"


def test_missing_libatomic_is_explained(tmp_path):
    # Behaviour of drjit 1.5 if its binary part cannot be loaded.
    (tmp_path / "drjit").mkdir()
    (tmp_path / "drjit" / "__init__.py").write_text(
        "try:\n"
        "    raise ImportError('libatomic.so.1: cannot open shared object file: No such file or directory')\n"
        "except ImportError:\n"
        "    filename = _drjit_ext.__file__\n"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{RENDER}"
    result = python(code)
    last = result.stderr.strip().splitlines()[-1]
    assert result.returncode == 1
    assert last.startswith("ImportError: Dr.Jit could not load its binary part: libatomic.so.1")
    assert "apt install libatomic1" in last
