"""Draw the figures of docs/methods.md and docs/choosing.md by the project's own code: trees, cuts, matrices, layers.

    ./run -- python docs/figures.py [NAME...]

Writes docs/figures/. Figures are 256 pixels wide, with a camera ray per pixel and few virtual lights, so that single
boxes are visible.
"""

import heapq
import sys
from functools import partial
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np
from matplotlib.collections import LineCollection

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
mi.set_variant("llvm_ad_rgb")

import integrators  # noqa: E402, F401
from benchmarks.matrix_pictures import draw_slice  # noqa: E402
from benchmarks.noise_classes import single_classes  # noqa: E402
from benchmarks.scenes import camera_rays  # noqa: E402
from comparison import images  # noqa: E402
from vpl.core.arrays import download, upload_vectors  # noqa: E402
from vpl.cuts.light_cuts import collect_cuts, estimate_radiance, limited_cuts  # noqa: E402
from vpl.lights.light_tree import BOX_MAX, BOX_MIN, ESCAPE, INTENSITY, cluster_sizes  # noqa: E402
from vpl.points.point_clusters import PointClusters  # noqa: E402
from vpl.points.slices import build_slices  # noqa: E402

FOLDER = ROOT / "docs" / "figures"
WIDTH, LIGHTS, DEPTH, ERROR = 256, 4000, 6, 0.02
# Pairs of corners at the ends of the edges of a box, by the bits of x, y and z
EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
# Pieces of an edge; pieces outside of the picture are not drawn
PIECES = 24


class View:
    """Picture of a scene, and the `ShadeJob` of its diffuse surfaces."""

    def __init__(self, name, samples=1, integrator="lightcuts", **more):
        path = str(ROOT / "scenes" / f"{name}.xml")
        width, height = mi.load_file(path).sensors()[0].film().size()
        self.width, self.height = WIDTH, round(WIDTH * height / width)
        self.scene = mi.load_file(path, resx=str(self.width), resy=str(self.height))
        self.sensor, self.samples = self.scene.sensors()[0], samples
        settings = {"max_depth": DEPTH, "vpl_count": LIGHTS, **more}
        self.plugin = mi.load_dict({"type": integrator, **settings})
        prepared = self.plugin.prepare(self.scene, *camera_rays(self.scene, 0, samples))
        self.job = max(prepared.jobs, key=lambda one: one.share)
        self.group = max(self.job.lights.groups, key=lambda one: one.count)

    def pixels(self):
        """The image, (height, width, 3) uint8."""
        image = np.array(mi.render(self.scene, integrator=mi.load_dict({"type": "manylights"}), spp=64))[..., :3]
        return images.tone_map(image, images.automatic_exposure(image))

    def project(self, points):
        """Project points, (n, 3), into the picture: pixels, (n, 2), NaN outside of the picture."""
        place = dr.zeros(mi.Interaction3f, len(points))
        place.p = upload_vectors(mi.Point3f, points)
        seen, weight = self.sensor.sample_direction(place, mi.Point2f(0.5))
        found = download(seen.uv)
        found[~(download(weight).max(1) > 0)] = np.nan
        return found

    def outlines(self, low, high, **style):
        """Lines of the edges of boxes. ``colors``: a colour for all boxes, or for each box."""
        corners = np.where((np.arange(8)[:, None] >> np.arange(3)) & 1, high[:, None], low[:, None])
        along = np.linspace(0, 1, PIECES + 1)[:, None]
        edges = np.stack([corners[:, a, None] * (1 - along) + corners[:, b, None] * along for a, b in EDGES], 1)
        places = self.project(edges.reshape(-1, 3)).reshape(-1, PIECES + 1, 2)
        colours = np.repeat(style.pop("colors"), len(EDGES), 0)
        return LineCollection(list(places), colors=colours, **style)


def panels(titles, height):
    """A figure with a row of panels, and its axes, without ticks. ``height``: height over width of a panel."""
    figure, axes = plt.subplots(1, len(titles), figsize=(3.2 * len(titles), 3.2 * height + 0.3), layout="constrained")
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=9)
        axis.set_axis_off()
    return figure, axes


def save(figure, name):
    """Write a figure, small."""
    figure.savefig(FOLDER / f"{name}.jpg", dpi=110, pil_kwargs={"quality": 85})
    plt.close(figure)


def dimmed(pixels):
    """A picture to draw on, grey and dark."""
    return np.repeat((pixels.mean(2, keepdims=True) * 0.6).astype(np.uint8), 3, 2)


def colours(count, seed=0):
    """Distinct colours for neighbours, (count, 3)."""
    hues = np.random.default_rng(seed).permutation(count) / count
    return matplotlib.colormaps["hsv"](hues * 0.95)[:, :3]


def coarse_cut(records, count):
    """The ``count`` nodes of a light tree that remain when the largest cluster is refined again and again."""
    escape, sizes = records.view(np.uint32)[:, ESCAPE], cluster_sizes(records)
    waiting, leaves = [(-sizes[0], 0)], []
    while waiting and len(waiting) + len(leaves) < count:
        _, node = heapq.heappop(waiting)
        if escape[node] == node + 1:
            leaves.append(node)
            continue
        for child in (node + 1, int(escape[node + 1])):
            heapq.heappush(waiting, (-sizes[child], child))
    return np.array(leaves + [node for _, node in waiting])


def light_tree(view, pixels):
    """The virtual lights of the Cornell box, and two levels of the tree over them."""
    records = view.group.tree.records()
    leaves = np.flatnonzero(records.view(np.uint32)[:, ESCAPE] == np.arange(1, len(records) + 1))
    figure, axes = panels([f"{len(leaves)} virtual lights", "12 clusters", "100 clusters"], 1)
    for axis in axes:
        axis.imshow(dimmed(pixels))
    x, y = view.project(records[leaves, BOX_MIN]).T
    axes[0].scatter(x, y, s=1, color="#ffd27f")
    for axis, count in zip(axes[1:], (12, 100), strict=True):
        nodes = records[coarse_cut(records, count)]
        axis.add_collection(view.outlines(nodes[:, BOX_MIN], nodes[:, BOX_MAX], colors=colours(len(nodes)), lw=1))
    save(figure, "light_tree")


def cuts(view, pixels):
    """Number of clusters for each pixel of the Cornell box, and the cuts of two pixels."""
    spots = {"next to a wall": (0.22, 0.30), "on the floor": (0.45, 0.93)}
    figure, axes = panels(["clusters in the cut of each pixel", *spots], 1)
    shown = axes[0].imshow(channel(view, "lightcuts", "cut_size"), cmap="magma")
    figure.colorbar(shown, ax=axes[0], fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)
    places = view.project(download(view.job.batch.position))
    for axis, (name, spot) in zip(axes[1:], spots.items(), strict=True):
        nodes = cut_at(view, int(np.nanargmin(np.square(places - np.array(spot) * WIDTH).sum(1))))
        bright = matplotlib.colormaps["plasma"](np.linspace(0.25, 1, len(nodes)))[:, :3]
        nodes = nodes[np.argsort(nodes[:, INTENSITY])]
        axis.imshow(dimmed(pixels))
        axis.add_collection(view.outlines(nodes[:, BOX_MIN], nodes[:, BOX_MAX], colors=bright, lw=0.7))
        axis.plot(*(np.array(spot) * WIDTH), "o", color="white", markersize=7, markeredgecolor="black")
        axis.set_title(f"the cut of a point {name}: {len(nodes)}", fontsize=9)
    save(figure, "cuts")


def cut_at(view, row):
    """The nodes of the light cut of one gather point, (n, 16)."""
    job = view.job
    level = estimate_radiance(job.transport, job.batch, job.direct, job.mean, 1000, 8).radiance[row]
    one = job.batch.select(mi.UInt32(row))
    threshold, sizes = limited_cuts(job.lights, one, dr.opaque(mi.Float, ERROR * level), 1000)
    chunks = [chunk for chunk in collect_cuts(job.lights, one, threshold, sizes) if chunk.group is view.group]
    return view.group.tree.records()[np.concatenate([download(chunk.nodes) for chunk in chunks])]


def ancestors(tree, least):
    """For every point along a tree, the node above it at the first level with ``least`` nodes or more."""
    sizes = np.diff(tree.levels)
    level = int(np.argmax(sizes >= least)) if (sizes >= least).any() else len(sizes) - 1
    node, parent = tree.leaf.astype(np.int64), tree.parent.astype(np.int64)
    while (below := node >= tree.levels[level + 1]).any():
        node[below] = parent[node[below]]
    return node


def painted(view, job, order, label, pixels):
    """The picture with every pixel in the colour of its cluster, by the label of the points along ``order``."""
    _, number = np.unique(label, return_inverse=True)
    colour = np.zeros((view.height * view.width, 3))
    colour[download(job.ray)[order] // view.samples] = colours(number.max() + 1)[number]
    grey = pixels.mean(2, keepdims=True) / 255
    return (colour.reshape(view.height, view.width, 3) * (0.35 + 0.65 * grey) * 255).astype(np.uint8)


def points(view, pixels):
    """Clusters of gather points: two levels of IlluminationCut's tree, LightSlice's slices."""
    job, tree = view.job, PointClusters(view.job.batch).tree
    slices = PointClusters(job.batch, partial(build_slices, slices=200)).tree
    kinds = {
        "point tree, a level of few nodes": (tree.order, ancestors(tree, 60)),
        "the same tree, further down": (tree.order, ancestors(tree, 1500)),
        "200 slices": (slices.order, slices.leaf),
    }
    figure, axes = panels(list(kinds), view.height / view.width)
    for axis, (order, label) in zip(axes, kinds.values(), strict=True):
        axis.imshow(painted(view, job, order, label, pixels))
    save(figure, "points")


def channel(view, name, aov):
    """A channel of the image by the integrator of a name, (height, width)."""
    settings = {"max_depth": DEPTH, "vpl_count": LIGHTS, "error": ERROR, "aovs": aov}
    return np.array(mi.render(view.scene, integrator=mi.load_dict({"type": name, **settings}), spp=4))[..., -1]


def bounds(view, _pixels):
    """Number of bounds computed for each pixel, for cuts per point and for shared cuts."""
    found = {name: channel(view, name, "upper_bounds") for name in ("lightcuts", "mdlightcuts", "illuminationcut")}
    figure, axes = panels([f"{name}: {values.mean():.0f} a pixel" for name, values in found.items()], 1)
    scale = matplotlib.colors.LogNorm(1, np.percentile(found["lightcuts"], 99.5))
    for axis, values in zip(axes, found.values(), strict=True):
        shown = axis.imshow(np.maximum(values, 1), cmap="magma", norm=scale)
    figure.colorbar(shown, ax=list(axes), fraction=0.016, pad=0.01).ax.tick_params(labelsize=7)
    save(figure, "bounds")


def learned(_view, _pixels):
    """What adaptive sampling of direct light does in a hall with 1000 emitters."""
    scene = mi.load_file(str(ROOT / "scenes" / "hall.xml"), resx="256", resy="144")
    plugin = mi.load_dict({"type": "adaptivedirect", "aovs": "shadow_rays,visible"})
    image = np.array(mi.render(scene, integrator=plugin, spp=16))
    titles = ["direct light of 1000 emitters", "shadow rays of each pixel", "share of them that found light"]
    figure, axes = panels(titles, 144 / 256)
    axes[0].imshow(images.tone_map(image[..., :3], images.automatic_exposure(image[..., :3])))
    for axis, values in zip(axes[1:], (image[..., -2], image[..., -1]), strict=True):
        shown = axis.imshow(values, cmap="magma", vmin=0, vmax=np.percentile(values, 99.5))
        figure.colorbar(shown, ax=axis, fraction=0.026, pad=0.02).ax.tick_params(labelsize=7)
    save(figure, "learned")


def split(view, _pixels):
    """The traced part of `manylights`, the part of its virtual lights, and the sum."""
    plugin = mi.load_dict({"type": "manylights", "max_depth": DEPTH})
    with single_classes() as chosen:
        whole = np.array(mi.render(view.scene, integrator=plugin, spp=256))[..., :3]
        chosen.gathers = False
        traced = np.array(mi.render(view.scene, integrator=plugin, spp=256))[..., :3]
    figure, axes = panels(["traced", "from virtual lights", "the sum: the image of path"], 1)
    for axis, image in zip(axes, (traced, whole - traced, whole), strict=True):
        axis.imshow(images.tone_map(image, images.automatic_exposure(whole)))
    save(figure, "split")


def matrix(_view, _pixels):
    """The matrices of matrix recovery for a slice of the Cornell box."""
    view = View("cornell", samples=4, integrator="matrixrecovery", vpl_count=50_000)
    draw_slice(view.plugin, view.job, 20, FOLDER / "matrix.png", {"scene": "cornell"})


def light_groups(_view, _pixels):
    """The light of the lamps, of the sun and of the sky, from one render, and a mixture."""
    scene = mi.load_file(str(ROOT / "scenes" / "blender_room.xml"))
    groups = "lamps=AreaLight; sun=DirectionalEmitter; sky=EnvironmentMapEmitter"
    plugin = mi.load_dict({"type": "manylights", "max_depth": DEPTH, "light_groups": groups})
    planes = np.array(mi.render(scene, integrator=plugin, spp=256))
    whole, lamps, sun, sky = (planes[..., first : first + 3] for first in (0, 3, 6, 9))
    figure, axes = panels(["image", "lamps", "sun", "sky", "lamps, and a twentieth of the sky"], 192 / 256)
    for axis, image in zip(axes, (whole, lamps, sun, sky, lamps + sky / 20), strict=True):
        axis.imshow(images.tone_map(image, images.automatic_exposure(image)))
    save(figure, "light_groups")


FIGURES = {
    "light_tree": light_tree,
    "cuts": cuts,
    "points": points,
    "bounds": bounds,
    "learned": learned,
    "split": split,
    "light_groups": light_groups,
    "matrix": matrix,
}


def main(names):
    FOLDER.mkdir(exist_ok=True)
    view = View("cornell")
    pixels = view.pixels()
    for name in names or FIGURES:
        FIGURES[name](view, pixels)
        print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
