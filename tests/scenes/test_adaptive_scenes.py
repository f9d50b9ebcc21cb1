"""The scenes of many occluded lights, which have the lights of Donikian et al. 2006, Table 1, and their generators."""

import importlib
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from comparison.images import read_exr
from comparison.scene_files import SceneFile

SCENES = Path(__file__).resolve().parents[2] / "scenes"
# For each scene: generator, options, numbers of emitters (point, area, environment), range of the mean visible fraction
# of emitters, and largest fraction of sky in the image.
TRAITS = {
    "kitchen_lamps": ("kitchen_lamps", [], (0, 72, 0), (0.05, 0.35), 0),
    "kitchen_windows": ("kitchen_lamps", ["--windows"], (0, 72, 1), (0.05, 0.35), 0),
    "forest_lights": ("forest_lights", [], (138, 0, 1), (0.01, 0.1), 0.15),
    "concourse": ("concourse", [], (613, 219, 0), (0.1, 0.5), 0),
}
NAMES = list(TRAITS)
SIZE = 64, 48


@pytest.fixture(scope="module")
def generate():
    """Return a function that runs a scene's generator and returns the written file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCENES)

        def run(name, folder, seed=1):
            script, options, *_ = TRAITS[name]
            output = folder / f"{name}.xml"
            importlib.import_module(script).main([*options, "--seed", str(seed), "--output", str(output)])
            return output

        yield run


@pytest.fixture(scope="module", autouse=True)
def scalar_variant(variant):
    """These scenes are looked at and rendered a little each, which is soonest done without compiling."""
    mi.set_variant("scalar_rgb")
    yield
    mi.set_variant(variant)


@pytest.fixture(scope="module")
def scenes(scalar_variant):
    """Return the shipped scenes by name, small."""
    defines = {"integrator": "direct", "max_depth": "2", "spp": "4", "resx": str(SIZE[0]), "resy": str(SIZE[1])}
    loaded = {}
    for name in NAMES:
        file = SceneFile(SCENES / f"{name}.xml", defines)
        assert file.integrator == ("direct", {"max_depth": 2})
        file.set_integrator("direct")
        loaded[name] = file.load()
    return loaded


def first_hits(scene):
    """Trace a ray through each pixel; yield rays and hits."""
    for y in range(SIZE[1]):
        for x in range(SIZE[0]):
            place = mi.Point2f((x + 0.5) / SIZE[0], (y + 0.5) / SIZE[1])
            ray, _ = scene.sensors()[0].sample_ray(0, 0.5, place, mi.Point2f(0.5))
            yield ray, scene.ray_intersect(ray)


def light_positions(text):
    """Return the positions of the lights of a scene's XML, (n, 3); of an extended light, the centre."""
    lines = [line for line in text.splitlines() if re.search('<emitter type="(point|area)">', line)]
    found = [re.search('(?:name="position" value|name="center" value|origin)="([^"]+)"', line)[1] for line in lines]
    return np.array([[float(number) for number in position.split(",")] for position in found])


def boxes(path):
    """Return the planes of the cuboids of a scene, (n, 12, 3) points and outward normals of their triangles."""
    points, normals = [], []
    for shape in mi.load_file(str(path), optimize=False).shapes():  # optimizing would merge them
        if shape.is_mesh() and shape.face_count() == 12:
            vertices = np.array([shape.vertex_position(index) for index in range(shape.vertex_count())])
            corners = vertices[np.array([shape.face_indices(index) for index in range(12)], int)]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            outward = np.sign(np.sum(normal * (corners[:, 0] - vertices.mean(0)), axis=-1, keepdims=True))
            points.append(corners[:, 0])
            normals.append(outward * normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    return np.array(points), np.array(normals)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_files_are_what_the_generator_makes(generate, tmp_path, name):
    generate(name, tmp_path)
    for path in tmp_path.iterdir():
        if path.suffix == ".exr":
            ours, shipped = read_exr(path)[0], read_exr(SCENES / path.name)[0]
            np.testing.assert_allclose(ours, shipped, rtol=1e-3)
        else:
            assert path.read_bytes() == (SCENES / path.name).read_bytes(), path.name
        assert path.stat().st_size < 2**20


@pytest.mark.parametrize("name", NAMES)
def test_numbers_of_lights_are_those_of_the_paper(scenes, name):
    text = (SCENES / f"{name}.xml").read_text()
    counts = tuple(text.count(f'<emitter type="{kind}">') for kind in ("point", "area", "envmap"))
    assert counts == TRAITS[name][2]
    assert text.count("<emitter ") == sum(counts) == len(scenes[name].emitters())


@pytest.mark.parametrize("name", NAMES)
def test_seed_changes_lights_only(generate, tmp_path, name):
    first, second = (SCENES / f"{name}.xml").read_text(), generate(name, tmp_path, seed=2).read_text()
    assert first != second

    def building(text):
        return [re.sub("<emitter.*</emitter>", "", line) for line in text.splitlines()[1:]]

    # Random numbers place lanterns with cages among the trees.
    assert name == "forest_lights" or building(first) == building(second)
    assert len(first.splitlines()) == len(second.splitlines())


def test_windows_add_the_sky_to_the_kitchen_and_nothing_else():
    lamps, windows = ((SCENES / f"kitchen_{name}.xml").read_text().splitlines()[1:] for name in ("lamps", "windows"))
    assert lamps == [line for line in windows if '<emitter type="envmap">' not in line]


@pytest.mark.parametrize("name", NAMES)
def test_scene_renders(scenes, name):
    scene = scenes[name]
    assert scene.sensors()[0].film().rfilter().is_box_filter()
    assert scene.sensors()[0].sampler().sample_count() == 4
    image = np.array(mi.render(scene, spp=4))
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert np.isfinite(image).all()
    assert 0.05 < image.mean() < 20


@pytest.mark.parametrize("name", NAMES)
def test_camera_sees_a_closed_scene_or_the_sky(scenes, name):
    sky = [ray.d.z for ray, hit in first_hits(scenes[name]) if not hit.is_valid()]
    assert len(sky) <= TRAITS[name][4] * SIZE[0] * SIZE[1]
    assert min(sky, default=1) > 0


@pytest.mark.parametrize("name", NAMES)
def test_average_point_sees_few_lights(scenes, name):
    scene, random, seen = scenes[name], np.random.default_rng(2), []
    for _, hit in first_hits(scene):
        for sample in random.random((5, 2)) if hit.is_valid() else ():
            # Mitsuba draws its emitters with equal probability. Visible sides of surfaces are lit.
            light, weight = scene.sample_emitter_direction(hit, mi.Point2f(sample), True)
            seen.append(max(weight) > 0 and hit.to_local(light.d).z * hit.wi.z > 0)
    low, high = TRAITS[name][3]
    assert low < np.mean(seen) < high


@pytest.mark.parametrize("name", NAMES)
def test_no_light_is_inside_a_wall(name):
    lights = light_positions((SCENES / f"{name}.xml").read_text())
    assert len(lights) == sum(TRAITS[name][2][:2])
    points, normals = boxes(SCENES / f"{name}.xml")
    assert len(points) > 50
    outside = np.einsum("lbfi,bfi->lbf", lights[:, None, None] - points, normals).max(axis=-1)
    assert outside.min() > 0, np.argwhere(outside <= 0)
