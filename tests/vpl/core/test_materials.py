"""Calls of materials: as by pointers, and without the code of materials that no surface has."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.catalogue import EMITTERS, MATERIALS, all_materials, one_of, stage
from vpl.core.materials import Materials
from vpl.core.shapes import SceneShapes


def rays(count=4096, width=3.0):
    """Rays from a camera towards a wall of objects."""
    rng = np.random.default_rng(3)
    target = mi.Point3f(*np.float32(rng.uniform(-width, width, (2, count))), 0)
    return mi.Ray3f(mi.Point3f(0, 0, 4), dr.normalize(target - mi.Point3f(0, 0, 4)))


def value(bsdf, si, out, active):
    """Value of a material for a light from the side of the viewer."""
    return bsdf.eval(mi.BSDFContext(), si, out, active)


def called(materials, si, active=True):
    return np.array(materials.call(si.bsdf(), value, si, si.wi, active=mi.Bool(active)))


def by_pointer(si, active=True):
    return np.array(value(si.bsdf(), si, si.wi, mi.Bool(active)))


def materials_of(scene):
    return Materials.of(SceneShapes.of(scene))


def box_of(material):
    return mi.load_dict(stage(EMITTERS["point"](), one_of(material)))


@pytest.fixture
def every_material():
    return mi.load_dict(stage(EMITTERS["point"](), all_materials()))


def test_values_are_those_of_calls_by_pointers(every_material):
    si = every_material.ray_intersect(rays())
    assert not si.is_valid().numpy().all()
    expected, asked = by_pointer(si), np.arange(4096) % 3 > 0
    assert np.count_nonzero(expected.any(0)) > 500
    np.testing.assert_array_equal(called(materials_of(every_material), si), expected)
    np.testing.assert_array_equal(called(materials_of(every_material), si, asked), np.where(asked, expected, 0))


def test_samples_are_those_of_calls_by_pointers(every_material):
    def sampled(bsdf, si, active):
        return bsdf.sample(mi.BSDFContext(), si, 0.3, mi.Point2f(0.2, 0.6), active)

    si = every_material.ray_intersect(rays())
    sample, weight = materials_of(every_material).call(si.bsdf(), sampled, si, active=mi.Bool(True))
    expected, expected_weight = sampled(si.bsdf(), si, mi.Bool(True))
    np.testing.assert_array_equal(np.array(weight), np.array(expected_weight))
    for name in ("wo", "pdf", "eta", "sampled_type"):
        np.testing.assert_array_equal(np.array(getattr(sample, name)), np.array(getattr(expected, name)))


def test_shapes_of_groups_have_materials():
    group = {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": MATERIALS["roughplastic"]()}}
    instance = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", "group": group, "instance": instance})
    si = scene.ray_intersect(rays(width=0.5))
    assert (by_pointer(si) > 0).all()
    np.testing.assert_array_equal(called(materials_of(scene), si), by_pointer(si))


def test_materials_of_other_scenes_and_without_the_kind_of_lobe_give_0(every_material):
    si = every_material.ray_intersect(rays())
    assert not called(materials_of(box_of(MATERIALS["diffuse"]())), si).any()
    diffuse = materials_of(every_material).having(mi.BSDFFlags.DiffuseReflection)
    has_lobe = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DiffuseReflection).numpy()
    assert 0 < has_lobe.sum() < len(has_lobe)
    np.testing.assert_array_equal(called(diffuse, si), np.where(has_lobe, by_pointer(si), 0))


def test_a_scene_without_surfaces_gives_0():
    scene = mi.load_dict({"type": "scene"})
    si = scene.ray_intersect(rays(64))
    assert not called(materials_of(scene), si).any()


def operations(call, si):
    """Length of the longest kernel that ``call`` needs."""
    dr.eval(si)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(call(si))
        return max(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))


def test_kernels_do_not_hold_the_code_of_materials_that_no_surface_has():
    scene = box_of({"type": "twosided", "nested": MATERIALS["roughplastic"]()})
    materials, si = materials_of(scene), scene.ray_intersect(rays())

    def by_materials(si):
        return materials.call(si.bsdf(), value, si, si.wi, active=mi.Bool(True))

    alone = operations(by_materials, si)
    assert alone < 0.75 * operations(lambda si: value(si.bsdf(), si, si.wi, mi.Bool(True)), si)
    other = mi.load_dict(stage(EMITTERS["point"](), all_materials()))
    assert operations(by_materials, si) == alone
    del other
