"""Loops of kernels are recorded once: where there are many shapes and materials, that takes longer than rendering."""

import drjit as dr
import mitsuba as mi
import pytest

from tests.support.calls import calls_of
from tests.support.rendering import render
from tests.support.scenes import area_light, closed_box, rgb
from vpl.direct import cluster_sampling, emitter_sampling
from vpl.lights.emitters import read_emitters
from vpl.split.line_hits import hits_of
from vpl.split.line_sampling import Lines


@pytest.mark.parametrize(
    ("plugin", "more", "module", "name", "kernels"),
    [
        ("lightcuts", {"vpl_count": 100}, emitter_sampling, "_scattered_emission", 1),
        # A pilot, and a pass
        ("adaptivedirect", {"max_passes": 1}, cluster_sampling, "_emitter_sample", 2),
    ],
)
def test_bodies_of_loops_are_recorded_once_in_a_kernel(plugin, more, module, name, kernels, monkeypatch):
    calls = calls_of(monkeypatch, module, name)
    render(mi.load_dict(closed_box({"lamp": area_light()}, 8)), plugin, 1, max_depth=3, **more)
    assert len(calls) == kernels


def test_surfaces_along_lines_are_looked_for_once_in_a_kernel():
    """A kernel counts the surfaces, and a kernel finds them."""
    scene = mi.load_dict(closed_box({"lamp": area_light()}, 8))
    calls = []

    class Counted:
        def __getattr__(self, name):
            return getattr(scene, name)

        def ray_intersect(self, *arguments, **more):
            calls.append(1)
            return scene.ray_intersect(*arguments, **more)

    origin, direction = dr.repeat(mi.Point3f(0.1, 0.2, -9), 10), dr.repeat(mi.Vector3f(0, 0, 1), 10)
    low, size = (dr.repeat(mi.Vector3d(x), 10) for x in (-10, 20))
    lines = Lines(origin, direction, dr.repeat(mi.Float(20), 10), low, size)
    assert hits_of(Counted(), lines, 20.0, 0).count == 20
    assert len(calls) == 2


def test_a_few_emitters_among_many_shapes_are_called_alone():
    """A call by pointers is recorded for every shape of the scene."""
    balls = {f"ball{k}": {"type": "sphere", "center": [0.1 * k - 0.5, 0, 0], "radius": 0.04} for k in range(10)}
    few, glow = closed_box({"lamp": area_light()}, 8), {"type": "area", "radiance": rgb(1.0)}
    many = {name: ball | {"emitter": glow} for name, ball in balls.items()}
    of_few, of_many = (read_emitters(mi.load_dict({**few, **shapes})).area for shapes in (balls, many))
    assert len(of_few.shapes) == 1 and of_few.area == pytest.approx(0.36)
    assert of_many.shapes is None and of_many.count == 11
