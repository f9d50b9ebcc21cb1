"""Build time of a light tree by stage, and its quality.

    python benchmarks/light_tree.py            # build times, 10,000 to 1.2 million lights
    python benchmarks/light_tree.py --cuts     # cut sizes for the parameters of vpl/lights/light_tree.py

The lights lie on the surfaces of a room with boxes and spheres. The cost of a tree is the sum of the paper's cluster
sizes over its inner nodes; "halved" is a balanced tree over the lights in Morton order.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks import results
from vpl.lights import light_tree
from vpl.lights.light_tree import BOX_MAX, BOX_MIN, CONE_AXIS, CONE_COS, INTENSITY, build_light_tree

SIZE = np.array([10.0, 8.0, 3.0])
STAGES = ("_validate", "_sort_lights", "_start_clusters", "_cluster", "_assemble")


def room(count, rng, roughness=0.0):
    """Oriented lights, uniform by area, on the walls of a room and on 60 boxes and 20 spheres inside.

    roughness: standard deviation of a random perturbation of the normals, similar to a bump map.
    """
    boxes = [(np.zeros(3), SIZE, -1)]
    for _ in range(60):
        extent = rng.uniform(0.1, 1.2, 3)
        corner = rng.uniform(0, 1, 3) * (SIZE - extent)
        boxes.append((corner, corner + extent, 1))
    faces = [(low, high, sign, axis, side) for low, high, sign in boxes for axis in range(3) for side in (0, 1)]
    spheres = [(rng.uniform(0, 1, 3) * SIZE, rng.uniform(0.1, 0.6)) for _ in range(20)]
    areas = [np.prod(np.delete(high - low, axis)) for low, high, _, axis, _ in faces]
    areas = np.array(areas + [4 * np.pi * radius**2 for _, radius in spheres])
    surface = rng.choice(len(areas), count, p=areas / areas.sum())
    position, direction = np.empty((count, 3)), np.zeros((count, 3))
    for number, (low, high, sign, axis, side) in enumerate(faces):
        here = np.flatnonzero(surface == number)
        position[here] = low + rng.random((len(here), 3)) * (high - low)
        position[here, axis] = (low, high)[side][axis]
        direction[here, axis] = sign * (2 * side - 1)
    for number, (centre, radius) in enumerate(spheres, len(faces)):
        here = np.flatnonzero(surface == number)
        direction[here] = normalised(rng.normal(size=(len(here), 3)))
        position[here] = centre + radius * direction[here]
    direction = normalised(direction + roughness * rng.normal(size=direction.shape))
    return as_float32(position, direction, bounce_flux(count, rng))


def ellipsoids(count, rng):
    """Oriented lights on 80 rotated ellipsoids in the same volume."""
    position, direction = np.empty((count, 3)), np.empty((count, 3))
    owner = rng.integers(0, 80, count)
    for number in range(80):
        here = np.flatnonzero(owner == number)
        on_sphere = normalised(rng.normal(size=(len(here), 3)))
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        axes = rng.uniform(0.05, 1, 3)
        position[here] = rng.uniform(0, 1, 3) * SIZE + (on_sphere * axes) @ rotation
        direction[here] = normalised((on_sphere / axes) @ rotation)
    return as_float32(position, direction, bounce_flux(count, rng))


def bounce_flux(count, rng):
    """Random flux, halved at each of up to three bounces."""
    return rng.uniform(0.2, 1, (count, 3)) * 0.5 ** rng.integers(0, 4, (count, 1))


def normalised(vector):
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def as_float32(*arrays):
    return tuple(array.astype(np.float32) for array in arrays)


def halved(position, direction, flux):
    """Balanced tree: neighbours in Morton order merge in pairs, level by level."""
    count = len(flux)
    node, made, rounds = np.arange(count), count, []
    while len(node) > 1:
        pairs = len(node) // 2
        rounds.append((slice(made, made + pairs), node[0 : 2 * pairs : 2], node[1 : 2 * pairs : 2]))
        node = np.concatenate([np.arange(made, made + pairs), node[2 * pairs :]])
        made += pairs
    order = light_tree._sort_lights(position, direction)
    return light_tree._assemble(order, rounds, position, direction, flux, np.random.default_rng(0))


def total_cost(tree):
    """Sum of the cluster sizes [LC, section 5] of the inner nodes, relative to the scene's intensity and size."""
    record = tree.records.astype(np.float64)
    squared = ((record[:, BOX_MAX] - record[:, BOX_MIN]) ** 2).sum(axis=1)
    size = record[:, INTENSITY] * (squared / squared[0] + (1 - record[:, CONE_COS]) ** 2)
    return size[tree.escape > np.arange(len(size)) + 1].sum() / record[0, INTENSITY]


def timed_stages():
    """Wrap the build stages so that they record their seconds in the returned dictionary."""
    seconds = {}

    def timed(name, function):
        def wrapper(*arguments):
            begin = time.perf_counter()
            result = function(*arguments)
            seconds[name] = time.perf_counter() - begin
            return result

        return wrapper

    for name in STAGES:
        setattr(light_tree, name, timed(name, getattr(light_tree, name)))
    return seconds


def benchmark_builds(counts) -> Iterator[dict]:
    """Print the seconds of builds, and the quality of their trees; yields the rows so far."""
    print(f"{'lights':>9} {'seconds':>8}  " + " ".join(f"{name[1:]:>14}" for name in STAGES), end="")
    print(f"  {'depth':>5} {'cost':>7} {'halved':>7} {'ratio':>6}")
    seconds, rows = timed_stages(), {}
    for count in counts:
        lights = room(count, np.random.default_rng(1))
        build_light_tree(*lights, np.random.default_rng(0))  # warm-up: touches the memory
        begin = time.perf_counter()
        tree = build_light_tree(*lights, np.random.default_rng(0))
        total = time.perf_counter() - begin
        stages = " ".join(f"{seconds[name]:14.3f}" for name in STAGES)
        cost, baseline = total_cost(tree), total_cost(halved(*lights))
        rows[count] = {"seconds": total, "depth": tree.depth, "cost": cost, "halved": {"cost": baseline}}
        print(f"{count:9d} {total:8.3f}  {stages}  {tree.depth:5d} {cost:7.2f} {baseline:7.2f} {cost / baseline:6.2f}")
        yield rows


# --- Cuts ---


def largest_cosine(axis, centre, extent):
    """Upper bound of the cosine between unit axes and vectors from the origin to points of boxes, all (m, 3)."""
    helper = np.where(np.abs(axis[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = normalised(np.cross(axis, helper))
    square_near = square_far = 0
    for across in (first, np.cross(axis, first)):
        middle, half = np.abs((centre * across).sum(axis=1)), (extent * np.abs(across)).sum(axis=1)
        square_near = square_near + np.maximum(middle - half, 0) ** 2
        square_far = square_far + (middle + half) ** 2
    along = (centre * axis).sum(axis=1) + (extent * np.abs(axis)).sum(axis=1)
    square = np.where(along > 0, square_near, square_far) + along**2
    return np.divide(along, np.sqrt(square), out=np.ones_like(along), where=square > 0)


def node_bounds(record, point, normal, shortest):
    """Upper bounds of the contributions of nodes to diffuse receivers: intensity × cosines / squared distance."""
    low, high = record[:, BOX_MIN], record[:, BOX_MAX]
    centre, extent = (low + high) / 2 - point, (high - low) / 2
    squared = (np.maximum(np.maximum(low - point, point - high), 0) ** 2).sum(axis=1)
    emitted = np.arccos(np.clip(largest_cosine(record[:, CONE_AXIS], -centre, extent), -1, 1))
    emitted = np.cos(np.clip(emitted - np.arccos(record[:, CONE_COS]), 0, np.pi / 2))
    received = np.maximum(largest_cosine(normal, centre, extent), 0)
    inside = squared == 0
    cosines = np.where(inside, 1, np.where(emitted < 1e-9, 0, emitted) * received)
    return record[:, INTENSITY] * cosines / np.maximum(squared, shortest**2)


def cut_size(tree, lights, receivers, error=0.02):
    """Mean over receivers: nodes in a cut with bounds below ``error`` times the total, and computed bounds."""
    position, direction, flux = (array.astype(np.float64) for array in lights)
    record = tree.records.astype(np.float64)
    shortest = 0.01 * np.linalg.norm(record[0, BOX_MAX] - record[0, BOX_MIN])
    point, normal = position[receivers] + 1e-3 * direction[receivers], direction[receivers]
    total = np.empty(len(receivers))
    for number in range(len(receivers)):
        to_light = position - point[number]
        squared = (to_light**2).sum(axis=1)
        cosines = (
            np.maximum(to_light @ normal[number], 0) * np.maximum(-(to_light * direction).sum(axis=1), 0) / squared
        )
        total[number] = (flux.mean(axis=1) * cosines / np.maximum(squared, shortest**2)).sum()
    receiver, node, used, computed = np.arange(len(receivers)), np.zeros(len(receivers), np.int64), 0, 0
    while len(node):
        computed += len(node)
        bound = node_bounds(record[node], point[receiver], normal[receiver], shortest)
        refine = (bound > error * total[receiver]) & (tree.escape[node] != node + 1)
        used += ((bound > 0) & ~refine).sum()
        first = node[refine] + 1
        node = np.concatenate([first, tree.escape[first].astype(np.int64)])
        receiver = np.concatenate([receiver[refine]] * 2)
    return used / len(receivers), computed / len(receivers)


def benchmark_cuts(count):
    print(f"{count} lights, cut of 2%, mean of 200 receivers: nodes in the cut, computed bounds, cost of the tree")
    for name, make in (
        ("flat walls", room),
        ("bumpy walls", lambda count, rng: room(count, rng, roughness=0.25)),
        ("ellipsoids", ellipsoids),
    ):
        rng = np.random.default_rng(7)
        lights = make(count, rng)
        receivers = rng.choice(count, 200, replace=False)
        trees = {
            f"angular weight 1/{round(1 / weight)}": {"angular_weight": weight} for weight in (1, 1 / 4, 1 / 16, 1 / 64)
        }
        trees |= {f"window {window}": {"window": window} for window in (4, 8, 32)}
        trees = {label: build_light_tree(*lights, rng, **options) for label, options in trees.items()}
        for label, tree in (trees | {"halved": halved(*lights)}).items():
            used, computed = cut_size(tree, lights, receivers)
            print(f"  {name:12} {label:20} {used:7.1f} {computed:8.1f} {total_cost(tree):7.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuts", action="store_true", help="compare cut sizes instead of build times")
    parser.add_argument("counts", nargs="*", type=int, help="numbers of lights")
    results.add_json_option(parser)
    arguments = results.parse(parser)
    if arguments.cuts and arguments.json:
        parser.error("--json writes build times, not --cuts")
    if arguments.cuts:
        for count in arguments.counts or [60_000]:
            benchmark_cuts(count)
    else:
        builds = benchmark_builds(arguments.counts or [10_000, 50_000, 200_000, 650_000, 1_200_000])
        results.write_rows(arguments.json, "builds", {}, builds)


if __name__ == "__main__":
    main()
