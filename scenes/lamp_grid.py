"""Generate a room with 880 equal rectangular lamps in its ceiling.

Purpose: many emitters of which each is as good as any other, so that a uniform choice is the best choice and learning
or a tree over the emitters only costs time.

    python scenes/lamp_grid.py --output scenes/lamp_grid.xml
"""

import numpy as np
from elements import ball, box, drum, flat, header, material, numbers, write_scene

LENGTH, WIDTH, HEIGHT, WALL = 11.0, 8.0, 3.0, 0.15  # of the room, in metres
COLUMNS, ROWS, HALF = 40, 22, 0.04  # lamps along and across the room; half of the side of a lamp
RADIANCE = (14, 13, 11)
MATERIALS = [
    material("lamp", (0.5, 0.5, 0.5)),
    material("plaster", (0.75, 0.73, 0.70)),
    material("floor", (0.35, 0.25, 0.17), "plastic", 0.15),
    material("green", (0.2, 0.42, 0.22)),
    material("clay", (0.62, 0.40, 0.28)),
    material("steel", (0.6, 0.6, 0.62), "metal", 0.2),
]


def shell():
    """Yield floor, ceiling and walls, one of them coloured."""
    yield box("floor", (-WALL, -WALL, -WALL), (LENGTH + WALL, WIDTH + WALL, 0))
    yield box("plaster", (-WALL, -WALL, HEIGHT), (LENGTH + WALL, WIDTH + WALL, HEIGHT + WALL))
    for name, y in (("plaster", -WALL), ("green", WIDTH)):
        yield box(name, (-WALL, y, 0), (LENGTH + WALL, y + WALL, HEIGHT))
    for x in (-WALL, LENGTH):
        yield box("plaster", (x, 0, 0), (x + WALL, WIDTH, HEIGHT))


def lamps():
    """Yield the lamps."""
    emitter = f'<emitter type="area"><rgb name="radiance" value="{numbers(RADIANCE)}"/></emitter>'
    for x in (np.arange(COLUMNS) + 0.5) * LENGTH / COLUMNS:
        for y in (np.arange(ROWS) + 0.5) * WIDTH / ROWS:
            yield flat("rectangle", "lamp", (x, y, HEIGHT - 0.01), (0, 0, -1), (HALF, HALF), emitter)


def things(random):
    """Yield tables with balls and drums on them."""
    for x in (2.5, 5.5, 8.5):
        for y in (2.4, 5.6):
            yield box("clay", (x - 0.7, y - 0.4, 0.7), (x + 0.7, y + 0.4, 0.76))
            yield box("plaster", (x - 0.1, y - 0.1, 0), (x + 0.1, y + 0.1, 0.7))
            yield ball("steel" if random.random() < 0.5 else "clay", (x - 0.35, y, 0.94), 0.18)
            yield from drum("plaster", (x + 0.35, y, 0.76), 0.13, random.uniform(0.15, 0.4))


def room(seed):
    """Return the scene as XML text, determined by the seed."""
    command = f"lamp_grid.py --seed {seed} --output scenes/lamp_grid.xml"
    camera = (70, (0.5, 0.6, 1.6), (7, 4.6, 1.0))
    parts = [header(command, "A room with 880 equal lamps", *camera, 6), *MATERIALS, *shell(), *lamps()]
    return "\n".join([*parts, *things(np.random.default_rng(seed)), "</scene>"]) + "\n"


def main(arguments=None):
    write_scene(__doc__, "lamp_grid", room, arguments=arguments)


if __name__ == "__main__":
    main()
