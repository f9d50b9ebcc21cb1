"""Generate a hall with rows of gauze veils on both sides of an aisle.

Purpose: expensive shadow rays. Rays between walls intersect a dozen masks, surface by surface. `--veils` varies the
cost of a ray, to find the cost above which a method with few rays pays off; without veils the hall is a plain room.
Next-event estimation does not pass veils, as in Mitsuba's integrators; `path` finds emitters behind veils only by BSDF
sampling, and `direct="vpl"` includes their light. Each veil counts as an edge of the path.

    python scenes/veils.py --output scenes/veils.xml
"""

import numpy as np
from elements import ball, box, drum, flat, glow, header, material, numbers, write_scene

LENGTH, HALF, HEIGHT, WALL, AISLE = 9.0, 3.0, 3.4, 0.15, 0.9  # metres; walls are at |y| = HALF
OPACITY = 0.05  # fraction of the light blocked by a veil
COLOURS = [(1.0, 0.88, 0.72), (1.0, 0.8, 0.6), (0.8, 0.9, 1.0)]
MATERIALS = [
    material("lamp", (0.6, 0.6, 0.6)),
    material("plaster", (0.76, 0.74, 0.70)),
    material("floor", (0.42, 0.36, 0.30)),
    material("red", (0.60, 0.14, 0.10)),
    material("blue", (0.14, 0.22, 0.52)),
    material("clay", (0.62, 0.44, 0.30)),
]
GAUZE = (
    f'<bsdf type="mask" id="gauze"><float name="opacity" value="{OPACITY}"/><bsdf type="twosided">'
    f'<bsdf type="diffuse"><rgb name="reflectance" value="{numbers((0.8, 0.78, 0.74))}"/></bsdf></bsdf></bsdf>'
)


def shell():
    """Yield floor, ceiling and walls, two of them coloured."""
    yield box("floor", (-WALL, -HALF, -WALL), (LENGTH, HALF, 0))
    yield box("plaster", (-WALL, -HALF, HEIGHT), (LENGTH, HALF, HEIGHT + WALL))
    yield box("red", (-WALL, HALF, 0), (LENGTH, HALF + WALL, HEIGHT))
    yield box("blue", (-WALL, -HALF - WALL, 0), (LENGTH, -HALF, HEIGHT))
    for x in (-WALL, LENGTH):
        yield box("plaster", (x, -HALF, 0), (x + WALL, HALF, HEIGHT))


def things(random):
    """Yield ceiling lamps, and pedestals with balls and boxes."""
    for x in (1.5, 4.5, 7.5):
        for side in (-1, 1):
            colour = COLOURS[random.integers(len(COLOURS))]
            yield flat("rectangle", "lamp", (x, 2.0 * side, HEIGHT - 0.01), (0, 0, -1), (0.5, 0.15),
                       glow(30, colour, random))  # fmt: skip
    for x in (3.0, 4.6, 6.2, 7.6):
        y, height = random.uniform(-0.5, 0.5), random.uniform(0.5, 1.0)
        yield from drum("plaster", (x, y, 0), 0.28, height)
        if random.random() < 0.5:
            yield ball("clay", (x, y, height + 0.25), 0.25)
        else:
            yield box("clay", (x - 0.2, y - 0.2, height), (x + 0.2, y + 0.2, height + 0.4), (x, y), 30)


def hangings(count, random):
    """Yield the veils, half on each side of the aisle: vertical, along the hall, slightly rotated."""
    for number in range(count):
        side, row = (-1, 1)[number % 2], (number // 2 + 0.5) / ((count + 1) // 2)
        place = (0.5 * LENGTH + random.uniform(-0.3, 0.3), side * (AISLE + row * (HALF - AISLE - 0.2)), 0.5 * HEIGHT)
        angle = np.radians(random.uniform(-1, 1))
        yield flat("rectangle", "gauze", place, (np.sin(angle), -side * np.cos(angle), 0), (3.6, 1.4))


def hall(seed, veils):
    """Return the scene as XML text, determined by the seed."""
    random = np.random.default_rng(seed)
    command = f"veils.py --seed {seed} --veils {veils} --output scenes/veils.xml"
    camera = (75, (0.2, -0.3, 1.7), (6, 0.3, 1.3))
    parts = [header(command, "A hall with rows of veils", *camera, 24), *MATERIALS, GAUZE, *shell()]
    return "\n".join([*parts, *things(random), *hangings(veils, random), "</scene>"]) + "\n"


def main(arguments=None):
    write_scene(__doc__, "veils", hall, arguments=arguments, counts={"veils": 16})


if __name__ == "__main__":
    main()
