"""Layers of ``manylights``: by length of path and by group of emitters; they sum to the image, each without bias."""

import mitsuba as mi
import numpy as np
import pytest

from tests.support.many_emitters import bulbs, panels
from tests.support.rendering import render, render_with_statistics
from tests.support.scenes import area_light, closed_box, rgb, sensor, wall
from tests.support.statistics import assert_same_mean

LENGTHS = "emission,direct,indirect"


def open_room():
    """A box without its front, below a sky, with lamps of a colour each: emitters of every sampler of few emitters."""
    lamps = {
        "red_lamp": area_light(0.9, (6.0, 0.5, 0.5)),
        "blue_bulb": {"type": "point", "position": [0.4, -0.3, 0.2], "intensity": rgb(0.1, 0.2, 0.8)},
        "sky": {"type": "constant", "radiance": rgb(0.2, 0.4, 0.2)},
    }
    room = closed_box(lamps, 16)
    del room["front"]
    room["sensor"] = sensor(16, fov=30)
    return room


def crowded_room():
    """A white box with 80 emitters of two groups, a directional emitter that gets in through a gap, and a sky."""
    rng = np.random.default_rng(2)
    room = closed_box(panels(40, rng) | bulbs(40, rng), 16)
    for name in ("floor", "ceiling", "left", "right", "back"):
        room[name]["bsdf"]["reflectance"] = rgb(0.9)
    for name in room:
        if name.startswith("bulb"):
            room[name]["intensity"] = rgb(0.1, 0.3, 0.02)
    room["sun"] = {"type": "directional", "direction": [0, -0.6, -1], "irradiance": rgb(8.0, 6.0, 2.0)}
    room["sky"] = {"type": "constant", "radiance": rgb(0.5, 0.5, 2.0)}
    room["front"] = wall([0, -0.5, 1], [0, 1, 0], 180, 0.9)
    return room


def one_lamp():
    """A closed box with a single emitter."""
    return closed_box({"lamp": area_light()}, 16)


def _shines(plugin):
    return "emitter" in plugin or plugin["type"] in ("point", "directional", "constant")


def layers_of(scene, spp, seed, **more):
    """(Image, layer by name, statistics) of a render."""
    planes, statistics = render_with_statistics("manylights", scene, spp, seed, **more)
    assert statistics["dropped"] == 0
    names = mi.load_dict({"type": "manylights"} | more).aov_names()
    assert planes.shape[2] == 3 + len(names)
    found = {}
    for number, channel in enumerate(names):
        found.setdefault(channel.split(".")[0], []).append(planes[..., 3 + number])
    return planes[..., :3], {layer: np.stack(channels, -1) for layer, channels in found.items()}, statistics


ROOMS = {
    "few emitters": (open_room, "warm=red*; points=blue_bulb"),
    "many emitters": (crowded_room, "areas=panel*; bulbs=bulb*; sun=DirectionalEmitter"),
    "one emitter": (one_lamp, "lamp=lamp"),
}


@pytest.mark.parametrize("lights", [True, False])
@pytest.mark.parametrize("room", ROOMS)
def test_layers_sum_to_the_image(room, lights, request):
    if lights:
        request.getfixturevalue("lights_cost_nothing")
    describe, groups = ROOMS[room]
    scene = mi.load_dict(describe())
    asked = {"layers": LENGTHS, "light_groups": groups, "max_depth": 5, "virtual_lights": lights}
    image, layers, statistics = layers_of(scene, 16, 3, **asked)
    assert ("lights" in statistics) == lights, statistics["plan"]
    by_length = sum(layers[name] for name in LENGTHS.split(","))
    by_group = sum(layer for name, layer in layers.items() if name not in LENGTHS)
    scale = np.abs(image).max()
    assert np.abs(by_length - image).max() < 1e-5 * scale
    assert np.abs(by_group - image).max() < 1e-5 * scale
    assert np.abs(layers["other"]).max() == 0 or room != "one emitter"
    # The image is that of a render without layers, to rounding in another order
    plain = render(scene, "manylights", 16, 3, max_depth=5, virtual_lights=lights)
    if room != "many emitters":
        assert np.abs(plain - image).max() < 1e-4 * scale


def only(description, kept):
    """The scene with its emitters in ``kept``; the shapes of the others stay, black."""
    scene = {}
    for name, plugin in description.items():
        if name in kept or not isinstance(plugin, dict) or not _shines(plugin):
            scene[name] = plugin
        elif "emitter" in plugin:
            scene[name] = plugin | {"emitter": {"type": "area", "radiance": rgb(0.0)}}
    return scene


@pytest.mark.usefixtures("lights_cost_nothing")
@pytest.mark.parametrize("group", ["warm", "points", "other", "areas", "bulbs", "sun", "other of many"])
def test_a_group_is_the_image_of_its_emitters(group):
    members = {
        "warm": ["red_lamp"], "points": ["blue_bulb"], "other": ["sky"], "sun": ["sun"], "other of many": ["sky"],
        "areas": [f"panel{k}" for k in range(40)], "bulbs": [f"bulb{k}" for k in range(40)],
    }[group]  # fmt: skip
    describe, groups = ROOMS["few emitters" if group in ("warm", "points", "other") else "many emitters"]
    description = describe()
    scene, reference = mi.load_dict(description), mi.load_dict(only(description, members))

    def pair(seed):
        asked = {"light_groups": groups, "max_depth": 4}
        _, layers, statistics = layers_of(scene, 256, seed, **asked)
        assert statistics["light_paths"] > 0
        assert ("emitters" in statistics["lights"]) == ("panel0" in description)
        return layers[group.split()[0]], render(reference, "path", 256, seed, max_depth=4)

    assert_same_mean(pair, 8, 0.06)


@pytest.mark.usefixtures("lights_cost_nothing")
@pytest.mark.parametrize(("layer", "first", "last"), [("emission", 0, 1), ("direct", 1, 2), ("indirect", 2, 5)])
@pytest.mark.parametrize("describe", [open_room, crowded_room])
def test_a_length_is_a_difference_of_depths(describe, layer, first, last):
    scene = mi.load_dict(describe())

    def pair(seed):
        _, layers, _ = layers_of(scene, 64, seed, layers=LENGTHS, max_depth=5)
        longer, shorter = (render(scene, "path", 64, seed, max_depth=depth) for depth in (last, first))
        return layers[layer], longer - shorter

    assert_same_mean(pair, 8, 0.06)


def test_only_requested_channels():
    assert mi.load_dict({"type": "manylights"}).aov_names() == []
    one = mi.load_dict({"type": "manylights", "layers": "direct", "light_groups": "key=lamp"})
    assert [name for name in one.aov_names() if name.endswith(".R")] == ["direct.R", "key.R", "other.R"]


@pytest.mark.usefixtures("restore_variant")
def test_one_channel_in_mono_variants():
    mi.set_variant("llvm_mono") if "llvm_mono" in mi.variants() else pytest.skip("no variant llvm_mono")
    import integrators  # noqa: F401

    assert mi.load_dict({"type": "manylights", "layers": "direct"}).aov_names() == ["direct.Y"]


@pytest.mark.parametrize(
    "value", ["lamp", "a=", "=lamp", "a=x;a=y", "other=x", "direct=x", "R=x", "a b=x", "a=x,,y", "a=x;"]
)
def test_groups_that_are_refused(value):
    with pytest.raises(RuntimeError, match='property "light_groups" must be groups such as'):
        mi.load_dict({"type": "manylights", "light_groups": value})


def test_a_pattern_without_an_emitter_is_refused():
    scene = mi.load_dict(one_lamp())
    integrator = mi.load_dict({"type": "manylights", "light_groups": "a=lmap"})
    with pytest.raises(RuntimeError) as error:
        render(scene, integrator)
    said = 'light_groups: no emitter of the group "a" is called "lmap"; emitters are called "AreaLight", '
    assert said in str(error.value.__cause__) and '"lamp"' in str(error.value.__cause__)


def test_a_sensor_with_a_weight_is_refused():
    room = closed_box({"lamp": area_light()}, 8)
    room["sensor"] = {"type": "irradiancemeter", "film": {"type": "hdrfilm", "width": 1, "height": 1}}
    room["meter"] = wall([0, 0, 0], [0, 1, 0], 0, 0.2) | {"sensor": room.pop("sensor")}
    scene = mi.load_dict(room)
    render(scene, "manylights", 4)
    with pytest.raises(RuntimeError) as error:
        render(scene, "manylights", 4, layers="direct")
    assert "need a sensor whose rays have the weight 1" in str(error.value.__cause__)
