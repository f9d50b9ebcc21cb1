"""Fixtures shared by all tests: the variant, and small scenes built from dictionaries."""

import os
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from comparison.scene_files import SceneFile
from vpl.split import balance

VARIANT = "llvm_ad_rgb"
CORNELL = str(Path(__file__).resolve().parent.parent / "scenes" / "cornell.xml")
# Of a t test, below which means are not the same
LEAST_P = 0.01
SWEEP = [
    CORNELL, "-i", "path,lightcuts,vpl", "--width", "24", "--max-depth", "3", "--sweep", "path:spp=1,8", "--sweep",
    "lightcuts:error=0.4,0.1", "--sweep", "vpl:vpl_count=2000", "-p", "lightcuts.vpl_count=2000", "--seeds", "2",
    "--reference", "path:auto:0.9", "--spp", "1",
]  # fmt: skip


def examples(usual: int, most: int = 10_000) -> int:
    """How many random examples a test of a property takes: a few, or as many as the stress run asks for."""
    return min(max(usual, int(os.environ.get("MANYLIGHTS_EXAMPLES", "0"))), most)


@pytest.fixture(scope="session", autouse=True)
def variant():
    """Every test starts in the same variant, with the plugins registered."""
    mi.set_variant(VARIANT)
    import integrators  # noqa: F401

    return VARIANT


@pytest.fixture(scope="session")
def threads():
    """The number of threads that tests start with."""
    return dr.thread_count()


@pytest.fixture(autouse=True)
def restore_threads(threads):
    """A command keeps to the threads that it was given, and so would all later tests: with one, Mitsuba waits for ever
    when it reads EXR files."""
    yield
    dr.set_thread_count(threads)


@pytest.fixture
def restore_variant():
    """For tests that change the variant."""
    yield
    mi.set_variant(VARIANT)


@pytest.fixture(scope="session")
def swept(tmp_path_factory, variant):
    """The output folder of compare.py for `SWEEP`."""
    import compare

    out = tmp_path_factory.mktemp("sweep")
    assert compare.main([*SWEEP, "-o", str(out), "--cache", str(out / "cache")]) == 0
    return out


@pytest.fixture
def lights_cost_nothing(monkeypatch):
    """So that ``manylights`` has virtual lights wherever there is any use for them."""
    monkeypatch.setattr(balance, "_PAYS_BELOW", 1e30)
    monkeypatch.setattr(balance, "_FEWEST", 4000)


def cornell(width=16, **defines):
    """The Cornell box as a scene file."""
    file = SceneFile(CORNELL, defines)
    file.set_width(width)
    return file


def sensor(size=32, spp=4, **more):
    """A camera on the z axis that looks at the origin from a distance of 4; box filter."""
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": spp},
        **more,
    }


def wall(translate, rotate_axis, angle, scale=1.0, reflectance=(0.5, 0.5, 0.5), bsdf=None):
    """A square wall of half-size ``scale``."""
    transform = mi.ScalarTransform4f().translate(translate).rotate(rotate_axis, angle).scale(scale)
    material = bsdf or {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance)}}
    return {"type": "rectangle", "to_world": transform, "bsdf": material}


def closed_box(emitters, size=32, spp=4, scale=1.0, **more):
    """A closed diffuse box of side 2 (times ``scale``), seen from inside; ``emitters``: dictionary of plugins."""
    camera = sensor(size, spp, fov=95)
    camera["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 0.95 * scale], [0, 0, 0], [0, 1, 0])
    camera |= {"near_clip": 1e-3 * scale, "far_clip": 1e3 * scale}
    s = scale
    return {
        "type": "scene",
        "sensor": camera,
        "floor": wall([0, -s, 0], [1, 0, 0], -90, s),
        "ceiling": wall([0, s, 0], [1, 0, 0], 90, s),
        "left": wall([-s, 0, 0], [0, 1, 0], 90, s, (0.6, 0.1, 0.1)),
        "right": wall([s, 0, 0], [0, 1, 0], -90, s, (0.1, 0.5, 0.1)),
        "back": wall([0, 0, -s], [0, 1, 0], 0, s),
        "front": wall([0, 0, s], [0, 1, 0], 180, s),
        **emitters,
        **more,
    }


def area_light(scale=1.0, radiance=(4.0, 4.0, 4.0)):
    """A small square area emitter below the ceiling of the closed box."""
    transform = mi.ScalarTransform4f().translate([0, 0.9 * scale, 0]).rotate([1, 0, 0], 90).scale(0.3 * scale)
    radiance = {"type": "rgb", "value": list(radiance)}
    return {"type": "rectangle", "to_world": transform, "emitter": {"type": "area", "radiance": radiance}}


def render(scene, integrator, spp=4, seed=0, **more):
    """Render to NumPy, (height, width, channels) float64."""
    plugin = mi.load_dict({"type": integrator, **more}) if isinstance(integrator, str) else integrator
    return np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)


def render_with_statistics(name, scene, spp=1, seed=0, **more):
    """An image by the plugin of a name, and the statistics of its render."""
    plugin = mi.load_dict({"type": name, **more})
    return render(scene, plugin, spp, seed), plugin.statistics


def unit_vectors(rng, count):
    """Directions all around, (count, 3) float32."""
    vectors = rng.normal(size=(count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def relative_error(image, expected):
    """Sum of absolute differences over the sum of what is expected."""
    return np.abs(image - expected).sum() / expected.sum()


def same_mean_over_seeds(pairs, tiles=4):
    """The p value of a t test, Šidák-corrected, on the differences of paired images, (ours, expected), a pair a seed.

    Of the means over tiles and over the image, which are where bias shows.
    """
    excess = []
    for found, every in pairs:
        size = found.shape[0] // tiles
        blocks = (found - every)[: size * tiles, : size * tiles].reshape(tiles, size, tiles, size, 3)
        excess.append(np.append(blocks.mean((1, 3)).reshape(-1), (found - every).mean((0, 1))))
    excess = np.array(excess)
    noisy = excess.std(0) > 1e-6 * np.abs(every).mean()
    assert noisy[-3:].all()
    p_values = stats.ttest_1samp(excess[:, noisy], 0).pvalue
    return 1 - (1 - p_values.min()) ** noisy.sum()


def assert_same_mean_over_seeds(pairs, tiles=4):
    """See :func:`same_mean_over_seeds`."""
    assert same_mean_over_seeds(pairs, tiles) > LEAST_P


def assert_property_is_refused(plugin, name, value):
    """With an error that names the property and the value."""
    with pytest.raises((ValueError, RuntimeError)) as error:
        mi.load_dict({"type": plugin, name: value})
    assert f'property "{name}" must be' in str(error.value) and f"got {value!r}" in str(error.value)


def assert_properties_are_shown(plugin, given):
    """With their values, in what the plugin prints as."""
    text = str(mi.load_dict({"type": plugin, **given}))
    assert all(f"{name} = {value}" in text for name, value in given.items())
