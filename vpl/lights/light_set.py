"""Everything that a method needs to know about the lights of one render: virtual lights, their trees, the clamp.

Emitters that have an extent become virtual lights here where that is asked for, as in the papers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NO_LIMIT, channel_mean, download, finite_or_zero, spectrum_to_rgb, upload
from ..core.cones import COSINE_ROUNDING
from ..core.sampling import Choice, derived_seed, find_interval, independent_sampler, running_sums, stratified
from ..core.stages import Stage, tell
from .emission import bounding_sphere
from .emitters import Emitters
from .focus import Focus, spacing
from .light_tree import CONE_COS, DeviceTree, LightTree, build_light_tree
from .tracing import PathLimits, TracedLights, trace_lights
from .virtual_lights import KINDS, DeviceLights, VirtualLights


@dataclass(frozen=True)
class LightOptions:
    """What lights to make: see the integrators' manual for ``vpl_count``, ``direct_count``, ``clamping``, ``direct``.

    ``deepest``: edges of the longest light path that may store a light; ``trees``: whether trees are needed.
    """

    vpl_count: int
    direct_count: int
    clamping: float
    direct: str
    max_depth: float
    rr_depth: int
    lobe_limit: float
    trees: bool


@dataclass
class LightGroup:
    """Lights of one kind on the device, with their tree (None where the method asks for none).

    ``sign``: of the contributions, -1 where the intensities are absolute values of negative ones.
    """

    kind: str
    lights: DeviceLights
    tree: DeviceTree | None
    sign: float = 1.0

    @property
    def count(self) -> int:
        return self.lights.count

    def pick(self, index):
        """Lights by their index, each standing for itself: the candidates of
        :func:`vpl.transport.evaluation.evaluate_one_of`.
        """
        return [(self.lights.gather(index), 1)]

    def representatives(self, nodes, second=False):
        """The light that stands for each node, or its second one: see :meth:`standing_for`."""
        return self.standing_for(self.tree.representative(nodes, second=second), self.tree.summed_intensity(nodes))

    def standing_for(self, index, intensity):
        """Lights by their index, and the factors from their intensities to those of the clusters they stand for.

        A representative is drawn with probability intensity / cluster intensity; dividing by it, rather than taking the
        cluster's colour, keeps the estimate unbiased where colours differ.  ``intensity``: the mean over channels.
        """
        light = self.lights.gather(index)
        return light, intensity / channel_mean(light.intensity)


@dataclass
class LightSet:
    """Groups that hold at least one light; ``smallest_distance``: the clamp on distances to oriented lights, ``clamp``:
    the same on the device, where it is part of no kernel.

    ``max_depth``: edges of the longest path from camera to emitter; ``paths``: light paths emitted; ``dropped``: lights
    with values that were not finite; ``seconds``: time by stage.
    """

    groups: list[LightGroup]
    smallest_distance: float
    max_depth: float
    paths: int
    dropped: int
    seconds: dict
    clamp: object = field(init=False)

    def __post_init__(self):
        self.clamp = dr.opaque(mi.Float, self.smallest_distance)

    @property
    def count(self) -> int:
        return sum(group.count for group in self.groups)

    @property
    def counts(self) -> dict:
        return {group.kind: group.count for group in self.groups}

    def allowed(self, point_depth, light_depth):
        """Whether a path through a gather point and a light has no more edges than ``max_depth``."""
        if math.isinf(self.max_depth):
            return mi.Bool(True)
        return point_depth + light_depth + 1 <= mi.UInt32(self.max_depth)

    def edges_left(self, point_depth, light_depth):
        """How many edges more an allowed path through a gather point and a light may have, UInt32."""
        if math.isinf(self.max_depth):
            return mi.UInt32(NO_LIMIT)
        return mi.UInt32(self.max_depth) - (point_depth + light_depth + 1)


def _leaf_ranges(tree: LightTree) -> np.ndarray:
    """For every node, the first and one past the last of its lights in ``tree.leaf_order``: (2n - 1, 2)."""
    node = np.arange(len(tree.records))
    leaves_before = np.concatenate([[0], np.cumsum(tree.escape == node + 1)])
    return np.stack([leaves_before[node], leaves_before[tree.escape]], axis=1)


def _reduced_below(tree: LightTree, reduce: np.ufunc, values: np.ndarray, neutral: float) -> np.ndarray:
    """For every node, the values of its lights reduced to one: (2n - 1, ...) from (n, ...) in the lights' own order."""
    in_order = np.concatenate([values[tree.leaf_order], np.full((1, *values.shape[1:]), neutral)])
    return reduce.reduceat(in_order, _leaf_ranges(tree).reshape(-1))[::2]


def largest_below(tree: LightTree, values: np.ndarray) -> np.ndarray:
    """For every node, the largest of a value over its lights: (2n - 1,) from (n,) in the lights' own order."""
    return _reduced_below(tree, np.maximum, values, -np.inf)


def moments_below(tree: LightTree, position: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every node, the weighted mean of the positions (n, 3) of its lights, (2n - 1, 3), and the mean of their
    squared distance from there, (2n - 1,).  ``weight`` (n,): where all of a node are 0, they count alike."""
    place, weight = position.astype(np.float64), weight.astype(np.float64)
    origin = place.mean(0)
    # Relative to the middle of all, as the squares of large numbers have no digits left for small differences
    place = place - origin
    powers = np.concatenate([np.ones((len(place), 1)), place, (place**2).sum(1, keepdims=True)], axis=1)
    weighted, alike = (_reduced_below(tree, np.add, x, 0.0) for x in (powers * weight[:, None], powers))
    total = np.where(weighted[:, :1] > 0, weighted, alike)
    total = total[:, 1:] / total[:, :1]
    mean = total[:, :3]
    return mean + origin, np.maximum(total[:, 3] - (mean**2).sum(1), 0)


def _second_representatives(tree: LightTree, intensity: np.ndarray, generator) -> np.ndarray:
    """For every node, one of its lights, drawn by intensity and independently of all others: (2n - 1,).

    A threshold that was found with the same representatives that the final cut uses keeps bright ones and refines dark
    ones, which biases the image upwards; estimates use these instead.
    """
    first, last = _leaf_ranges(tree).T
    cumulative = np.concatenate([[0.0], np.cumsum(intensity[tree.leaf_order].astype(np.float64))])
    wanted = cumulative[first] + generator.random(len(first)) * (cumulative[last] - cumulative[first])
    chosen = np.searchsorted(cumulative, wanted, side="right") - 1
    return tree.leaf_order[np.clip(chosen, first, last - 1)]


def light_tree(lights: VirtualLights, seed: int) -> DeviceTree:
    """The light tree of one kind."""
    generator = np.random.default_rng(seed)
    tree = _tree_of(lights, generator)
    second = _second_representatives(tree, lights.intensity.mean(1), generator)
    return DeviceTree(lights.kind, tree, second)


def _tree_of(lights: VirtualLights, generator) -> LightTree:
    """The tree over lights of one kind; a spot tree's cones are widened by the cut-off angles below each node."""
    direction = None if lights.kind == "point" else lights.direction
    tree = build_light_tree(lights.position, direction, lights.intensity, generator)
    if lights.kind == "spot":
        half_angle = np.arccos(np.clip(tree.records[:, CONE_COS].astype(np.float64), -1, 1))
        half_angle += largest_below(tree, lights.cone[:, 0])
        tree.records[:, CONE_COS] = np.maximum(np.cos(np.minimum(half_angle, np.pi)) - COSINE_ROUNDING, -1)
    return tree


@dataclass
class ScatteredGroup(LightGroup):
    """Lights whose clusters have no fixed representative: one is drawn whenever it is asked for.

    ``first``, ``last``: UInt32, of every node the range of its lights in ``order``; ``cumulative``: their summed
    intensities in that order, in double precision.
    """

    first: object = None
    last: object = None
    order: object = None
    cumulative: object = None

    @classmethod
    def of(cls, lights: VirtualLights, seed: int, sign: float = 1.0) -> ScatteredGroup:
        """Lights of one kind, with their tree."""
        tree = _tree_of(lights, np.random.default_rng(seed))
        first, last = (upload(mi.UInt32, column) for column in _leaf_ranges(tree).T)
        intensity = lights.intensity.mean(1, dtype=np.float64)
        return cls(
            lights.kind, DeviceLights(lights), DeviceTree(lights.kind, tree, tree.representative), sign, first, last,
            upload(mi.UInt32, tree.leaf_order), running_sums(upload(mi.Float, intensity[tree.leaf_order])),
        )  # fmt: skip

    def draw(self, nodes, sample):
        """A light of each node by intensity, for a uniform number: (lights, factor on their intensities)."""
        first, last = dr.gather(mi.UInt32, self.first, nodes), dr.gather(mi.UInt32, self.last, nodes)
        index = dr.gather(mi.UInt32, self.order, find_interval(self.cumulative, first, last, sample))
        return self.standing_for(index, self.tree.summed_intensity(nodes))


def prepare_lights(scene, emitters: Emitters, options: LightOptions, places: np.ndarray, seed: int) -> LightSet:
    """Make the lights of one render: emitters that are points, extended emitters if asked, traced lights, trees.

    Nothing is traced for ``max_depth`` up to 2, where light cannot bounce.  ``places``: some that the camera sees,
    (n, 3) world units.
    """
    tell(Stage.TRACE)
    start = perf_counter()
    found, traced = [], None
    if options.direct != "none" and options.max_depth >= 2:
        found += [emitters.points, emitters.spots, emitters.directional]
        if options.direct == "vpl":
            found += lights_of_emitters(scene, emitters, options.direct_count, derived_seed(seed, 20))
    if options.max_depth > 2:
        limits = PathLimits(options.max_depth - 2, options.rr_depth, options.lobe_limit)
        focus = Focus.of(places, bounding_sphere(scene))
        traced = trace_lights(scene, emitters, options.vpl_count, derived_seed(seed, 21), limits, focus)
        found.append(traced.lights)
    seconds = {Stage.TRACE: perf_counter() - start}

    tell(Stage.TREE)
    start = perf_counter()
    groups, dropped = [], 0
    for number, kind in enumerate(KINDS):
        of_kind = [lights for lights in found if lights.kind == kind]
        if not of_kind:
            continue
        lights, bad = VirtualLights.concatenate(of_kind).without_bad()
        dropped += bad
        if lights.count:
            tree = light_tree(lights, derived_seed(seed, 22, number)) if options.trees else None
            groups.append(LightGroup(kind, DeviceLights(lights), tree))
    seconds[Stage.TREE] = perf_counter() - start
    clamp = options.clamping * _spacing(found, traced, places)
    paths = traced.paths if traced else 0
    return LightSet(groups, clamp, options.max_depth, paths, dropped + (traced.dropped if traced else 0), seconds)


def _spacing(found: list[VirtualLights], traced: TracedLights | None, places: np.ndarray) -> float:
    """Typical distance between lights that stand for surfaces: of traced ones where the camera looks, or else of those
    on area emitters."""
    if traced and traced.lights.count:
        return spacing(traced.lights.position, places)
    on_emitters = [lights.position for lights in found if lights.kind == "oriented" and lights.count]
    return spacing(on_emitters[0], on_emitters[0]) if on_emitters else 0.0


def area_lights(emitters: Emitters, count: int, seed: int, weight: np.ndarray | None = None) -> VirtualLights:
    """``count`` points on area emitters as oriented lights: emitters chosen by ``weight`` (None: by power), points by
    area."""
    area = emitters.area
    choice = Choice(area.power if weight is None else weight)
    sampler = independent_sampler(seed, count)
    row = choice.row(stratified(sampler, count, 0, count))
    ps = area.sample_position(row, mi.Float(0), sampler.next_2d(), mi.Bool(True))
    intensity = spectrum_to_rgb(area.emitted_in_front(row, ps)) / (ps.pdf * choice.probability(row))
    # Divided on the device, where the number of lights is part of no kernel
    intensity /= dr.opaque(mi.Float, float(count))
    # By one kernel, which holds the code of all shapes
    dr.eval(ps.p, ps.n, intensity)
    return VirtualLights.of("oriented", download(ps.p), download(ps.n), download(intensity))


def environment_lights(scene, emitters: Emitters, count: int, seed: int) -> VirtualLights:
    """``count`` directions towards the environment as lights at infinity, by its own importance sampling."""
    sampler = independent_sampler(seed, count)
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(bounding_sphere(scene).center)
    ds, weight = emitters.environment.sample_direction(reference, sampler.next_2d())
    irradiance = dr.zeros(mi.Color3f, count) + spectrum_to_rgb(finite_or_zero(mi.unpolarized_spectrum(weight))) / count
    return VirtualLights.of("environment", None, download(-ds.d), download(irradiance))


def lights_of_emitters(scene, emitters: Emitters, count: int, seed: int) -> list[VirtualLights]:
    """Area emitters and the environment as ``count`` virtual lights each.

    Raises a ValueError naming the first emitter that has no such form.
    """
    for name, _ in emitters.others:
        raise ValueError(f'emitter of type "{name}" cannot become virtual lights: use direct="nee" with this scene')
    lights = []
    if np.any(emitters.area.power > 0):
        lights.append(area_lights(emitters, count, seed))
    if emitters.environment is not None:
        lights.append(environment_lights(scene, emitters, count, seed))
    return lights
