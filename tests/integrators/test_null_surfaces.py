"""``manylights`` behind masks and thin glass: shadow rays of emitters pass them, and the mean stays that of ``prb``."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS, MATERIALS
from tests.support.many_emitters import bulbs, panels
from tests.support.marks import stress
from tests.support.rendering import render
from tests.support.rooms import sunny, veiled_room
from tests.support.scenes import area_light, closed_box, image, rgb, sensor, wall
from tests.support.statistics import assert_same_mean
from vpl.points.camera_paths import scene_traits
from vpl.split.emitters import emitter_sampler
from vpl.split.emitters.base import EmitterSample
from vpl.transport.contribution import passage

BLACK = {"type": "diffuse", "reflectance": rgb(0.0)}
NINE_TENTHS = {"type": "mask", "opacity": 0.1, "nested": BLACK}  # of the light pass
TORN = {"type": "mask", "opacity": image([[[0.0], [1.0]], [[0.7], [0.2]]]), "nested": {"type": "diffuse"}}
BUMPS = image(np.random.default_rng(5).random((8, 8, 1)))
SHEETS = {
    "torn": TORN,
    "glass": {"type": "thindielectric"},
    "blend": {"type": "blendbsdf", "weight": 0.4, "a": TORN, "b": {"type": "diffuse"}},
    # A bump map reports no transmission, so that shadow rays end at it
    "bumps": {
        "type": "bumpmap",
        "bump": BUMPS,
        "scale": 0.01,
        "nested": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}},
    },
}


def sheets(*names):
    """Sheets of some materials across the closed box, below its lights."""
    return {
        f"sheet{number}": wall([0, 0.3 - 0.2 * number, 0], [1, 0, 0], -90, 1.0, bsdf=SHEETS[name])
        for number, name in enumerate(names)
    }


def assert_image_of_prb(scene, max_depth, finds=0.06, seeds=10, **more):
    def pair(seed):
        found = render(scene, "manylights", 128, seed, max_depth=max_depth, **more)
        return found, render(scene, "prb", 512, seed, max_depth=max_depth)

    assert_same_mean(pair, seeds, finds)


@pytest.mark.parametrize(
    "names", ["bumps glass", *stress("torn glass", "bumps torn", "blend", "glass glass", "torn blend bumps")]
)
@pytest.mark.parametrize("light", ["lamp", *stress("envmap", "constant")])
def test_light_through_sheets(names, light, lights_cost_nothing):
    lights = {"lamp": area_light()} if light == "lamp" else EMITTERS[light]()
    box = closed_box(lights, 12, **sheets(*names.split()))
    if light != "lamp":
        del box["ceiling"]
    assert_image_of_prb(mi.load_dict(box), 5)


@pytest.mark.parametrize("light", ["sunny", "lamp"])
def test_a_black_mask_dims_light(light, lights_cost_nothing):
    """A path needs one more edge to pass it; there is no indirect light with three edges."""
    box = closed_box(sunny() if light == "sunny" else {"lamp": area_light()}, 12)
    if light == "sunny":
        del box["ceiling"]
    black = {"type": "mask", "opacity": 0.4, "nested": BLACK}
    masked = box | {"mask": wall([0, 0.5, 0], [1, 0, 0], -90, 1.0, bsdf=black)}
    clear, masked = mi.load_dict(box), mi.load_dict(masked)

    def pair(seed):
        found = render(masked, "manylights", 128, seed, max_depth=3)
        return found, 0.6 * render(clear, "path", 512, seed + 1000, max_depth=2)

    assert_same_mean(pair, 10, 0.02)


@pytest.mark.parametrize("max_depth", [3, *stress(4, 6)])
def test_many_emitters_above_a_torn_sheet(max_depth, lights_cost_nothing):
    """Virtual lights carry only light that passes no surface."""
    rng = np.random.default_rng(2)
    scene = mi.load_dict(closed_box(panels(90, rng) | bulbs(10, rng), 12, **sheets("torn")))
    # With ten pairs, the bound of the spread is missed
    assert_image_of_prb(scene, max_depth, seeds=16)


def test_paths_that_find_large_emitters_close_above_glass():
    """Seen from the floor, the glass is far from the vertex, and close to the emitters."""
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90).scale(0.11)
    places = [[x, 0.95, z] for x in np.linspace(-0.8, 0.8, 8) for z in np.linspace(-0.8, 0.8, 8)]
    tiles = {
        f"tile{i}": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate(place) @ turned,
            "emitter": {"type": "area", "radiance": rgb(1.0)},
        }
        for i, place in enumerate(places)
    }
    glass = wall([0, 0.9, 0], [1, 0, 0], -90, 1.0, bsdf={"type": "thindielectric"})
    assert_image_of_prb(mi.load_dict(closed_box(tiles, 12, glass=glass)), 3, finds=0.03)


@pytest.mark.parametrize("offset", [0, 60])
def test_shadow_rays_end_before_the_emitter_behind_many_surfaces(offset):
    """Mitsuba moves the origins of rays by a distance that grows with the coordinates."""
    masks = {f"mask{i}": wall([0, offset + 0.8 - 0.05 * i, 0], [1, 0, 0], 90, 1.0, bsdf=NINE_TENTHS) for i in range(8)}
    lamp = wall([0, offset + 1, 0], [1, 0, 0], 90, 1.0) | {"emitter": {"type": "area", "radiance": rgb(1.0)}}
    scene = mi.load_dict({"type": "scene", "lamp": lamp, **masks})
    surface = dr.zeros(mi.SurfaceInteraction3f)
    surface.p, surface.n = mi.Point3f(0.1, float(offset), 0.2), mi.Normal3f(0, 1, 0)
    ray = surface.spawn_ray_to(mi.Point3f(0.1, float(offset + 1), 0.2))
    passed, crossings = passage(scene, scene_traits(scene), ray, mi.UInt32(20), mi.Bool(True))
    assert crossings[0] == 8
    np.testing.assert_allclose(np.array(passed)[0], 0.9**8, rtol=1e-5)


def test_an_emitter_behind_a_mask_behind_a_hidden_emitter():
    """All camera rays pass the hidden lamp, and nine tenths of their light the mask."""
    scene = mi.load_dict({
        "type": "scene",
        "sensor": sensor(8, 4, fov=20),
        "lamp": wall([0, 0, 1], [0, 1, 0], 0, 4.0) | {"emitter": {"type": "area", "radiance": rgb(5.0)}},
        "mask": wall([0, 0, 0], [0, 1, 0], 0, 4.0, bsdf=NINE_TENTHS),
        "sky": {"type": "constant", "radiance": rgb(2.0)},
    })  # fmt: skip
    image = render(scene, "manylights", 256, max_depth=4, hide_emitters=True)
    np.testing.assert_allclose(image.mean(), 0.9 * 2, rtol=0.02)


def test_shadow_rays_pass_as_many_surfaces_as_allowed():
    """A point on the axis of four masks, each of which passes a fraction of 0.6."""
    scene = mi.load_dict(veiled_room())
    count = 5
    start = mi.Point3f(np.array([[0.3] * count, [0.2] * count, [0.5] * count]))
    ray, one = mi.Ray3f(start, mi.Vector3f(0, 0, -1)), mi.Float(np.ones(count))
    ray.maxt = mi.Float(np.full(count, 1.499))
    for is_point, expected in ((False, [0, 0, 0, 0, 0.6**4]), (True, [0] * 5)):
        sample = EmitterSample(
            mi.Vector3f(0, 0, -1), mi.UnpolarizedSpectrum(one), one, mi.Bool([is_point] * count), ray, mi.UInt32(0)
        )
        passed, crossings = sample.arriving(scene, emitter_sampler(scene, 100), mi.UInt32(range(count)), mi.Bool(True))
        np.testing.assert_allclose(np.array(passed)[0], expected, rtol=1e-5)
        assert np.array(crossings)[4] == (0 if is_point else 4)


def test_scenes_without_null_surfaces_have_plain_shadow_rays():
    assert not emitter_sampler(mi.load_dict(closed_box(EMITTERS["rectangle"]())), 100).traits.null
    assert emitter_sampler(mi.load_dict(veiled_room()), 100).traits.null


def halves(*materials):
    """An instance of a sheet of each of some materials, side by side across the closed box."""
    objects = {}
    for number, material in enumerate(materials):
        sheet = wall([0, 0, 0], [1, 0, 0], -90, 0.5, bsdf=material)
        transform = mi.ScalarTransform4f().translate([number - 0.5, 0, 0]).scale([1, 1, 2])
        objects[f"group{number}"] = {"type": "shapegroup", "sheet": sheet}
        group = {"type": "ref", "id": f"group{number}"}
        objects[f"half{number}"] = {"type": "instance", "to_world": transform, "group": group}
    return closed_box({"lamp": area_light()}, 12, **objects)


def test_shadow_rays_pass_instances_of_null_surfaces_alone(lights_cost_nothing):
    opaque = {"type": "diffuse"}
    assert not emitter_sampler(mi.load_dict(halves(opaque, opaque)), 100).traits.null
    scene = mi.load_dict(halves(TORN, opaque))
    assert emitter_sampler(scene, 100).traits.null
    assert_image_of_prb(scene, 5)


def test_only_instances_of_groups_with_null_surfaces_are_passed():
    group = {"type": "shapegroup", "sheet": wall([0, 0, 0], [1, 0, 0], -90, 1.0)}
    open_group = {"type": "shapegroup", "sheet": wall([0, 0, 0], [1, 0, 0], -90, 1.0, bsdf=TORN)}
    scene = mi.load_dict({
        "type": "scene", "one": group, "other": open_group, "own": wall([0, 1, 0], [1, 0, 0], -90, 1.0, bsdf=TORN),
        "of_one": {"type": "instance", "of": {"type": "ref", "id": "one"}},
        "of_other": {"type": "instance", "of": {"type": "ref", "id": "other"}},
    })  # fmt: skip
    traits, instances = scene_traits(scene), {shape.id(): shape for shape in scene.shapes()}

    def is_listed(shape):
        return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) in traits.open_shapes

    assert traits.null and not traits.glossy
    assert [is_listed(instances[name]) for name in ("of_one", "of_other", "own")] == [False, True, True]
    # The scene's own sheet, that of the open group, and its instance
    assert len(traits.open_shapes) == 3


@pytest.mark.parametrize("material", ["mask", "thindielectric"])
def test_the_noise_of_a_lamp_behind_a_sheet_is_that_of_a_lamp_that_is_seen(material):
    """BSDF samples rarely find a small lamp: by `prb`, its light has many times the variance behind a sheet."""
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0.9, 0]).rotate([1, 0, 0], 90).scale(0.05),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 100.0}},
    }
    sheet = {"sheet": wall([0, 0.6, 0], [1, 0, 0], -90, 1.0, bsdf=MATERIALS[material]())}
    scene = mi.load_dict(closed_box({"lamp": lamp}, 16, **sheet))
    variance = {}
    for plugin in ("manylights", "prb"):
        # The lower half, without the lamp and its edges
        images = [render(scene, plugin, 16, seed, max_depth=3).mean(-1)[8:] for seed in range(8)]
        variance[plugin] = np.var(images, axis=0, ddof=1).mean()
    assert variance["manylights"] < 0.05 * variance["prb"]


def test_shapes_keep_the_names_of_their_parameters():
    scene = mi.load_dict(veiled_room())
    before = list(mi.traverse(scene).keys())
    render(scene, "manylights", 4)
    assert list(mi.traverse(scene).keys()) == before
