"""The lights of one render: virtual lights, light trees, and the clamping distance.

With ``direct="vpl"`` emitters with an extent become virtual lights, as in the papers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import channel_mean, download, finite_or_zero, spectrum_to_rgb, upload, upload_limit
from ..core.clock import Clock
from ..core.cones import COSINE_ROUNDING
from ..core.sampling import Choice, GuidedSums, derived_seed, independent_sampler, stratified
from ..core.stages import Stage
from .device_tree import DeviceTree
from .emission import bounding_sphere
from .emitters import Emitters
from .focus import Focus, spacing
from .light_tree import CONE_COS, INTENSITY, LEAST_C, WINDOW, LightTree, build_light_tree
from .tracing import LightPathSettings, TracedLights, trace_lights
from .virtual_lights import KINDS, DeviceLights, VirtualLights

# Window of trees of which clusters draw lights: NumPy builds them in 0.6 of the time of the usual window, with as many
# shadow rays and 0 to 1% more variance (kitchen, veach_ajar, living_room, 16 samples)
_SMALL_WINDOW = 4


@dataclass(frozen=True)
class LightOptions:
    """Settings of light generation, documented in the integrators' manual; ``trees``: whether to build light trees."""

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
    """Lights of one kind on the device, with their tree (None if the method uses none).

    ``sign``: of the contributions, -1 where the intensities are absolute values of negative ones.
    """

    kind: str
    lights: DeviceLights
    tree: DeviceTree | None
    sign: float = field(default=1.0, kw_only=True)

    @property
    def count(self) -> int:
        return self.lights.count

    def pick(self, index):
        """Lights by index with scale factor 1, for :func:`vpl.transport.evaluation.evaluate_one_of`."""
        return [(self.lights.gather(index), 1)]

    def representatives(self, nodes, second=False):
        """Representative light of each node, or the second one, with its scale factor; see :meth:`standing_for`."""
        return self.standing_for(self.tree.representative(nodes, second=second), self.tree.summed_intensity(nodes))

    def standing_for(self, index, intensity):
        """Representative lights by index, and the factors from their intensities to the clusters' ``intensity``.

        ``intensity``: of the clusters, the mean over channels.  A representative's probability is (its intensity) /
        (cluster intensity).  Division by this probability, instead of use of the cluster's colour, keeps the estimate
        unbiased if colours differ.
        """
        light = self.lights.gather(index)
        return light, intensity / channel_mean(light.intensity)


@dataclass
class LightSet:
    """Lights of one render.

    ``groups``: non-empty groups; ``smallest_distance``: clamping distance of oriented lights, world units, 0 for
    none; ``clamp``: the same number on the device, opaque to kernels; ``max_depth``: edges of the longest path from
    camera to emitter; ``paths``: number of emitted light paths; ``dropped``: number of lights with non-finite values;
    ``seconds``: time by stage.
    """

    groups: list[LightGroup]
    smallest_distance: float
    max_depth: float
    paths: int
    dropped: int
    seconds: dict[Stage, float]
    clamp: mi.Float = field(init=False)

    def __post_init__(self):
        self.clamp = dr.opaque(mi.Float, self.smallest_distance)
        self._limit = upload_limit(self.max_depth)

    @property
    def count(self) -> int:
        return sum(group.count for group in self.groups)

    @property
    def counts(self) -> dict[str, int]:
        return {group.kind: group.count for group in self.groups}

    def allowed(self, point_depth, light_depth):
        """Whether a path through a gather point and a light has at most ``max_depth`` edges."""
        return point_depth + light_depth + 1 <= self._limit

    def edges_left(self, point_depth, light_depth):
        """Number of edges that a path through a gather point and a light may gain, UInt32."""
        return self._limit - (point_depth + light_depth + 1)


def _leaf_ranges(tree: LightTree) -> np.ndarray:
    """Begin and end of every node's lights in ``tree.leaf_order``: (2n - 1, 2)."""
    node = np.arange(len(tree.records))
    leaves_before = np.concatenate([[0], np.cumsum(tree.is_leaf)])
    return np.stack([leaves_before[node], leaves_before[tree.escape]], axis=1)


def _reduced_below(tree: LightTree, reduce: np.ufunc, values: np.ndarray, neutral: float) -> np.ndarray:
    """Reduce ``values`` (n, ...) of the lights, in the caller's order, to every node: (2n - 1, ...)."""
    in_order = np.concatenate([values[tree.leaf_order], np.full((1, *values.shape[1:]), neutral)])
    return reduce.reduceat(in_order, _leaf_ranges(tree).reshape(-1))[::2]


def largest_below(tree: LightTree, values: np.ndarray) -> np.ndarray:
    """Maximum over every node's lights of ``values`` (n,), in the caller's order: (2n - 1,)."""
    return _reduced_below(tree, np.maximum, values, -np.inf)


def moments_below(tree: LightTree, position: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Weighted mean position (2n - 1, 3), mean squared distance from it (2n - 1,)) of every node's lights.

    ``position`` (n, 3); ``weight`` (n,): a node with zero total weight uses equal weights.
    """
    place, weight = position.astype(np.float64), weight.astype(np.float64)
    origin = place.mean(0)
    # Relative to the mean of all lights: squares of large coordinates would lose the digits of small differences
    place = place - origin
    powers = np.concatenate([np.ones((len(place), 1)), place, (place**2).sum(1, keepdims=True)], axis=1)
    weighted, unweighted = (_reduced_below(tree, np.add, x, 0.0) for x in (powers * weight[:, None], powers))
    total = np.where(weighted[:, :1] > 0, weighted, unweighted)
    total = total[:, 1:] / total[:, :1]
    mean = total[:, :3]
    return mean + origin, np.maximum(total[:, 3] - (mean**2).sum(1), 0)


def _second_representatives(tree: LightTree, intensity: np.ndarray, generator) -> np.ndarray:
    """A second representative light of every node, drawn by intensity, independently for each node: (2n - 1,).

    Radiance estimates for thresholds use second representatives.  With the final cut's representatives, thresholds
    would keep bright representatives and refine dark ones, which biases the image upwards.
    """
    first, last = _leaf_ranges(tree).T
    cumulative = np.concatenate([[0.0], np.cumsum(intensity[tree.leaf_order].astype(np.float64))])
    wanted = cumulative[first] + generator.random(len(first)) * (cumulative[last] - cumulative[first])
    chosen = np.searchsorted(cumulative, wanted, side="right") - 1
    return tree.leaf_order[np.clip(chosen, first, last - 1)]


def light_tree(lights: VirtualLights, seed: int) -> DeviceTree:
    """Light tree over lights of one kind; ``seed``: of the representatives."""
    generator = np.random.default_rng(seed)
    tree = _tree_of(lights, generator)
    second = _second_representatives(tree, lights.intensity.mean(1), generator)
    return DeviceTree(lights.kind, tree, second)


def _tree_of(lights: VirtualLights, generator=None, window: int = WINDOW) -> LightTree:
    """Tree over lights of one kind, without representatives if there is no ``generator``; cones of spot trees are
    widened by the largest cut-off angle below each node."""
    direction = None if lights.kind == "point" else lights.direction
    tree = build_light_tree(lights.position, direction, lights.intensity, generator, window)
    if lights.kind == "spot":
        half_angle = np.arccos(np.clip(tree.records[:, CONE_COS].astype(np.float64), -1, 1))
        half_angle += largest_below(tree, lights.cone[:, 0])
        tree.records[:, CONE_COS] = np.maximum(np.cos(np.minimum(half_angle, np.pi)) - COSINE_ROUNDING, -1)
    return tree


@dataclass
class ScatteredGroup(LightGroup):
    """Lights whose clusters have no fixed representative: :meth:`draw` draws a new one at every call.

    The lights are in the order of the tree: those of a node are neighbours in memory.  ``sums`` of their intensities;
    ``nodes``: packed records of the nodes, see :meth:`_record`.
    """

    sums: GuidedSums
    nodes: mi.UInt32

    @classmethod
    def of(cls, lights: VirtualLights, sign: float = 1.0) -> ScatteredGroup:
        """Group with a tree over lights of one kind; ``sign``: see LightGroup.

        Surface lights need a c.  Their clusters have the least c in place of a representative.
        """
        tree = _tree_of(lights, window=_SMALL_WINDOW)
        ranges, order = _leaf_ranges(tree).astype(np.uint32), tree.leaf_order
        if lights.kind == "surface":
            tree.records[:, LEAST_C] = -largest_below(tree, -lights.c)
        lights = lights.select(order)
        bits = tree.records[:, INTENSITY].copy().view(np.uint32)
        nodes = upload(mi.UInt32, np.column_stack([ranges, order[ranges[:, 0]], bits]))
        sums = GuidedSums(lights.intensity.mean(1, dtype=np.float64))
        return cls(lights.kind, DeviceLights(lights), DeviceTree(lights.kind, tree), sums, nodes, sign=sign)

    def first_light(self, nodes):
        """The caller's index of the first light of each node: nodes of a cut differ in it, and similar trees have equal
        ones."""
        return self._record(nodes).z

    def draw(self, nodes, sample):
        """Draw a light of each node by intensity with a uniform number: (lights, scale factors)."""
        record = self._record(nodes)
        index = self.sums.find(record.x, record.y, sample)
        return self.standing_for(index, dr.reinterpret_array(mi.Float, record.w))

    def _record(self, nodes) -> mi.Vector4u:
        """For each node: its first light, the end of its lights, the caller's index of the first light, bits of the
        intensity."""
        return dr.gather(mi.Vector4u, self.nodes, nodes)


def prepare_lights(scene, emitters: Emitters, options: LightOptions, places: np.ndarray, seed: int) -> LightSet:
    """Lights and light trees of one render, from point-like emitters, traced light paths, and optionally from emitters
    with an extent.

    For ``max_depth`` up to 2 no paths are traced, because light cannot bounce.  ``places``: some visible points, (n, 3)
    world units.
    """
    clock = Clock(Stage.TRACE)
    found, traced = [], None
    if options.direct != "none" and options.max_depth >= 2:
        found += [emitters.points, emitters.spots, emitters.directional]
        if options.direct == "vpl":
            found += lights_of_emitters(scene, emitters, options.direct_count, derived_seed(seed, 20))
    if options.max_depth > 2:
        settings = LightPathSettings(options.max_depth - 2, options.rr_depth, options.lobe_limit)
        focus = Focus.of(places, bounding_sphere(scene))
        traced = trace_lights(scene, emitters, options.vpl_count, derived_seed(seed, 21), settings, focus)
        found.append(traced.lights)
    clock.begin(Stage.TREE)
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
    clock.stop()
    clamp = options.clamping * _spacing(found, traced, places)
    paths = traced.paths if traced else 0
    return LightSet(groups, clamp, options.max_depth, paths, dropped + (traced.dropped if traced else 0), clock.seconds)


def _spacing(found: list[VirtualLights], traced: TracedLights | None, places: np.ndarray) -> float:
    """Typical distance between lights on surfaces: traced lights around ``places``, or else lights on area emitters."""
    if traced and traced.lights.count:
        return spacing(traced.lights.position, places)
    on_emitters = [lights.position for lights in found if lights.kind == "oriented" and lights.count]
    return spacing(on_emitters[0], on_emitters[0]) if on_emitters else 0.0


def area_lights(emitters: Emitters, count: int, seed: int, weight: np.ndarray | None = None) -> VirtualLights:
    """``count`` oriented lights on area emitters: emitters chosen by ``weight`` (None: by power), points by area."""
    area = emitters.area
    choice = Choice(area.power if weight is None else weight)
    sampler = independent_sampler(seed, count)
    row = choice.row(stratified(sampler, count, 0, count))
    ps = area.sample_position(row, mi.Float(0), sampler.next_2d(), mi.Bool(True))
    intensity = spectrum_to_rgb(area.emitted_in_front(row, ps)) / (ps.pdf * choice.probability(row))
    # Opaque: the number of lights must not become a constant of the kernel
    intensity /= dr.opaque(mi.Float, float(count))
    # One kernel, because it contains the code of every kind of shape
    dr.eval(ps.p, ps.n, intensity)
    lights = VirtualLights.of("oriented", download(ps.p), download(ps.n), download(intensity))
    lights.group = area.group[download(row)]
    return lights


def environment_lights(scene, emitters: Emitters, count: int, seed: int) -> VirtualLights:
    """``count`` lights at infinity, drawn by the environment emitter's importance sampling."""
    sampler = independent_sampler(seed, count)
    reference = dr.zeros(mi.Interaction3f, count)
    reference.p = mi.Point3f(bounding_sphere(scene).center)
    ds, weight = emitters.environment.sample_direction(reference, sampler.next_2d())
    irradiance = dr.zeros(mi.Color3f, count) + spectrum_to_rgb(finite_or_zero(mi.unpolarized_spectrum(weight))) / count
    return VirtualLights.of("environment", None, download(-ds.d), download(irradiance))


def lights_of_emitters(scene, emitters: Emitters, count: int, seed: int) -> list[VirtualLights]:
    """``count`` virtual lights on area emitters, and ``count`` for the environment emitter.

    Raises ValueError for emitters of any further class.
    """
    for name, _ in emitters.others:
        raise ValueError(f'emitter of type "{name}" cannot become virtual lights: use direct="nee" with this scene')
    lights = []
    if np.any(emitters.area.power > 0):
        lights.append(area_lights(emitters, count, seed))
    if emitters.environment is not None:
        lights.append(environment_lights(scene, emitters, count, seed))
    return lights
