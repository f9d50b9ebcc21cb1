"""The plugin ``manylights``: means over seeds are those of ``path``, whatever the scene; with virtual lights forced."""

import itertools

import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS, MATERIALS, ONE_PIXEL, SENSORS, film, one_of, stage
from tests.support.marks import not_on_cuda, stress
from tests.support.rendering import plugin_with_model, render, render_with_statistics
from tests.support.rooms import bulb, glowing_octahedron, lamp_behind_the_camera, sunny, veiled_room
from tests.support.scenes import area_light, closed_box, image, rgb, sensor, wall
from tests.support.statistics import assert_same_mean

# What the quick run tests
QUICK_MATERIALS = ("roughplastic", "principled", "blendbsdf", "twosided", "diffuse")


pytestmark = pytest.mark.usefixtures("lights_cost_nothing")


def assert_image_of_path(description, spp=128, seeds=8, finds=0.025, reference="path", lights=True, of=None, **more):
    """Means over seeds, over tiles and over the image, are those of ``reference``; ``of``: its scene, if different."""
    scene = mi.load_dict(description)
    scene_of_reference = mi.load_dict(of) if of else scene

    def pair(seed):
        found, statistics = render_with_statistics("manylights", scene, spp, seed, **more)
        assert np.isfinite(found).all() and statistics["dropped"] == 0
        assert (statistics.get("light_paths", 0) > 0) == lights, statistics["plan"]
        return found, render(scene_of_reference, reference, spp, seed, **more)

    assert_same_mean(pair, seeds, finds)


WALLS = ("back", "left", "right", "floor", "ceiling")


def room_of(material, emitters):
    """A closed box with all walls of a material, except for the front."""
    box = closed_box(emitters, 12)
    for name in WALLS:
        box[name]["bsdf"] = {"type": "ref", "id": "material"}
    box["back"]["bsdf"] = material | {"id": "material"}
    return box


# ---------------------- Depths, emitters, materials ----------------------


@pytest.mark.parametrize("max_depth", [3, -1, *stress(5)])
def test_a_closed_box(max_depth):
    assert_image_of_path(closed_box(lamp_behind_the_camera(), 16), max_depth=max_depth)


@pytest.mark.stress
def test_a_batch_of_sensors_with_virtual_lights():
    box = closed_box(lamp_behind_the_camera(), 16)
    cameras = {name: box["sensor"] | {"film": film(8, 16), "fov": fov} for name, fov in (("near", 30), ("far", 60))}
    batch = {"type": "batch", "film": film(16, 16), "sampler": box["sensor"]["sampler"], **cameras}
    assert_image_of_path(box | {"sensor": batch}, max_depth=4)


@pytest.mark.parametrize("emitters", ["point spot rectangle", *stress("directional envmap", "constant", "sunsky")])
def test_emitters(emitters):
    ball = {"ball": {"type": "sphere", "center": [-0.6, -0.4, 0.3], "radius": 0.55, "bsdf": {"type": "plastic"}}}
    lamps = {name: next(iter(EMITTERS[name]().values())) for name in emitters.split()}
    assert_image_of_path(stage(lamps, ball, 16), finds=0.01, max_depth=4)


@pytest.mark.stress
def test_a_turned_sphere_with_a_texture():
    patches = image(np.random.default_rng(3).uniform(0, 8, (4, 8, 3)) ** 2) | {"filter_type": "nearest"}
    turned = mi.ScalarTransform4f().translate([0, 0.1, 0]).rotate([0, 0, 1], 25).rotate([1, 0, 0], 60).scale(0.35)
    glowing = {"type": "sphere", "to_world": turned, "emitter": {"type": "area", "radiance": patches}}
    assert_image_of_path(closed_box({"ball": glowing}, 16), max_depth=4)


@pytest.mark.stress
def test_a_glowing_mesh_with_vertex_normals():
    """With as many emitter samples as `path`: for these meshes, Mitsuba's samples of emitters and of BSDFs have
    different means (decisions.md)."""
    with plugin_with_model(pays_below=1e30, fewest_light_paths=4000, most_emitter_samples=1):
        assert_image_of_path(closed_box(glowing_octahedron(), 16), max_depth=4)


def test_a_sun_of_one_texel():
    assert_image_of_path(stage(sunny(), one_of(MATERIALS["roughplastic"]()), 16), max_depth=4)


def test_walls_of_some_materials():
    """The stress run has every material alone."""
    box = closed_box(lamp_behind_the_camera(), 16)
    for name, material in zip(WALLS, QUICK_MATERIALS, strict=True):
        box[name]["bsdf"] = MATERIALS[material]()
    assert_image_of_path(box, finds=0.04, max_depth=4)


RARELY_LIT = ("normalmap", "dielectric", "roughdielectric", "thindielectric")
# By way of its lobe paths meet small emitters too rarely for a test
NEARLY_A_MIRROR = "sharpconductor"


@pytest.mark.stress
@pytest.mark.parametrize(("emitter", "material"), list(itertools.product(EMITTERS, MATERIALS)))
def test_every_material_under_every_emitter(emitter, material):
    if emitter == "directionalarea":
        pytest.skip("path does not sample it: the image is black")
    lamps = EMITTERS[emitter]()
    if emitter in ("sun", "sunsky"):
        # By way of mirrors and glass, paths find a sun of the usual half degree too rarely for a test
        lamps["sky"]["sun_aperture"] = 10.0
    scene = stage(lamps, one_of(MATERIALS[material]()), 16)
    # The reference finds light behind glass by chance
    finds = 0.04 if material in RARELY_LIT else 0.025
    for max_depth in (2,) if material == NEARLY_A_MIRROR else (2, 3, 5, -1):
        assert_image_of_path(scene, finds=finds, reference="prb", lights=max_depth != 2, max_depth=max_depth)


@pytest.mark.parametrize("alpha", [0.1, 0.4])
def test_a_room_of_rough_metal_has_no_floor_that_its_samples_never_take_off(alpha):
    """With Beckmann's lobe, which falls faster than any power, it would be taken off in fireflies."""
    box = room_of({"type": "roughconductor", "alpha": alpha, "specular_reflectance": rgb(0.8)}, bulb())
    scene = mi.load_dict(box)
    images = [render(scene, "manylights", 64, seed, max_depth=4) for seed in range(4)]
    assert min(image.min() for image in images) > -0.1 * np.mean(images)


@pytest.mark.parametrize("weight", [0.3, *stress(0.7)])
def test_a_blend_of_a_mirror_and_a_diffuse_wall(weight):
    """What virtual lights carry is taken off in full although only some samples are of the diffuse part."""
    mirror = {"type": "conductor", "specular_reflectance": rgb(0.01)}
    blend = {"type": "blendbsdf", "weight": weight, "a": mirror, "b": {"type": "diffuse", "reflectance": rgb(0.9)}}
    assert_image_of_path(room_of(blend, bulb()), max_depth=4)


@pytest.mark.stress
def test_walls_whose_reflectance_is_negative_in_places():
    """Surfaces around receive negative light from there, which virtual lights carry as well."""
    texels = np.full((4, 4, 3), 0.7)
    texels[::2, ::2] = [-0.5, 0.3, -0.2]
    wall = {"type": "diffuse", "reflectance": image(texels) | {"filter_type": "nearest"}}
    assert_image_of_path(room_of(wall, bulb()), 1024, 16, max_depth=5)


@pytest.mark.stress
def test_a_half_transparent_mask_around_all():
    mask = {"type": "mask", "opacity": 0.6, "nested": {"type": "diffuse", "reflectance": rgb(0.9)}}
    assert_image_of_path(room_of(mask, bulb()), finds=0.03, reference="prb", max_depth=4)


@pytest.mark.parametrize("hide_emitters", [False, *stress(True)])
def test_a_mask_with_nothing_behind_it(hide_emitters):
    """`path` loses the light of samples that pass the mask; alpha is equal."""
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse"}}
    lamp = EMITTERS["constant"]() if hide_emitters else {"lamp": {"type": "point", "position": [0, 0, 3]}}
    description = {"type": "scene", "sensor": sensor(16), **lamp, "mask": wall([0, 0, 0], [0, 1, 0], 0, 8, bsdf=mask)}
    description["sensor"]["film"]["pixel_format"] = "rgba"
    scene, given = mi.load_dict(description), {"max_depth": 4, "hide_emitters": hide_emitters}
    found, darker, expected = (
        render(scene, name, 256, **given).mean((0, 1)) for name in ("manylights", "path", "prb")
    )  # fmt: skip
    assert found[:3] == pytest.approx(expected[:3], rel=0.01) and (darker[:3] < 0.5 * found[:3]).all()
    assert found[3] == pytest.approx(darker[3], rel=0.02) and found[3] == pytest.approx(0.3, rel=0.02)


@pytest.mark.parametrize("material", ["bumpmap", *stress("normalmap")])
def test_walls_that_turn_their_normals(material):
    """Lights shine in a lobe, all of which paths have to reach and subtract."""
    description = {**MATERIALS[material](), "nested": {"type": "diffuse", "reflectance": rgb(0.8)}}
    if material == "bumpmap":
        description["scale"] = 0.6
    box = closed_box(bulb(), 12)
    box["back"]["bsdf"], box["floor"]["bsdf"] = {**description, "id": "turned"}, {"type": "ref", "id": "turned"}
    assert_image_of_path(box, max_depth=4)


def test_colours_seen_in_a_mirror_at_a_small_depth():
    """There, lights may stand for their shortest paths only, and must not have the colours of longer ones."""
    box = closed_box(bulb(), 12)
    colours = {"right": (0.05, 0.9, 0.05), "left": (0.9, 0.05, 0.05), "ceiling": (0.05, 0.05, 0.9)}
    colours |= {"floor": (0.9, 0.05, 0.05), "front": (0.05, 0.9, 0.05)}
    for name, colour in colours.items():
        box[name]["bsdf"] = {"type": "diffuse", "reflectance": rgb(*colour)}
    box["back"]["bsdf"] = {"type": "conductor"}
    assert_image_of_path(box, max_depth=4)


@pytest.mark.parametrize("max_depth", [5, *stress(6, 8)])
def test_light_through_four_masks(max_depth):
    """Each of them is an edge of the path."""
    lights = max_depth > 5
    assert_image_of_path(veiled_room(), finds=0.08, reference="prb", lights=lights, max_depth=max_depth)


# ---------------------- Shapes and scenes ----------------------


def coarse_ball(folder):
    """A file of an octahedron with the normals of a sphere."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    mesh = mi.Mesh("ball", 6, 8, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = 0.6 * corners.ravel()
    parameters["vertex_normals"] = corners.ravel()
    parameters["faces"] = np.array(faces, np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(folder / "ball.ply"))
    return str(folder / "ball.ply")


@pytest.mark.parametrize("material", ["roughplastic", *stress("twosided")])
def test_shading_normals_far_from_geometric_ones(tmp_path, material):
    box = closed_box(lamp_behind_the_camera(), 16)
    box["ball"] = {"type": "ply", "filename": coarse_ball(tmp_path), "bsdf": MATERIALS[material]()}
    assert_image_of_path(box, finds=0.045, max_depth=5)


@pytest.mark.stress
def test_instances(tmp_path):
    box = closed_box(lamp_behind_the_camera(), 16)
    ball = {"type": "ply", "filename": coarse_ball(tmp_path), "bsdf": {"type": "twosided", "of": {"type": "diffuse"}}}
    box["group"] = {"type": "shapegroup", "ball": ball}
    for number, x in enumerate((-0.5, 0.5)):
        transform = mi.ScalarTransform4f().translate([x, -0.4, -0.2]).scale([0.5, 0.9, 0.5])
        box[f"instance{number}"] = {"type": "instance", "of": {"type": "ref", "id": "group"}, "to_world": transform}
    assert_image_of_path(box, max_depth=5)


@not_on_cuda("OptiX finds hits on a plane of ten thousand units to within 0.002 units")
@pytest.mark.parametrize("light", ["sun", *stress("lamp", "envmap")])
def test_a_room_on_a_plane_ten_thousand_times_its_size(light):
    emitters = {
        "lamp": lamp_behind_the_camera,
        "sun": lambda: {"sun": {"type": "directional", "direction": [0.8, -0.6, 0.1], "irradiance": rgb(3.0)}},
        "envmap": EMITTERS["envmap"],
    }[light]()
    box = closed_box(emitters, 16)
    del box["left"]
    # Mitsuba 3.9.1 leaves rectangles of equal materials out of the scene's box, beyond which its shadow rays do not
    # reach: not a rectangle
    flat = mi.ScalarTransform4f().translate([0, -1.02, 0]).scale([1e4, 0.01, 1e4])
    box["ground"] = {"type": "cube", "to_world": flat, "bsdf": {"type": "diffuse"}}
    assert_image_of_path(box, max_depth=5)


def test_a_room_lit_through_a_window():
    box = closed_box(EMITTERS["envmap"](), 16)
    del box["left"]
    for number, y in enumerate((-0.6, 0.6)):
        transform = mi.ScalarTransform4f().translate([-1, y, 0]).rotate([0, 1, 0], 90).scale([1, 0.4, 1])
        box[f"wall{number}"] = {"type": "rectangle", "to_world": transform, "bsdf": {"type": "diffuse"}}
    # Beyond the scene's box, which is small without this cube, shadow rays of `path` do not reach (decisions.md)
    hidden = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([60, 0, 0]).scale(0.01)}
    assert_image_of_path(box, finds=0.03, of=box | {"hidden": hidden}, max_depth=6)


@pytest.mark.stress
@pytest.mark.parametrize("scale", [1e4, *stress(1e-2)])
def test_units_of_length_do_not_matter(scale):
    box = closed_box({"light": area_light(scale)}, 16, scale=scale)
    assert_image_of_path(box, max_depth=5)


# ---------------------- Emitters that are not seen, alpha ----------------------


@pytest.mark.stress
@pytest.mark.parametrize("max_depth", [5, *stress(2)])
def test_an_emitter_between_camera_and_room_is_looked_through(max_depth):
    transform = mi.ScalarTransform4f().translate([0, 0, 0.3]).scale(0.3)
    box = closed_box(bulb(), 16)
    box["light"] = {
        "type": "rectangle", "to_world": transform, "emitter": {"type": "area", "radiance": rgb(4.0)}
    }  # fmt: skip
    assert_image_of_path(box, finds=0.03, lights=max_depth > 2, max_depth=max_depth, hide_emitters=True)


@pytest.mark.parametrize(
    ("max_depth", "hide_emitters"),
    [(0, True), (4, True), (4, False), *stress((0, False), *itertools.product((1, 2), (False, True)))],
)
@pytest.mark.parametrize("emitter", ["envmap", *stress("rectangle")])
def test_alpha_is_that_of_path(emitter, max_depth, hide_emitters):
    description = stage(EMITTERS[emitter](), one_of(MATERIALS["mask"]()), 16)
    del description["back"]
    description["sensor"]["film"]["pixel_format"] = "rgba"
    scene, more = mi.load_dict(description), {"max_depth": max_depth, "hide_emitters": hide_emitters}
    found, expected = (render(scene, name, 256, **more)[..., 3] for name in ("manylights", "path"))
    assert np.abs(found - expected).max() < 0.2
    assert abs(found.mean() - expected.mean()) < 0.01


def test_a_screen_before_a_wall_that_nothing_lights():
    """All light is seen directly, so nothing tells how bright the other light is."""
    screen = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]).scale(0.2)}
    screen |= {"emitter": {"type": "area", "radiance": rgb(4.0)}}
    box = closed_box({"screen": screen}, 16)
    for side in ("floor", "ceiling", "left", "right", "front"):
        del box[side]
    found, expected = (render(mi.load_dict(box), name, 64, max_depth=5) for name in ("manylights", "path"))
    assert abs(found.mean() / expected.mean() - 1) < 0.02


# ---------------------- Films, sensors, wrappers ----------------------

FILTERS = {
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "lanczos": {"rfilter": {"type": "lanczos"}, "crop_offset_x": 4, "crop_offset_y": 6, "crop_width": 16,
                "crop_height": 16},
}  # fmt: skip


@pytest.mark.stress
@pytest.mark.parametrize("options", ["gaussian", *stress("lanczos")])
def test_filters(options):
    box = closed_box(lamp_behind_the_camera(), 32)
    box["sensor"]["film"] |= FILTERS[options]
    assert_image_of_path(box, max_depth=4)


QUICK_SENSORS = ("thinlens",)


@pytest.mark.parametrize("kind", [*QUICK_SENSORS, *stress(*(name for name in SENSORS if name not in QUICK_SENSORS))])
def test_sensors(kind):
    size = (1, 1) if kind in ONE_PIXEL else (16, 16)
    objects = one_of(MATERIALS["roughplastic"]())
    scene = mi.load_dict(stage(EMITTERS["rectangle"](), objects, 16) | {"sensor": SENSORS[kind](film(*size))})
    spp = 4096 if kind in ONE_PIXEL else 256

    def pair(seed):
        found = render(scene, "manylights", spp, seed, max_depth=4, stratified=True)
        return found, render(scene, "path", spp, seed, max_depth=4)

    assert_same_mean(pair, 8, 0.02, tiles=1 if kind in ONE_PIXEL else 4)


def test_surfaces_beyond_the_far_plane_of_the_camera_are_not_seen():
    """But they reflect light."""
    box = closed_box(lamp_behind_the_camera(), 16)
    box["sensor"]["far_clip"] = 1.5
    assert (render(mi.load_dict(box), "manylights", 4)[8, 8] == 0).all()
    assert_image_of_path(box, max_depth=4)


@pytest.mark.parametrize("wrapper", ["moment", "aov"])
def test_inside_of_other_integrators(wrapper):
    scene = mi.load_dict(closed_box({"light": area_light()}, 16))
    nested = {"type": "manylights", "max_depth": 4}
    more = {"aovs": "depth:depth"} if wrapper == "aov" else {}
    found = render(scene, mi.load_dict({"type": wrapper, "image": nested, **more}), 64)
    alone = render(scene, mi.load_dict(nested), 64)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[..., :3].mean((0, 1)), alone.mean((0, 1)), rtol=0.05)


@pytest.mark.usefixtures("restore_variant")
def test_monochrome():
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(closed_box(lamp_behind_the_camera(), 16))

    def pair(seed):
        return tuple(render(scene, name, 256, seed, max_depth=5) for name in ("manylights", "path"))

    assert_same_mean(pair, 8, 0.02)


# ---------------------- Edges ----------------------


@pytest.mark.parametrize("emitters", ["none", "lamp"])
@pytest.mark.parametrize("surfaces", [False, True])
def test_scenes_with_next_to_nothing(surfaces, emitters):
    objects = {"wall": wall([0, 0, 0], [0, 1, 0], 0)} if surfaces else {}
    lamp = {"lamp": area_light()} if emitters == "lamp" else {}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(8), **objects, **lamp})
    found = render(scene, "manylights", 4, max_depth=4)
    assert np.isfinite(found).all()
    assert (found.max() > 0) == (render(scene, "path", 4, max_depth=4).max() > 0)


@pytest.mark.parametrize("max_depth", [0, 3, *stress(1, 2)])
@pytest.mark.parametrize(("size", "spp"), [(1, 1), (7, 1), *stress((1, 64), (2, 3))])
def test_few_pixels_and_samples(size, spp, max_depth):
    scene = mi.load_dict(closed_box({"light": area_light()}, size))
    found = render(scene, "manylights", spp, max_depth=max_depth)
    assert found.shape == (size, size, 3) and np.isfinite(found).all()
    if max_depth < 2:
        np.testing.assert_allclose(found, render(scene, "path", spp, max_depth=max_depth), atol=1e-6)


def test_images_of_several_parts_have_the_mean_of_path(monkeypatch):
    """Of 34, 34 and 32 pixels."""
    monkeypatch.setattr("vpl.split.estimator._WAVEFRONT", (4300, 4300))
    assert_image_of_path(closed_box({"light": area_light()}, 10), max_depth=4)


def test_the_same_seed_gives_the_same_image():
    scene = mi.load_dict(closed_box({"light": area_light()}, 16))
    first, second, other = (render(scene, "manylights", 16, seed, max_depth=4) for seed in (1, 1, 2))
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-6)
    assert np.abs(first - other).mean() > 1e-4
