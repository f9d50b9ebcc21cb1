"""The shipped scenes and their generator."""

import importlib
import importlib.util
import re
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from comparison.scene_files import SceneFile
from tests.support.paths import ROOT
from tests.support.processes import PATIENCE
from tests.support.rendering import render

SHARED = ROOT.parent / "shared" / "scenes"


@pytest.fixture(scope="module")
def generator():
    """The module scenes/hall.py, which is a script and no part of a package."""
    specification = importlib.util.spec_from_file_location("hall", ROOT / "scenes" / "hall.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def kinds(text):
    """Count the point, spot and area emitters of a scene's XML."""
    return [len(re.findall(f'<emitter type="{kind}">', text)) for kind in ("point", "spot", "area")]


@pytest.mark.parametrize(
    "name", ["cornell", "glossy", "hall", "banquet", "arcade", "corridor", "veils", "globes", "furnace"]
)
def test_scene_takes_the_usual_parameters(name):
    defines = {"integrator": "direct", "max_depth": "3", "spp": "7", "resx": "16", "resy": "8"}
    file = SceneFile(ROOT / "scenes" / f"{name}.xml", defines)
    assert file.integrator == ("direct", {"max_depth": 3})
    file.set_integrator("path")
    scene = file.load()
    assert list(scene.sensors()[0].film().size()) == [16, 8]
    assert scene.sensors()[0].sampler().sample_count() == 7
    assert scene.sensors()[0].film().rfilter().is_box_filter()
    image = mi.render(scene, spp=4).numpy()
    assert image.shape == (8, 16, 3)
    assert image.mean() > 0


def test_shipped_hall_is_what_the_generator_makes(generator, tmp_path):
    generator.main(["--lights", "1000", "--seed", "1", "--output", str(tmp_path / "hall.xml")])
    assert (tmp_path / "hall.xml").read_text() == (ROOT / "scenes" / "hall.xml").read_text()


# Numbers of point, spot and area emitters of scenes without parameters
OTHERS = {
    "banquet": [0, 60, 66],
    "arcade": [0, 0, 0],
    "corridor": [0, 0, 32],
    "veils": [0, 0, 6],
    "foliage": [0, 0, 0],
    "lamp_grid": [0, 0, 880],
}


@pytest.mark.parametrize("name", OTHERS)
def test_shipped_scenes_are_what_their_generators_make(name, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scenes")
    importlib.import_module(name).main(["--seed", "1", "--output", str(tmp_path / f"{name}.xml")])
    text = (tmp_path / f"{name}.xml").read_text()
    assert text == (ROOT / "scenes" / f"{name}.xml").read_text()
    assert kinds(text) == OTHERS[name]
    if name in ("arcade", "foliage"):
        made, shipped = (np.array(mi.Bitmap(str(f / f"{name}_sky.exr"))) for f in (tmp_path, ROOT / "scenes"))
        assert np.allclose(made, shipped, rtol=1e-2)


def test_shipped_room_is_what_its_generator_makes(tmp_path):
    """The generator needs a separate variant, like the add-on."""
    script = ROOT / "scenes" / "blender_room.py"
    subprocess.run([sys.executable, script, "--output", tmp_path / "blender_room.xml"], check=True, timeout=PATIENCE)
    made = [file for file in tmp_path.rglob("*") if file.is_file() and file.suffix != ".exr"]
    assert len(made) == 10
    for file in made:
        assert file.read_bytes() == (ROOT / "scenes" / file.relative_to(tmp_path)).read_bytes(), file.name


def test_a_scene_from_blender_renders_unchanged():
    """Principled materials, textures, a sun, a sky and a camera as the add-on writes them: the image of `path`."""
    file = SceneFile(ROOT / "scenes" / "blender_room.xml", {"resx": "48", "resy": "36"})
    assert file.integrator == ("path", {"max_depth": 12})
    scene = file.load()
    assert scene.sensors()[0].sampler().sample_count() == 64
    seeds = range(8)
    means = {
        name: [mi.render(scene, integrator=integrator, seed=seed, spp=64).numpy().mean((0, 1)) for seed in seeds]
        for name, integrator in (("path", scene.integrator()), ("manylights", of_its_own(file).integrator()))
    }
    noise = np.sqrt(sum(np.var(of, axis=0, ddof=1) / len(of) for of in means.values()))
    difference = np.mean(means["manylights"], axis=0) - np.mean(means["path"], axis=0)
    assert (noise < 0.01 * np.mean(means["path"], axis=0)).all()
    assert (abs(difference) < 4 * noise).all()


def of_its_own(file):
    """Load a scene with `manylights` in place of its integrator, like the command."""
    file.set_integrator("manylights")
    return file.load()


@pytest.mark.parametrize("direct", ["nee", pytest.param("adaptive", marks=pytest.mark.stress)])
def test_the_furnace_is_white(direct):
    scene = SceneFile(ROOT / "scenes" / "furnace.xml", {"resx": "24", "resy": "18"})
    scene.set_integrator("path")
    loaded = scene.load()
    images = [render(loaded, "lightcuts", 16, seed, clamping=0.0, vpl_count=5000, direct=direct) for seed in range(6)]
    means = np.stack(images).mean((1, 2, 3))
    assert abs(means.mean() - 1) < 5 * means.std(ddof=1) / len(means) ** 0.5 + 2e-3


def test_every_scene_has_a_picture_and_a_line_in_the_list():
    listed = (ROOT / "scenes" / "README.md").read_text()
    for path in (ROOT / "scenes").glob("*.xml"):
        assert path.with_suffix(".png").exists()
        assert f"[{path.stem}]({path.stem}.png)" in listed


@pytest.mark.parametrize("count", [1, 10, 37, 1000])
def test_hall_has_as_many_lights_as_asked_for(generator, count):
    points, spots, areas = kinds(generator.hall(count, seed=3))
    assert points + spots + areas == count
    assert (spots, areas) == (3 * count // 10, count // 10)


def test_building_depends_on_neither_number_nor_seed_of_lights(generator):
    def building(text):
        return [line for line in text.splitlines()[2:] if "<emitter" not in line]

    assert building(generator.hall(10, seed=1)) == building(generator.hall(200, seed=2))
    assert generator.hall(10, seed=1) != generator.hall(10, seed=2)


def test_hall_without_lights_is_refused(generator, tmp_path, capsys):
    with pytest.raises(SystemExit) as error:
        generator.main(["--lights", "0", "--output", str(tmp_path / "hall.xml")])
    assert error.value.code == 2
    assert "at least one light" in capsys.readouterr().err


@pytest.mark.parametrize("count", ["0", "1", "5", "-1"])
def test_veils_are_as_many_as_asked_for(count, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "scenes")
    main, output = importlib.import_module("veils").main, tmp_path / "veils.xml"
    if count == "-1":
        with pytest.raises(SystemExit):
            main(["--veils", count, "--output", str(output)])
        assert "the number of veils must not be negative, got -1" in capsys.readouterr().err
    else:
        main(["--veils", count, "--output", str(output)])
        assert output.read_text().count('<ref id="gauze"/>') == int(count)


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/scenes")
def test_scenes_of_others_parse():
    for path in sorted(SHARED.glob("*/scene.xml")):
        file = SceneFile(path, {"resx": "64", "resy": "36"})
        assert file.name == path.parent.name
        assert file.size == (64, 36)
        assert file.integrator == ("path", {"max_depth": 6})


def test_a_scene_with_an_exr_file_is_loaded_by_a_single_thread():
    """Mitsuba alone would wait for ever."""
    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        SceneFile(ROOT / "scenes" / "arcade.xml", {"resx": "16", "resy": "8"}).load()
        assert dr.thread_count() == 1
    finally:
        dr.set_thread_count(before)
