"""Minorants and lobes of surfaces with bump and normal maps, and the directions of paths there."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.scenes import image, rgb
from vpl.core.arrays import download
from vpl.core.materials import Materials
from vpl.core.sampling import independent_sampler
from vpl.split.covered import _of_mixture
from vpl.transport.minorant import Lobe, Minorants

COUNT = 1 << 16
GREY = {"type": "diffuse", "reflectance": rgb(0.6, 0.3, 0.1)}
PLAIN = {"flip_invalid_normals": False, "use_shadowing_function": False}


def tilted(angle, azimuth=0.0, nested=GREY, **more):
    """A material with the same perturbed normal everywhere: ``angle`` and ``azimuth`` in degrees."""
    angle, azimuth = np.radians(angle), np.radians(azimuth)
    normal = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    colours = image(np.tile(0.5 + 0.5 * normal, (2, 2, 1)))
    return {"type": "normalmap", "normalmap": colours, "nested": nested, **more}, normal


def at(material, side=1.0, count=1):
    """(Material, its minorants, surfaces, F, lobes) on one side of the plane z = 0."""
    bsdf, si = mi.load_dict(material), dr.zeros(mi.SurfaceInteraction3f, count)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi, si.uv = mi.Vector3f(0.1, 0.2, side * 0.9), mi.Point2f(0.5)
    minorants = Minorants(Materials([bsdf]))
    return bsdf, minorants, si, *minorants.at(si, mi.BSDFPtr(bsdf), mi.Float(side), mi.Bool(True))


@pytest.mark.parametrize("angle", [0, 10, 30, 44])
@pytest.mark.parametrize("azimuth", [0, 50, 200])
@pytest.mark.parametrize("side", [1, -1])
def test_a_map_over_a_diffuse_surface_has_the_lobe_of_that_surface(angle, azimuth, side):
    material, normal = tilted(angle, azimuth, **PLAIN)
    _, minorants, _, value, lobe = at({"type": "twosided", "nested": material}, side)
    assert minorants.perturbed is not None
    np.testing.assert_allclose(download(value)[0], np.array([0.6, 0.3, 0.1]) / np.pi, rtol=2e-2)
    np.testing.assert_allclose(download(lobe.normal)[0], normal * [1, 1, side], atol=1e-2)
    assert download(lobe.outward)[0].tolist() == [0, 0, side]


@pytest.mark.parametrize("angle", [50, 60, 75])
@pytest.mark.parametrize("azimuth", [0, 20])
@pytest.mark.parametrize("more", [{}, PLAIN], ids=["flipped", "plain"])
def test_a_normal_far_from_the_surface_has_no_minorant(angle, azimuth, more):
    """The axis is then the shading normal."""
    *_, value, lobe = at(tilted(angle, azimuth, **more)[0])
    assert not download(value).any() and download(lobe.normal)[0].tolist() == [0, 0, 1]


@pytest.mark.parametrize("nested", ["diffuse", "plastic", "roughplastic", "principled"])
def test_surfaces_with_maps_have_a_minorant(nested):
    *_, value, lobe = at(tilted(20, 30, {"type": nested})[0])
    assert (download(value) > 0.1 / np.pi).all()
    np.testing.assert_allclose(download(lobe.normal)[0], tilted(20, 30)[1], atol=0.1)


@pytest.mark.parametrize("kind", ["mask", "blendbsdf"])
def test_blends_and_masks_of_maps_have_none(kind):
    nested, _ = tilted(20)
    parts = {"opacity": 0.5, "a": nested} if kind == "mask" else {"weight": 0.5, "a": nested, "b": GREY}
    _, minorants, _, value, _ = at({"type": kind, **parts})
    assert minorants.perturbed is None and not download(value).any()


def test_a_lobe_ends_at_the_surface_and_behind_its_axis():
    axis = mi.Normal3f(dr.normalize(mi.Vector3f(1, 0, 1)))
    directions = [[0, 0, 1], [1, 0, 1], [1, 0, -0.1], [-1, 0, 0.5], [0, 1, 0.01]]
    direction = dr.normalize(mi.Vector3f(np.array(directions, np.float32).T))
    expected = np.array(download(dr.dot(axis, direction)))
    expected[[2, 3]] = 0
    np.testing.assert_allclose(download(Lobe(axis, mi.Normal3f(0, 0, 1)).cosine(direction)), expected, atol=1e-6)


@pytest.mark.parametrize("nested", ["diffuse", "plastic", "roughplastic"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6])
def test_directions_have_the_density_of_the_mixture(nested, share):
    """Of one sample: BSDF and lobe integrate to the values of uniform directions, by one density."""
    material, _ = tilted(30, 70, {"type": nested})
    bsdf, minorants, si, minorant, lobe = at(material, count=COUNT)
    known = dr.max(minorant)
    sampler, axis = independent_sampler(0, COUNT), si.to_local(lobe.normal)
    part, every = mi.Float(share), mi.Bool(True)

    def sampled(toward, number):
        return _of_mixture(
            minorants.perturbed, bsdf, si, toward, number, sampler.next_2d(), part + dr.zeros(mi.Float, COUNT), axis,
            every,
        )  # fmt: skip

    assert dr.all(known > 0)
    _, _, sample, weight = sampled(mi.Vector3f(0, 0, 1), sampler.next_1d())
    value, density, _, _ = sampled(sample.wo, sampler.next_1d())
    delta = download(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta))
    drawn = ~delta & (download(sample.pdf) > 0)
    assert delta.any() == (nested == "plastic")
    np.testing.assert_allclose(download(sample.pdf)[drawn], download(density)[drawn], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        (download(weight) * download(sample.pdf)[:, None])[drawn], download(value)[drawn], rtol=1e-3, atol=1e-5
    )
    uniform = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
    value, density, _, _ = sampled(uniform, sampler.next_1d())
    expected = [2 * np.pi * download(x) for x in (value.x, lobe.cosine(uniform))]
    over = np.where(drawn, 1 / np.maximum(download(sample.pdf), 1e-9), 0)
    found = [np.where(drawn, download(weight.x), 0), download(lobe.cosine(sample.wo)) * over]
    # Samples of the BSDF alone do not reach the whole lobe of gloss or of a normal map
    for a, b in list(zip(found, expected, strict=True))[: 2 if share else 1]:
        error = np.hypot(a.std(), b.std()) / COUNT**0.5
        assert abs(a.mean() - b.mean()) < 4.5 * error
