"""Generate a forest clearing at night with 138 lanterns and a moonlit sky behind the trees.

Purpose: methods that learn, per pixel, which of many lights are visible. The numbers of lights match `Ponderosa` in
Donikian et al., "Accurate direct illumination using iterative adaptive sampling" (2006), Table 1: 138 point lights and
an environment map; an average point sees a few percent of the lights. The lights hang in shades and cages on strings
and posts, in a cabin, under the roofs of two stalls and among the trees. About a hundred trees with thousands of leaves
each occlude the sky. The trees are instances of meshes written beside the scene, as is the sky.

    python scenes/forest_lights.py --output scenes/forest_lights.xml
"""

from itertools import pairwise

import numpy as np
from elements import box, bulb, drum, header, material, numbers, sky, sky_image, slab, tube, write_scene

CLEARING = 6.0  # metres, radius of the clearing; the ground is 2 * GROUND wide
GROUND = 45.0
CAMERA, TARGET = (-1.3, -6.0, 1.8), (0.9, 2.2, 2.15)
CABIN = (0.6, 5.0, 2.6, 6.2, 2.4)  # x, x, y, y, height of the walls
DOOR, WINDOW = (1.2, 2.1, 0.0, 2.0), (3.0, 4.2, 0.95, 1.75)  # x, x, z, z in the cabin's front wall
STALLS = ((-4.6, 1.2, 58.0), (-2.9, 4.6, 28.0))  # x, y, rotation in degrees from facing -y
POSTS = ((-1.9, -0.6), (1.2, -2.6), (3.3, 0.6), (-0.4, 2.4), (4.4, -1.6), (-3.2, -2.2), (2.1, 1.6), (-1.6, 3.6))
SKY = "forest_sky.exr"
TREES, BUSHES = 105, 60
LEAVES = 24  # per branch

WARM, WHITE, AMBER = (1.0, 0.58, 0.25), (1.0, 0.82, 0.6), (1.0, 0.42, 0.12)

MATERIALS = [
    material("soil", (0.17, 0.14, 0.09)),
    material("path", (0.33, 0.30, 0.26)),
    material("bark", (0.22, 0.14, 0.09)),
    material("spruce_needles", (0.10, 0.20, 0.09)),
    material("pine_needles", (0.18, 0.27, 0.09)),
    material("leaves", (0.24, 0.30, 0.08)),
    material("log", (0.38, 0.23, 0.12)),
    material("plank", (0.45, 0.30, 0.17)),
    material("shingle", (0.25, 0.13, 0.10)),
    material("canvas", (0.60, 0.16, 0.11)),
    material("iron", (0.30, 0.28, 0.26), "metal", 0.3),
    material("copper", (0.85, 0.50, 0.32), "metal", 0.25),
    material("glaze", (0.14, 0.28, 0.42), "plastic", 0.15),
    material("rope", (0.10, 0.08, 0.06)),
]


def lathe(profile, sides):
    """Return the triangles (n, 3, 3) of the surface of revolution of a profile of (radius, z) about the z axis."""
    turn = np.arange(sides + 1) / sides * 2 * np.pi
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    rings = [radius * ring + (0, 0, z) for radius, z in profile]
    faces = []
    for low, high in pairwise(rings):
        faces += [np.stack([low[:-1], low[1:], high[1:]], axis=1), np.stack([low[:-1], high[1:], high[:-1]], axis=1)]
    return np.concatenate(faces)


def leaves(places, outward, length, width, random):
    """Return a triangle at each of `places`, pointing approximately `outward`."""
    outward = outward + random.normal(0, 0.35, outward.shape)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    across = np.cross(outward, random.normal(0, 1, outward.shape))
    across *= width / 2 / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([places - across, places + across, places + length * outward], axis=1)


def crown(low, high, reach, droop, branches, random):
    """Return the triangles of a tree crown from height `low` to `high`: leaves along branches around the axis; `reach`
    maps the relative height to the length of a branch in metres."""
    t = np.repeat(np.sort(random.uniform(0, 1, branches)) ** 0.9, LEAVES)
    azimuth = np.repeat(random.uniform(0, 2 * np.pi, branches), LEAVES)
    along = random.uniform(0.15, 1, t.shape) ** 0.8
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    far = reach(t) * along
    places = direction * far[:, None] + random.normal(0, 0.08, direction.shape)
    places[:, 2] += low + t * (high - low) + droop * far
    return leaves(places, direction + (0, 0, droop), 0.42, 0.17, random)


def bush(random):
    """Return the triangles of a bush: leaves around a flattened ball."""
    outward = random.normal(0, 1, (900, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    places = outward * random.uniform(0.4, 0.7, (900, 1)) * (1, 1, 0.75) + (0, 0, 0.4)
    return leaves(places[places[:, 2] > 0], outward[places[:, 2] > 0], 0.22, 0.12, random)


def meshes():
    """Return mesh file name -> triangles, deterministic."""
    random = np.random.default_rng(11)
    return {
        "forest_trunk.ply": lathe([(0.26, -0.1), (0.17, 1.0), (0.13, 7.0), (0.02, 13.0)], 9),
        "forest_shade.ply": lathe([(0.13, 0.0), (0.11, 0.2), (0.05, 0.27), (0.0, 0.28)], 12),
        "forest_spruce.ply": crown(0.7, 13.2, lambda t: 0.25 + 2.5 * (1 - t) ** 0.8, -0.25, 280, random),
        "forest_pine.ply": crown(5.2, 13.4, lambda t: 0.5 + 2.6 * np.sin(np.pi * (0.2 + 0.8 * t)), 0.2, 280, random),
        "forest_bush.ply": bush(random),
    }


def groups():
    """Yield the shape groups for instances: trees, a bush, a shade open at the bottom, a lantern cage."""

    def mesh(name, file):
        return (
            f'<shape type="ply"><string name="filename" value="forest_{file}.ply"/>'
            f'<boolean name="face_normals" value="true"/><ref id="{name}"/></shape>'
        )

    cage = [box("iron", (-0.1, -0.1, -0.16), (0.1, 0.1, -0.14)), box("iron", (-0.13, -0.13, 0.14), (0.13, 0.13, 0.16))]
    for angle in np.arange(12) * np.pi / 6:
        x, y = 0.095 * np.cos(angle), 0.095 * np.sin(angle)
        cage.append(slab("iron", (x, y, 0), (0.012, 0.036, 0.28), "z", np.degrees(angle)))
    for name, parts in (
        ("spruce", [mesh("spruce_needles", "spruce"), mesh("bark", "trunk")]),
        ("pine", [mesh("pine_needles", "pine"), mesh("bark", "trunk")]),
        ("bush", [mesh("leaves", "bush")]),
        ("shade", [mesh("copper", "shade")]),
        ("cage", cage),
    ):
        yield f'<shape type="shapegroup" id="{name}">'
        yield from parts
        yield "</shape>"


def instance(group, position, scale=1.0, angle=0.0):
    return (
        f'<shape type="instance"><transform name="to_world"><scale value="{scale:.3g}"/>'
        f'<rotate z="1" angle="{angle:.4g}"/><translate value="{numbers(position)}"/></transform>'
        f'<ref id="{group}"/></shape>'
    )


def tree_places(random):
    """Sample tree positions: outside the clearing, denser near it, apart from each other and from the cabin."""
    places = []
    while len(places) < TREES:
        distance, azimuth = CLEARING + 0.5 + 24 * random.random() ** 1.6, random.uniform(0, 2 * np.pi)
        x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
        in_cabin = CABIN[0] - 1.0 < x < CABIN[1] + 1.0 and CABIN[2] < y < CABIN[3] + 1.0
        if in_cabin or np.hypot(x - CAMERA[0], y - CAMERA[1]) < 4.3:
            continue
        if all(np.hypot(x - a, y - b) > 1.5 for a, b in places):
            places.append((x, y))
    return places


def forest(random):
    """Return the ground, trees and bushes, and the positions of the trees."""
    places = tree_places(random)
    parts = [box("soil", (-GROUND, -GROUND, -0.5), (GROUND, GROUND, 0))]
    for index, (x, y) in enumerate(places):
        kind = "spruce" if index % 3 else "pine"
        parts.append(instance(kind, (x, y, 0), random.uniform(0.8, 1.25), random.uniform(0, 360)))
    for _ in range(BUSHES):
        distance, azimuth = CLEARING + random.uniform(-0.6, 9), random.uniform(0, 2 * np.pi)
        x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
        if np.hypot(x - CAMERA[0], y - CAMERA[1]) > 3.2 and not (CABIN[0] - 0.8 < x < CABIN[1] + 0.8 and y > 1.5):
            parts.append(instance("bush", (x, y, 0), random.uniform(0.7, 1.5), random.uniform(0, 360)))
    for t in np.linspace(0, 1, 12):
        x, y = -1.2 + 2.8 * t + 0.5 * np.sin(5 * t), -6 + 8.3 * t
        parts += drum("path", (x, y, 0), round(random.uniform(0.3, 0.42), 3), 0.03)
    return parts, places


def cabin():
    """Yield the log cabin: courses of logs around door and window, a gable roof, a porch, a table inside."""
    x0, x1, y0, y1, top = CABIN
    for index, z in enumerate(np.arange(0, top, 0.24)):
        out, high = 0.04 * (index % 2), min(z + 0.24, top)
        cuts = [x0, x1]
        for start, end, low, until in (DOOR, WINDOW):
            if low - 0.12 < z < until - 0.12:
                cuts += [start, end]
        cuts.sort()
        for start, end in zip(cuts[::2], cuts[1::2], strict=True):
            yield box("log", (start, y0 - out, z), (end, y0 + 0.18, high))
        yield box("log", (x0 - out, y0 + 0.18, z), (x0 + 0.18, y1, high))
        yield box("log", (x1 - 0.18, y0 + 0.18, z), (x1 + out, y1, high))
        yield box("log", (x0, y1 - 0.18, z), (x1, y1, high))
    ridge, width = (y0 + y1) / 2, (y1 - y0) / 2
    for index in range(6):  # stepped gables
        inset = width * (index + 0.6) / 6
        for x in (x0, x1 - 0.18):
            yield box("log", (x, y0 + inset, top + 0.22 * index), (x + 0.18, y1 - inset, top + 0.22 * (index + 1)))
    for side in (-1, 1):
        centre = ((x0 + x1) / 2, ridge + side * 1.15, top + 0.66)
        yield slab("shingle", centre, (x1 - x0 + 0.8, 2.9, 0.1), "x", -side * 36)
    yield slab("shingle", ((x0 + x1) / 2, y0 - 0.75, 2.2), (x1 - x0 + 0.4, 1.5, 0.06), "x", 8)
    for x in (x0, (x0 + x1) / 2 + 0.1, x1):
        yield box("plank", (x - 0.06, y0 - 1.4, 0), (x + 0.06, y0 - 1.28, 2.06))
    yield box("plank", (x0 - 0.1, y0 - 1.45, 0), (x1 + 0.1, y0, 0.08))
    yield box(
        "plank",
        ((WINDOW[0] + WINDOW[1]) / 2 - 0.03, y0, WINDOW[2]),
        ((WINDOW[0] + WINDOW[1]) / 2 + 0.03, y0 + 0.06, 1.8),
    )
    yield box("plank", (2.4, 4.4, 0), (4.4, 5.2, 0.8))
    yield box("canvas", (1.0, 5.6, 0), (4.6, 6.0, 1.5))


def stall(x, y, angle, random):
    """Yield a stall with goods: counter, back, sides, posts and a low sloping roof."""

    def part(name, low, high):
        centre = np.array((x, y, 0))
        return box(name, centre + low, centre + high, (x, y), angle)

    yield part("plank", (-1.1, -0.75, 0), (1.1, -0.2, 0.9))
    yield part("log", (-1.2, 0.75, 0), (1.2, 0.8, 2.1))
    for side in (-1, 1):
        yield part("log", (min(side * 1.2, side * 1.15), -0.2, 0), (max(side * 1.2, side * 1.15), 0.75, 2.1))
        yield part("log", (side * 1.17 - 0.04, -0.85, 0), (side * 1.17 + 0.04, -0.77, 2.1))
    for index in range(5):  # the roof rises towards the back
        yield part(
            "canvas", (-1.4, -1.05 + 0.4 * index, 2.1 + 0.06 * index), (1.4, -0.6 + 0.4 * index, 2.14 + 0.06 * index)
        )
    yield part("canvas", (-1.4, -1.07, 1.8), (1.4, -1.05, 2.14))
    for index in range(9):
        along, out = -0.9 + 0.22 * index, random.uniform(-0.65, -0.35)
        name, half = random.choice(["glaze", "copper", "canvas", "plank"]), random.uniform(0.05, 0.09)
        yield part(name, (along - half, out - half, 0.9), (along + half, out + half, 0.9 + random.uniform(0.08, 0.3)))


def shaded(position, intensity, colour, random):
    """Yield a lantern in a shade, which limits its light to downward directions."""
    x, y, z = position
    yield instance("shade", position)
    yield bulb((x, y, z + 0.19), intensity, colour, random)


def caged(position, intensity, colour, random):
    """Yield a lantern in a cage, whose bars occlude part of its light."""
    yield instance("cage", position, angle=random.uniform(0, 360))
    yield bulb(position, intensity, colour, random)


def strings(random):
    """Yield 60 lanterns in shades on five sagging ropes across the clearing."""
    for azimuth, shift in ((20, -2.4), (65, 0.6), (110, 2.2), (160, -0.8), (150, 3.0)):
        along = np.array((np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))))
        middle, last = shift * np.array((-along[1], along[0])), None
        for t in np.linspace(-1, 1, 14):
            x, y = middle + t * 6.2 * along
            knot = (x, y, 3.1 + 1.1 * t * t)
            if last:
                yield tube("rope", last, knot, 0.008)
            last = knot
            if abs(t) < 1:  # 12 of the 14 knots
                yield from shaded((x, y, knot[2] - 0.32), 7, (WARM, AMBER)[azimuth % 20 == 0], random)


def lanterns(places, random):
    """Yield all 138 lights and their fittings; `places` are the positions of the trees."""
    yield from strings(random)  # 60
    for x, y in POSTS:  # 8
        yield box("iron", (x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 1.3))
        yield from caged((x, y, 1.46), 5, WARM, random)
    x0, x1, y0, y1, _ = CABIN
    for x in np.linspace(x0 + 0.5, x1 - 0.5, 6):  # 18 in the cabin, visible from outside through door and window only
        for y, z in ((y0 + 0.6, 2.3), (4.4, 2.0), (y1 - 0.5, 2.3)):
            yield bulb((x, y, z), 2.5, WHITE, random)
    for x in np.linspace(x0 + 0.4, x1 - 0.4, 4):  # 4 at the porch
        yield from shaded((x, y0 - 0.8, 1.8), 5, WARM, random)
    for x, y, angle in STALLS:  # 16
        cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        for along in np.linspace(-0.95, 0.95, 8):
            yield bulb((x + along * cosine + 0.75 * sine, y + along * sine - 0.75 * cosine, 2.03), 1.2, WHITE, random)
    near = sorted(places, key=lambda place: np.hypot(place[0], place[1] - 3))
    for x, y in near[:32]:  # 32 among the trees, on their sides facing the clearing
        scale = 1 - 0.5 / np.hypot(x, y)
        yield from caged((x * scale, y * scale, random.uniform(1.2, 3.2)), 9, AMBER, random)


def clearing(seed):
    """Return the scene as XML text, determined by the seed."""
    plants, power = np.random.default_rng(5), np.random.default_rng(seed)
    command = f"forest_lights.py --seed {seed} --output scenes/forest_lights.xml"
    woods, places = forest(plants)
    parts = [header(command, "A clearing with 138 lanterns", 74, CAMERA, TARGET), *MATERIALS, *groups(), *woods]
    parts += [*cabin(), *(part for place in STALLS for part in stall(*place, plants))]
    return "\n".join([*parts, *lanterns(places, power), sky(SKY), "</scene>"]) + "\n"


def night_sky():
    """Return the texels of a dusk sky with a bright moon, high enough to light the clearing."""
    return sky_image((0.6, 1.0, 2.2), (2.6, 1.8, 1.7), (0.02, 0.02, 0.02), (600, 680, 800), (-0.4, 0.3, 1), 5, 0.004)


def main(arguments=None):
    write_scene(__doc__, "forest_lights", clearing, {SKY: night_sky()}, arguments, meshes=meshes())


if __name__ == "__main__":
    main()
