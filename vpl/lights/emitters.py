"""Emitters of a scene in flat arrays, so that no kernel calls emitter pointers.

A virtual call on emitter pointers makes Dr.Jit trace every emitter instance of the process: a minute of compilation
for some thousands of lights.  Here point, spot, directional and area emitters become rows of arrays.  Environment maps,
projectors, and spot emitters with a texture or an oval cone keep their objects, which kernels call one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import LARGEST_VALUE, download, finite_or_zero, rgb_to_spectrum, upload, usable
from ..core.parameters import constant_rgb, parameters_of
from ..core.registry import RegistryTable
from ..core.sampling import independent_sampler
from ..core.shapes import registered_shapes
from .spheres import SphereRows
from .unbound_emitters import lights_nothing, read_unbound
from .virtual_lights import VirtualLights

# Shapes, besides meshes, that Mitsuba can sample by area (curves, for example, cannot)
SAMPLED_SHAPES = ("Rectangle", "Disk", "Sphere", "Cylinder")
# Time to record a call of one shape object, in calls of one shape by pointer
_SHAPES_BY_POINTER = 4
# Least and largest number of samples of a textured emitter along each axis: as many as texels, up to a million in all
_GRID = 64, 1024


@dataclass
class AreaEmitters:
    """Area emitters as n rows.

    ``shape_index`` (n,) uint32: registry index of the shape; ``radiance`` (n, 3) float32: RGB, of textured emitters the
    mean; ``area`` (n,) float32, world units squared; ``group`` (n,) uint32, see :func:`read_emitters`; ``textured``:
    (row, emitter object) of textured emitters; ``shapes``: the n shape objects, or None if kernels may call shape
    pointers, see :meth:`on_shape`; ``spheres``: None if no shape is a sphere.
    """

    shape_index: np.ndarray
    radiance: np.ndarray
    area: np.ndarray
    group: np.ndarray
    textured: list[tuple[int, mi.Emitter]] = field(default_factory=list)
    shapes: list[mi.Shape] | None = None
    spheres: SphereRows | None = None

    @property
    def count(self) -> int:
        return len(self.area)

    @property
    def power(self) -> np.ndarray:
        """Emitted power, averaged over channels: (n,) float64."""
        return np.pi * self.area.astype(np.float64) * self.radiance.mean(1, dtype=np.float64)

    def __post_init__(self):
        self._row_of_shape = RegistryTable(self.shape_index, np.arange(1, self.count + 1))
        self._radiance = upload(mi.Float, self.radiance)
        self._shapes = upload(mi.UInt32, self.shape_index)

    def row(self, si, active=True):
        """Row of the emitter at a (preliminary) surface interaction, plus one; 0 for a surface without emitter."""
        return self._row_of_shape.at(si.shape, active)

    def on_shape(self, method: str, row, *arguments):
        """Call a method of the shape of each row (counted from 0); the last argument is the mask of active lanes.

        A call on pointers is recorded for every shape of a scene, emitter or not.  Recording is quick per shape, but
        fails if a shape, such as a curve or an instance, lacks the method.  In scenes with such a shape, or with mostly
        non-emitting shapes, only the emitting shape objects are called.
        """
        if self.shapes is not None:
            return dr.switch(mi.UInt32(row), [getattr(shape, method) for shape in self.shapes], *arguments)
        index = dr.gather(mi.UInt32, self._shapes, row, arguments[-1])
        return getattr(dr.reinterpret_array(mi.ShapePtr, index), method)(*arguments)

    def sample_position(self, row, time, sample, active):
        """Draw a point on the shape of each row uniformly by area: Mitsuba's position sample."""
        found = self.on_shape("sample_position", row, time, sample, active)
        if self.spheres is not None:
            found.n = self.spheres.normal(row, found, active)
        return found

    def sample_direction(self, row, si, sample, active):
        """Draw a point on the shape of each row towards ``si``: Mitsuba's direction sample."""
        found = self.on_shape("sample_direction", row, si, sample, active)
        if self.spheres is not None and self.textured:
            found.uv = self.spheres.coordinates(row, found, active)
        return found

    def emitted_in_front(self, row, sample, active=True):
        """Radiance along the normal at a position or direction sample on the emitter of ``row``."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(row))
        si.p, si.n, si.uv, si.wi = sample.p, sample.n, sample.uv, mi.Vector3f(0, 0, 1)
        return self.emitted(row, si, active)

    def emitted(self, row, si, active=True):
        """Radiance emitted at ``si`` towards ``si.wi`` by the emitter of ``row`` (counted from 0)."""
        active = active & (mi.Frame3f.cos_theta(si.wi) > 0)
        radiance = rgb_to_spectrum(dr.gather(mi.Color3f, self._radiance, row, active)) & active
        for textured_row, emitter in self.textured:
            here = active & (row == textured_row)
            radiance = dr.select(here, emitter.eval(si, here), radiance)
        return finite_or_zero(radiance)


@dataclass
class Emitters:
    """Emitters of a scene by representation.

    ``points``, ``spots``, ``directional``: virtual lights; ``area``: rows; ``environment``: the environment emitter or
    None; ``others``: (class name, emitter) of the remaining emitters, sampled by Mitsuba's routines; ``dropped``:
    number of emitters dropped because of values that are negative, not finite, or too large.
    """

    points: VirtualLights
    spots: VirtualLights
    directional: VirtualLights
    area: AreaEmitters
    environment: mi.Emitter | None
    others: list[tuple[str, mi.Emitter]]
    dropped: int

    def extended_only(self) -> Emitters:
        """Copy without point, spot and directional emitters."""
        none = {name: getattr(self, name).select(slice(0)) for name in ("points", "spots", "directional")}
        return replace(self, **none)

    @property
    def count(self) -> int:
        return (
            self.points.count + self.spots.count + self.directional.count + self.area.count + len(self.others)
            + (self.environment is not None)
        )  # fmt: skip


def _textured_radiance(emitter, shape) -> np.ndarray:
    """Mean radiance of a textured area emitter, from random surface samples in a grid as fine as its textures."""
    shapes = [getattr(value, "shape", ()) for value in parameters_of(emitter).values()]
    side = int(np.clip(max((max(one[:2]) for one in shapes if len(one) == 3), default=0), *_GRID))
    cell, across = dr.arange(mi.UInt32, side * side), dr.opaque(mi.UInt32, side)
    # At random in a cell: a regular grid may miss the bright texels of a regular texture
    place = mi.Point2f(mi.Float(cell % across), mi.Float(cell // across))
    place += independent_sampler(0, side * side).next_2d()
    position = shape.sample_position(0, place / mi.Float(across))
    si = dr.zeros(mi.SurfaceInteraction3f, side * side)
    si.p, si.n, si.uv, si.wi = position.p, position.n, position.uv, mi.Vector3f(0, 0, 1)
    radiance = download(finite_or_zero(emitter.eval(si))).reshape(side * side, -1)
    return np.broadcast_to(radiance.mean(0, dtype=np.float64), (3,)).astype(np.float32)


def _can_be_sampled(shape) -> bool:
    return shape.is_mesh() or shape.class_name() in SAMPLED_SHAPES


def _read_areas(scene, group_of: Callable) -> tuple[AreaEmitters, int, list]:
    """(Area emitters, number of rows with invalid values, shape-bound emitters of further classes)."""
    indices, radiances, groups, textured, spheres, unusual = [], [], [], [], [], []
    emitting = [(index, shape) for index, shape in registered_shapes(scene) if shape.is_emitter()]
    # Mitsuba loads shapes in parallel, in an order that changes from run to run; the same seed must give the same image
    emitting.sort(key=lambda row: (row[1].id(), *map(float, (*row[1].bbox().min, *row[1].bbox().max))))
    for index, shape in emitting:
        emitter = shape.emitter()
        if emitter.class_name() != "AreaLight":
            unusual.append((emitter.class_name(), emitter))
            continue
        radiance = constant_rgb(parameters_of(emitter), "radiance")
        _require_supported(shape, constant=radiance is not None)
        if radiance is None:
            textured.append((len(indices), emitter))
            radiance = _textured_radiance(emitter, shape)
        indices.append(index)
        radiances.append(radiance)
        groups.append(group_of(emitter))
        spheres.append(shape if shape.class_name() == "Sphere" else None)
    radiance = np.array(radiances, np.float32).reshape(-1, 3)
    shape_index = np.array(indices, np.uint32)
    by_index = dict(emitting)
    area, shapes = _surface_areas(scene, shape_index, [by_index[index] for index in indices])
    # The square of an area overflows before the extent of a scene does
    bad = ~(usable(radiance).all(1) & usable(area))
    textured = [(row, emitter) for row, emitter in textured if usable(area[row])]
    radiance[bad], area[bad] = 0, 0
    rows = SphereRows(spheres) if any(spheres) else None
    group = np.array(groups, np.uint32)
    return AreaEmitters(shape_index, radiance, area, group, textured, shapes, rows), int(bad.sum()), unusual


def _require_supported(shape, constant: bool) -> None:
    """Raise a ValueError for an area emitter on a shape that cannot be sampled, or with a mesh attribute as radiance.

    ``constant``: whether the radiance is constant.
    """
    if not _can_be_sampled(shape):
        raise ValueError(
            f'shape "{shape.id()}" ({shape.class_name()}): area emitters on this kind of shape are not supported, '
            f"because Mitsuba cannot sample it; supported are meshes, {', '.join(SAMPLED_SHAPES)}"
        )
    if not constant and "MeshAttribute[" in str(shape.emitter()):
        raise ValueError(
            f'shape "{shape.id()}" ({shape.class_name()}): the emitted radiance is a mesh attribute, which is not '
            "supported; supported are a constant and an image"
        )


def _surface_areas(scene, shape_index: np.ndarray, shapes: list[mi.Shape]):
    """(Areas of the emitting shapes, (n,) float32, ``shapes`` of :class:`AreaEmitters`)."""
    if not shapes:
        return np.zeros(0, np.float32), None
    all_shapes = scene.shapes()
    by_pointer = _SHAPES_BY_POINTER * len(shapes) > len(all_shapes)
    if by_pointer and all(_can_be_sampled(shape) for shape in all_shapes):
        pointers = dr.reinterpret_array(mi.ShapePtr, upload(mi.UInt32, shape_index))
        # Dr.Jit records the call for the shapes of all scenes in memory, and curves and instances have no area
        with suppress(RuntimeError):
            return download(pointers.surface_area()), None
    row = dr.arange(mi.UInt32, len(shapes))
    return download(dr.switch(row, [shape.surface_area for shape in shapes])), shapes


def _sorted_rows(rows: list, columns: int) -> np.ndarray:
    """Rows in lexicographic order, hence independent of Mitsuba's loading order."""
    array = np.array(rows, np.float64).reshape(-1, columns)
    return array[np.lexsort(array.T[::-1])]


def _read_environment(scene):
    """(Environment emitter or None, number of dropped environments); a constant with an invalid value is dropped.

    Raises a ValueError that names the first invalid texel of an environment map: Mitsuba cannot sample the map.
    """
    environment = scene.environment()
    if environment is None:
        return None, 0
    if environment.class_name() == "TimedSunskyEmitter":
        raise ValueError(
            f'the emitter "{environment.id()}" ({environment.class_name()}) is not supported: Mitsuba\'s compiled '
            "variants cannot evaluate it; use sunsky"
        )
    parameters = parameters_of(environment)
    radiance = constant_rgb(parameters, "radiance")
    if radiance is not None and not usable(np.array(radiance)).all():
        return None, 1
    if "data" in parameters:
        # Mitsuba puts a copy of the last column first.  Negative texels, which filters leave in maps, count as black
        texels = np.asarray(parameters["data"])[:, 1:]
        if not usable(max(-texels.min(), texels.max())):
            bad = np.argwhere(~usable(np.abs(texels)).all(-1))
            row, column = bad[0].tolist()
            raise ValueError(
                f'the environment map "{environment.id()}" has {len(bad)} texel(s) that are not a number or above '
                f"{LARGEST_VALUE:g}; the first is in row {row} and column {column}"
            )
    return environment, 0


def read_emitters(scene, group_of: Callable[[mi.Emitter], int] = lambda _: 0) -> Emitters:
    """Read the emitters of ``scene`` that contribute in Mitsuba's ``path``.

    ``group_of``: number of the group of an emitter, by default 0.

    Emitters with a radiance or area that is negative, not finite, or too large are dropped, counted and logged.  Raises
    ValueError for environment maps with invalid texels and for emitters on shapes that Mitsuba cannot sample.
    """
    environment, dropped = _read_environment(scene)
    area, bad_areas, others_on_shapes = _read_areas(scene, group_of)
    dropped += bad_areas
    points, spots, suns, others = read_unbound(scene, group_of, [known for _, known in others_on_shapes])
    points, spots, suns = (_sorted_rows(rows, n) for rows, n in ((points, 7), (spots, 12), (suns, 7)))
    omni = VirtualLights.of("point", points[:, :3], np.tile([0, 0, 1], (len(points), 1)), points[:, 3:6])
    spot = VirtualLights.of("spot", spots[:, :3], spots[:, 3:6], spots[:, 6:9], 0, spots[:, 9:11])
    sun = VirtualLights.of("directional", None, suns[:, :3], suns[:, 3:6])
    for lights, rows in ((omni, points), (spot, spots), (sun, suns)):
        lights.group = rows[:, -1].astype(np.uint32)
    kept = []
    for lights in (omni, spot, sun):
        lights, bad = lights.without_bad()
        dropped += bad
        kept.append(lights)
    if dropped:
        mi.Log(
            mi.LogLevel.Warn,
            f"Dropped {dropped} emitter(s) with values that are negative, not finite, or above {LARGEST_VALUE:.0e}.",
        )
    others += [row for row in others_on_shapes if not lights_nothing(row[1])]
    others.sort(key=lambda row: (row[0], row[1].id(), str(row[1])))
    return Emitters(*kept, area, environment, others, dropped)
