"""The shipped scenes and their generator."""

import importlib.util
import re
from pathlib import Path

import mitsuba as mi
import pytest

from comparison.scene_files import SceneFile

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "scenes"


@pytest.fixture(scope="module")
def generator():
    """The module scenes/hall.py, which is a script and no part of a package."""
    specification = importlib.util.spec_from_file_location("hall", ROOT / "scenes" / "hall.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def kinds(text):
    """Count the points, the spots and the area lights of a scene's XML."""
    return [len(re.findall(f'<emitter type="{kind}">', text)) for kind in ("point", "spot", "area")]


@pytest.mark.parametrize("name", ["cornell", "glossy", "hall"])
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


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/scenes")
def test_scenes_of_others_parse():
    for path in sorted(SHARED.glob("*/scene.xml")):
        file = SceneFile(path, {"resx": "64", "resy": "36"})
        assert file.name == path.parent.name
        assert file.size == (64, 36)
        assert file.integrator == ("path", {"max_depth": 6})
