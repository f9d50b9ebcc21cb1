"""Generate a sunlit arcade: a walk between a wall and a row of columns, under a roof of slats, beside an open court.

Purpose: environment emitters behind gaps. Most of the walk sees the sky through narrow openings; sunlight forms stripes
on floor and wall, and these stripes light the remaining surfaces. Columns and slats block most samples of the
environment, and indirect light dominates.

    python scenes/arcade.py --output scenes/arcade.xml
"""

import numpy as np
from elements import ball, box, drum, header, material, sky, sky_image, slab, tube, write_scene

LENGTH, WIDTH, HEIGHT, WALL = 24.0, 4.0, 4.4, 0.35  # metres: x from 0 to LENGTH, y from 0 (columns) to WIDTH (wall)
BAY = 3.0  # distance between columns
ARCH = 2.7  # height of the springing of the arches
COURT = 12.0  # depth of the court behind the columns
SKY, SUN = "arcade_sky.exr", (0.3, -0.6, 0.78)

MATERIALS = [
    material("stone", (0.62, 0.55, 0.44)),
    material("pale", (0.72, 0.68, 0.60)),
    material("tile", (0.55, 0.30, 0.19)),
    material("slate", (0.22, 0.23, 0.26), "plastic", 0.2),
    material("wood", (0.36, 0.22, 0.12)),
    material("door", (0.10, 0.24, 0.30)),
    material("grass", (0.16, 0.26, 0.08)),
    material("leaf", (0.10, 0.30, 0.08)),
    material("pot", (0.55, 0.25, 0.13)),
    material("copper", (0.85, 0.52, 0.35), "metal", 0.25),
]


def shell():
    """Yield the floor, the walls with doors, and the roof of slats."""
    yield box("tile", (0, -0.4, -WALL), (LENGTH, WIDTH, 0))
    for x in np.arange(0, LENGTH, 1.0):
        for y in np.arange(0.1 + (x % 2) * 0.5, WIDTH - 0.5, 1.0):
            yield box("slate", (x + 0.04, y, 0), (x + 0.46, y + 0.42, 0.003))
    yield box("stone", (0, WIDTH, 0), (LENGTH, WIDTH + WALL, HEIGHT))
    yield box("pale", (LENGTH, -0.4, 0), (LENGTH + WALL, WIDTH + WALL, HEIGHT))
    yield box("stone", (-WALL, -0.4, 0), (0, WIDTH + WALL, HEIGHT))
    for x in np.arange(1.5, LENGTH - 1, 2 * BAY):
        yield box("pale", (x - 0.75, WIDTH - 0.06, 0), (x + 0.75, WIDTH, 2.6))
        yield box("door", (x - 0.6, WIDTH - 0.1, 0), (x + 0.6, WIDTH - 0.05, 2.45))
        yield ball("copper", (x + 0.45, WIDTH - 0.14, 1.05), 0.05)
    for x in np.arange(0.3, LENGTH, 0.75):  # the roof transmits a third of the sky
        yield slab("wood", (x, WIDTH / 2, HEIGHT + 0.1), (0.42, WIDTH + 0.8, 0.05), "y", 18)
    for y in (0.0, WIDTH / 2, WIDTH - 0.1):
        yield box("wood", (0, y - 0.08, HEIGHT - 0.12), (LENGTH, y + 0.08, HEIGHT + 0.02))


def arches():
    """Yield the columns and their arches of tilted stones."""
    for x in np.arange(0, LENGTH + 0.1, BAY):
        yield box("pale", (x - 0.32, -0.32, 0), (x + 0.32, 0.32, 0.3))
        yield tube("stone", (x, 0, 0.3), (x, 0, ARCH - 0.2), 0.22)
        yield box("pale", (x - 0.3, -0.3, ARCH - 0.2), (x + 0.3, 0.3, ARCH))
    radius = BAY / 2 - 0.25
    for x in np.arange(BAY / 2, LENGTH, BAY):
        for angle in np.linspace(0, np.pi, 10):
            centre = (x + (radius + 0.1) * np.cos(angle), 0, ARCH + (radius + 0.1) * np.sin(angle) * 0.9)
            yield slab("pale", centre, (0.24, 0.5, 0.48), "y", -np.degrees(angle))
    yield box("stone", (0, -0.22, ARCH + 1.45), (LENGTH, 0.22, HEIGHT - 0.12))


def court():
    """Yield the court behind the columns: grass, a far wall, trees."""
    yield box("grass", (-6, -COURT, -WALL), (LENGTH + 6, -0.4, -0.02))
    yield box("stone", (-6, -COURT - WALL, 0), (LENGTH + 6, -COURT, 3.0))
    for x, y in ((5, -6), (11, -8.5), (17, -5.5), (22, -8)):
        yield tube("wood", (x, y, 0), (x, y, 2.4), 0.14)
        for dx, dy, dz in ((0, 0, 3.2), (0.7, 0.3, 2.7), (-0.6, 0.4, 2.8), (0.1, -0.7, 2.6)):
            yield ball("leaf", (x + dx, y + dy, dz), 0.85)


def furniture(random):
    """Yield benches along the wall and pots between the columns."""
    for x in np.arange(4.5, LENGTH - 2, 2 * BAY):
        yield box("wood", (x - 0.9, WIDTH - 0.6, 0.42), (x + 0.9, WIDTH - 0.12, 0.48))
        for dx in (-0.7, 0.7):
            yield box("stone", (x + dx - 0.1, WIDTH - 0.55, 0), (x + dx + 0.1, WIDTH - 0.15, 0.42))
    for x in np.arange(BAY / 2, LENGTH, 2 * BAY):
        yield from drum("pot", (x, 0.5, 0), 0.24, 0.45)
        for _ in range(9):
            offset = random.uniform(-0.2, 0.2, 3)
            yield ball("leaf", (x + offset[0], 0.5 + offset[1], 0.7 + offset[2]), random.uniform(0.08, 0.16))


def arcade(seed):
    """Return the scene as XML text; the seed determines the plants."""
    command = f"arcade.py --seed {seed} --output scenes/arcade.xml"
    camera = (66, (0.7, 2.9, 1.65), (11, 1.35, 1.6))
    parts = [header(command, "An arcade in the sun", *camera, 6), *MATERIALS]
    parts += [*shell(), *arches(), *court(), *furniture(np.random.default_rng(seed)), sky(SKY)]
    return "\n".join([*parts, "</scene>"]) + "\n"


def texels():
    """Return the texels of a clear sky with a sun visible between the columns."""
    return sky_image((0.12, 0.26, 0.6), (0.42, 0.48, 0.56), (0.05, 0.045, 0.035), (760, 640, 460), SUN, 5, 0.008)


def main(arguments=None):
    write_scene(__doc__, "arcade", arcade, {SKY: texels()}, arguments)


if __name__ == "__main__":
    main()
