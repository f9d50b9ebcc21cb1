"""The installed package: contents of the wheel, commands, types, and discovery of plugins by Mitsuba."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib.metadata import Distribution
from pathlib import Path

import pytest

import integrators
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE
from tests.support.registration import FIRST, LATER, LOAD

PACKAGES = ("comparison", "integrators", "vpl")
NO_SOURCES = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "*.egg-info", "output", "shared", "tests")

# What Mitsuba 3.10 does when a variant is set (`load_plugins` of mitsuba/detail.py), before it calls those who asked to
# be told, or after.
MITSUBA_3_10 = """
import importlib
import mitsuba as mi
from importlib.metadata import entry_points

modules = []

def load_plugins():
    if modules:
        for module in modules:
            importlib.reload(module)
    else:
        for point in sorted(entry_points(group="mitsuba"), key=lambda point: point.name):
            modules.append(importlib.import_module(point.value))

def set_variant(variant, before):
    if before and modules:
        told = importlib.import_module("integrators")._register
        mi.detail.remove_variant_callback(told)
        old = mi.variant()
        mi.set_variant(variant)
        load_plugins()
        told(old, variant)
        mi.detail.add_variant_callback(told)
    else:
        mi.set_variant(variant)
        load_plugins()
"""
LOAD_ALL = """
for variant in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono"):
    set_variant(variant, BEFORE)
    for point in entry_points(group="mitsuba"):
        try:
            integrator = mi.load_dict({"type": point.name})
            print(variant, point.name, isinstance(integrator, mi.SamplingIntegrator))
        except RuntimeError as error:
            assert f'"{point.name}" does not support the variant "{variant}"' in str(error), error
box = mi.cornell_box()
box["sensor"]["film"] |= {"width": 8, "height": 8, "pixel_format": "luminance"}
print(mi.render(mi.load_dict(box), integrator=mi.load_dict({"type": "manylights"}), spp=4).numpy().mean())
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The project's wheel, built from its source distribution, which is built from a copy of the sources."""
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, folder / "sources", ignore=NO_SOURCES)
    build = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    done = subprocess.run(
        [sys.executable, "-c", build], cwd=folder / "sources", capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    assert "absent from the `packages`" not in done.stdout + done.stderr
    [archive] = folder.glob("*.tar.gz")
    pip("wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", folder, archive)
    [file] = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """An environment with the wheel and its dependencies from this environment."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    [packages] = folder.glob("lib/python*/site-packages")
    # A path added in this way has its own .pth files ignored, e.g. the file of this project's editable installation
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    pip("--python", folder / "bin/python", "install", "--no-deps", "--no-index", wheel)
    return folder


def pip(*arguments):
    """Run pip, without a network."""
    command = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr


def run(environment, *command, folder=None):
    """Run a command of an environment, far from the sources; return its output."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [environment / "bin" / command[0], *command[1:]], cwd=folder or environment, env=variables,
        capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_has_every_module_and_what_they_read(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*") if "__pycache__" not in file.parts]
    expected = {str(file.relative_to(ROOT)) for file in files if file.is_file()}
    assert expected <= names
    assert {"compare.py", "manylights.py", "manylights-stubs/__init__.pyi"} <= names
    others = {name.partition("/")[0] for name in names}
    assert others <= {*PACKAGES, "compare.py", "manylights.py", "manylights-stubs", *(n for n in others if "info" in n)}
    assert wheel.stat().st_size < 2e6


@pytest.mark.parametrize("begin", [FIRST, LATER])
def test_importing_the_installed_package_registers_the_plugins(environment, begin):
    lines = run(environment, "python", "-c", begin + LOAD + "print(manylights.__file__)").splitlines()
    assert Path(lines.pop()).is_relative_to(environment)
    assert len(lines) == 3 * len(integrators.PLUGINS) and lines.count("True") == len(integrators.PLUGINS)


def test_every_plugin_has_an_entry_point(environment):
    """A file per case, since a reload of a package keeps its modules."""
    [metadata] = environment.glob("lib/python*/site-packages/manylights-*.dist-info")
    points = Distribution.at(metadata).entry_points.select(group="mitsuba")
    assert {point.name: point.value for point in points} == {
        name: f"integrators.{name}" for name in integrators.PLUGINS
    }


@pytest.mark.parametrize("before", [False, True])
def test_mitsuba_3_10_finds_the_plugins_in_each_variant(environment, before):
    script = MITSUBA_3_10 + LOAD_ALL.replace("BEFORE", str(before))
    *lines, mean = run(environment, "python", "-c", script).splitlines()
    expected = [f"{variant} {name} True" for variant in ("llvm_ad_rgb", "llvm_ad_mono") for name in integrators.PLUGINS]
    assert sorted(lines) == sorted(expected)
    assert float(mean) > 0


def test_commands_and_the_demo_are_installed(environment):
    assert "Render scenes with any integrator" in run(environment, "manylights", "--help")
    assert "usage: manylights-compare" in run(environment, "manylights-compare", "--help")
    script = "import compare; print(*(part for part in compare.DEMO if '/' in part), sep='\\n')"
    files = [Path(line) for line in run(environment, "python", "-c", script).splitlines()]
    assert [file.name for file in files] == ["hall.xml", "hall_reference.exr"]
    assert all(file.is_file() and file.is_relative_to(environment) for file in files)


def extras():
    """Names of the modules of optional packages that the commands use."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    packages = [requirement for extra in ("compare", "denoise", "cluster") for requirement in listed[extra]]
    return [re.match(r"[\w-]+", package)[0].replace("-", "_") for package in packages]


@pytest.mark.parametrize("command", ["manylights", "compare"])
def test_help_needs_no_optional_package(environment, command):
    """A module None in sys.modules cannot be imported."""
    hide = f"import sys\nsys.modules |= dict.fromkeys({extras()})\nimport {command}\n"
    assert "usage: " in run(environment, "python", "-c", f"{hide}{command}.main(['--help'])")


def test_a_comparison_names_the_missing_package(environment):
    script = f"import sys\nsys.modules |= dict.fromkeys({extras()})\nimport compare\nprint(compare.main(['--demo']))"
    done = subprocess.run(
        [environment / "bin/python", "-c", script], cwd=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.stdout == "1\n" and "pip install 'manylights[compare]'" in done.stderr


TYPED = """
from typing import assert_type
import manylights
import mitsuba as mi

def draw(scene: mi.Scene) -> None:
    image, took = manylights.render(scene, "manylights", error=0.05, denoise=True, progress=lambda took, image: None)
    assert_type(image, mi.TensorXf)
    assert_type(took, manylights.Took)
    assert_type(took.error, float | None)
    assert_type(manylights.main(["scene.xml"]), int)
    manylights.render("scene.xml", spp="4")  # type: ignore[arg-type]
    manylights.write("image.exr", image, took.channels)
    manylights.write(4, image)  # type: ignore[arg-type]
"""


@pytest.mark.stress
def test_types_of_the_public_module_reach_the_user(environment, tmp_path):
    (tmp_path / "typed.py").write_text(TYPED)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", environment / "bin/python", "typed.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr


def first_commands():
    """The commands of README's first block, from an empty environment to an image."""
    _, _, rest = (ROOT / "README.md").read_text().partition("## Install\n")
    return rest.partition("```sh\n")[2].partition("```")[0]


def test_readme_gets_to_an_image_in_a_few_lines(environment, tmp_path):
    """Its last line; the stress test below installs, too."""
    *_, last = lines = first_commands().splitlines()
    assert len(lines) < 10
    shutil.copytree(ROOT / "scenes", tmp_path / "scenes", ignore=lambda _, files: set(files) - {"hall.xml"})
    run(environment, *last.replace("--spp 4", "--spp 1").split(), folder=tmp_path)
    assert (tmp_path / "hall.png").stat().st_size > 3e4


@pytest.fixture(scope="module")
def index(tmp_path_factory):
    """Skips a test without a package index."""
    download = [
        sys.executable,
        "-m",
        "pip",
        "-q",
        "download",
        "--no-deps",
        "-d",
        tmp_path_factory.mktemp("index"),
        "tqdm",
    ]
    found = subprocess.run(download, capture_output=True, text=True, timeout=PATIENCE)
    if found.returncode:
        pytest.skip(f"no package index can be reached: {found.stderr.strip().splitlines()[-1]}")


@pytest.mark.stress
@pytest.mark.usefixtures("index")
def test_readme_gets_from_an_empty_environment_to_an_image(tmp_path):
    """Run all lines unchanged in a copy of the sources; downloads Mitsuba."""
    shutil.copytree(ROOT, tmp_path / "sources", ignore=NO_SOURCES)
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        ["sh", "-ec", first_commands()], cwd=tmp_path / "sources", env=variables, capture_output=True, text=True,
        timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "sources" / "hall.png").stat().st_size > 3e4


@pytest.fixture(scope="module")
def bare(wheel, index, tmp_path_factory):
    """An environment with the wheel and its core dependencies, without the optional ones; downloads Mitsuba."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    pip("--python", folder / "bin/python", "install", wheel)
    return folder


NEW_USER = """
import manylights
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
box = mi.cornell_box()
box["sensor"]["film"] |= {"width": 24, "height": 16}
scene = mi.load_dict(box)
image, took = manylights.render(scene, "manylights", spp=4)
manylights.write("box.exr", image, took.channels)
manylights.write("box.png", mi.render(scene, integrator=mi.load_dict({"type": "lightcuts"}), spp=4))
print(took.spp, mi.Bitmap("box.exr").size(), mi.Bitmap("box.png").size())
"""


@pytest.mark.stress
@pytest.mark.parametrize("cores", ["all", "one"])
def test_ten_lines_of_a_new_user_run_without_optional_packages(bare, tmp_path, cores):
    pin = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n" if cores == "one" else ""
    said = run(bare, "python", "-c", pin + NEW_USER, folder=tmp_path)
    assert said.endswith("4 [24, 16] [24, 16]\n")  # after colours of Mitsuba's log


@pytest.mark.stress
@pytest.mark.parametrize("command", ["manylights", "manylights-compare"])
def test_commands_of_a_bare_installation_show_their_help(bare, command):
    assert f"usage: {command}" in run(bare, command, "--help")
