"""Generate a kitchen with 72 area emitters, most of them occluded from most points.

Purpose: methods that learn, per pixel, which of many lights are visible. The number of lights matches `Kitchen` in
Donikian et al., "Accurate direct illumination using iterative adaptive sampling" (2006), Table 1: 72 area lights, of
which an average point sees about one in six. The lights are recessed ceiling panels, strips under the cabinets, in the
shelves and at the plinths, coves above the cabinets, bulbs in shades, and lamps of a pantry with a half-open door.
Metal, stone and lacquer are glossy. With `--windows` (the paper's `Kitchen 2`) the sky also shines through two windows
behind the camera.

    python scenes/kitchen_lamps.py --output scenes/kitchen_lamps.xml
    python scenes/kitchen_lamps.py --windows --output scenes/kitchen_windows.xml
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from elements import ball, box, drum, flat, glow, header, material, parser, sky, sky_image, tube, write_image

WIDTH, DEPTH, HEIGHT, WALL = 6.4, 5.6, 2.8, 0.2  # metres; the camera looks along +y from the wall y = 0
PANTRY_X, PANTRY_Y = 4.2, 3.6  # near corner of the pantry, outside its walls
DOOR = (4.5, 5.3, 2.1)  # start x, end x, height
WINDOWS = ((0.8, 2.6), (3.4, 5.2))  # start x, end x
SILL, LINTEL = 0.9, 2.3
COUNTER, CABINETS = 0.9, (1.45, 2.2)  # height of the worktop; lower and upper z
TABLE = (2.5, 2.35)
SKY = "kitchen_sky.exr"

WARM, WHITE, COOL = (1.0, 0.66, 0.36), (1.0, 0.87, 0.72), (0.7, 0.85, 1.0)
DOWN, UP = (0, 0, -1), (0, 0, 1)

MATERIALS = [
    material("lamp", (0.5, 0.5, 0.5)),
    material("plaster", (0.68, 0.64, 0.57)),
    material("sage", (0.34, 0.42, 0.33)),
    material("cream", (0.66, 0.60, 0.48), "plastic", 0.25),
    material("floor", (0.30, 0.18, 0.10), "plastic", 0.3),
    material("inlay", (0.22, 0.12, 0.07), "plastic", 0.3),
    material("wood", (0.36, 0.20, 0.10)),
    material("granite", (0.07, 0.07, 0.08), "plastic", 0.15),
    material("tile", (0.26, 0.40, 0.42), "plastic", 0.12),
    material("steel", (0.72, 0.72, 0.74), "metal", 0.25),
    material("copper", (0.90, 0.55, 0.38), "metal", 0.2),
    material("black", (0.04, 0.04, 0.045), "plastic", 0.2),
    material("red", (0.55, 0.07, 0.05), "plastic", 0.15),
    material("blue", (0.10, 0.20, 0.50), "plastic", 0.15),
    material("yellow", (0.70, 0.48, 0.08), "plastic", 0.15),
    material("china", (0.75, 0.74, 0.70), "plastic", 0.12),
]


def back(low, high):
    """Return the corners of a box at the back wall from coordinates (along the wall, away from the wall, up)."""
    return (low[0], DEPTH - high[1], low[2]), (high[0], DEPTH - low[1], high[2])


def left(low, high):
    """Return the corners of a box at the left wall from coordinates (along the wall, away from the wall, up)."""
    return (low[1], low[0], low[2]), (high[1], high[0], high[2])


def shell():
    """Yield floor, ceiling and walls, with two windows in the wall behind the camera."""
    outer = (-WALL, WIDTH + WALL), (-WALL, DEPTH + WALL)
    yield box("floor", (outer[0][0], outer[1][0], -WALL), (outer[0][1], outer[1][1], 0))
    yield box("plaster", (outer[0][0], outer[1][0], HEIGHT), (outer[0][1], outer[1][1], HEIGHT + WALL))
    for x in np.arange(0.4, WIDTH, 0.8):
        yield box("inlay", (x - 0.02, 0, 0), (x + 0.02, DEPTH, 0.002))
    for x in (-WALL, WIDTH):
        yield box("plaster", (x, outer[1][0], 0), (x + WALL, outer[1][1], HEIGHT))
    yield box("sage", (0, DEPTH, 0), (WIDTH, DEPTH + WALL, HEIGHT))
    for low, high in ((0, SILL), (LINTEL, HEIGHT)):
        yield box("plaster", (0, -WALL, low), (WIDTH, 0, high))
    edges = [0, *np.ravel(WINDOWS), WIDTH]
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield box("plaster", (start, -WALL, SILL), (end, 0, LINTEL))
    for start, end in WINDOWS:
        for x in np.linspace(start, end, 4)[1:-1]:
            yield box("wood", (x - 0.025, -0.13, SILL), (x + 0.025, -0.08, LINTEL))
        yield box("wood", (start, -0.13, 1.75), (end, -0.08, 1.8))


def pantry():
    """Yield the pantry in the far right corner: walls, the half-open door, shelves with jars."""
    x, y = PANTRY_X, PANTRY_Y
    start, end, top = DOOR
    yield box("plaster", (x, y, 0), (x + 0.1, DEPTH, HEIGHT))
    for low, high in (((x, 0), (start, HEIGHT)), ((end, 0), (WIDTH, HEIGHT)), ((start, top), (end, HEIGHT))):
        yield box("plaster", (low[0], y - 0.1, low[1]), (high[0], y, high[1]))
    # The door opens towards the camera with its hinge on the right, so that the gap is visible
    yield box("wood", (start, y - 0.14, 0.01), (end, y - 0.1, top - 0.02), (end, y - 0.1), 52)
    yield box("wood", (start - 0.08, y - 0.12, 0), (start, y - 0.1, top + 0.08))
    yield box("wood", (start, y - 0.12, top), (end, y - 0.1, top + 0.08))
    for z in (0.5, 1.0, 1.5, 2.0):
        yield box("wood", (x + 0.1, DEPTH - 0.4, z), (WIDTH, DEPTH, z + 0.03))
        for index in range(6):
            name = ("red", "china", "yellow", "blue")[(index + int(2 * z)) % 4]
            yield from drum(name, (x + 0.3 + 0.32 * index, DEPTH - 0.2, z + 0.03), 0.08, 0.2)


def counter(side, start, end):
    """Yield base cabinets along the wall `side`: plinth, doors with handles, worktop, splashback."""
    yield box("black", *side((start, 0, 0), (end, 0.5, 0.1)))
    yield box("cream", *side((start, 0, 0.1), (end, 0.56, COUNTER - 0.04)))
    yield box("granite", *side((start, 0, COUNTER - 0.04), (end, 0.62, COUNTER)))
    yield box("tile", *side((start, 0, COUNTER), (end, 0.015, CABINETS[0])))
    doors = np.linspace(start, end, max(2, round((end - start) / 0.48) + 1))
    for a, b in pairwise(doors):
        yield box("cream", *side((a + 0.01, 0.56, 0.12), (b - 0.01, 0.58, COUNTER - 0.06)))
        yield box("steel", *side((a + 0.12, 0.58, 0.74), (b - 0.12, 0.605, 0.755)))


def cabinets(side, start, end):
    """Yield closed cabinets on the wall `side`."""
    low, high = CABINETS
    yield box("cream", *side((start, 0, low), (end, 0.34, high)))
    doors = np.linspace(start, end, round((end - start) / 0.44) + 1)
    for a, b in pairwise(doors):
        yield box("cream", *side((a + 0.008, 0.34, low), (b - 0.008, 0.36, high)))
        yield box("steel", *side((a + 0.05, 0.36, low + 0.08), (a + 0.065, 0.385, low + 0.25)))


def shelves(side, start, end, random):
    """Yield three bays of open shelves in two tiers, with crockery."""
    low, high = CABINETS
    middle = (low + high) / 2
    yield box("cream", *side((start, 0, low), (end, 0.02, high)))
    for z in (low, middle, high - 0.03):
        yield box("cream", *side((start, 0.02, z), (end, 0.34, z + 0.03)))
    bays = np.linspace(start, end, 4)
    for a in bays:
        yield box("cream", *side((a - 0.015, 0.02, low + 0.03), (a + 0.015, 0.335, high - 0.03)))
    for a in bays[:-1]:
        for z in (low + 0.03, middle + 0.03):
            for along in (0.13, 0.27, 0.4):
                corner, _ = side((a + along, 0.16, z), (a + along, 0.16, z))
                name = random.choice(["china", "china", "red", "blue", "yellow", "copper"])
                yield from drum(name, corner, round(random.uniform(0.035, 0.06), 3), random.uniform(0.06, 0.2))


def stove():
    """Yield the cooker with pots and the range hood above."""
    yield box("black", *back((1.95, 0.05, COUNTER), (2.75, 0.56, COUNTER + 0.01)))
    yield box("steel", *back((1.93, 0.58, 0.2), (2.77, 0.6, COUNTER - 0.06)))
    yield box("black", *back((2.03, 0.6, 0.3), (2.67, 0.61, 0.7)))
    for x, out, name, radius in ((2.15, 0.2, "copper", 0.11), (2.55, 0.25, "steel", 0.13), (2.2, 0.43, "red", 0.08)):
        base = (x, DEPTH - out, COUNTER + 0.01)
        yield from drum(name, base, radius, 1.3 * radius)
        yield ball("black", (x, base[1], base[2] + 1.3 * radius + 0.012), 0.018)
        yield box(
            name, (x + radius, base[1] - 0.012, base[2] + 0.09), (x + radius + 0.13, base[1] + 0.012, 0.105 + 0.91)
        )
    yield box("steel", *back((1.93, 0, 1.68), (2.77, 0.5, 1.72)))
    for index in range(4):
        inset = 0.09 * index
        yield box(
            "steel", *back((1.93 + inset, 0, 1.72 + 0.07 * index), (2.77 - inset, 0.5 - inset, 1.79 + 0.07 * index))
        )
    yield box("steel", *back((2.2, 0, 2.0), (2.5, 0.24, HEIGHT)))
    yield tube("steel", (1.95, DEPTH - 0.06, 1.55), (2.75, DEPTH - 0.06, 1.55), 0.008)
    for x in np.arange(2.05, 2.75, 0.13):
        yield box("copper", *back((x - 0.012, 0.05, 1.3), (x + 0.012, 0.06, 1.55)))
        yield box("copper", *back((x - 0.035, 0.04, 1.22), (x + 0.035, 0.07, 1.3)))


def appliances():
    """Yield the fridge, the sink, and a niche for the coffee machine on the left counter."""
    yield box("steel", (0, 1.5, 0.02), (0.68, 2.3, 1.95))
    yield box("black", (0.68, 1.5, 1.2), (0.69, 2.3, 1.215))
    for low, high in ((0.7, 1.15), (1.27, 1.7)):
        yield box("black", (0.69, 2.2, low), (0.72, 2.22, high))
    yield from drum("black", (0.3, 3.9, COUNTER), 0.2, 0.005)
    yield tube("steel", (0.1, 3.9, COUNTER), (0.1, 3.9, 1.2), 0.014)
    yield tube("steel", (0.1, 3.9, 1.2), (0.3, 3.9, 1.2), 0.014)
    for low, high in ((2.38, 2.4), (2.98, 3.0)):
        yield box("wood", (0, low, COUNTER), (0.4, high, 1.44))
    yield box("wood", (0, 2.38, 1.42), (0.4, 3.0, 1.44))
    yield box("black", (0.05, 2.55, COUNTER), (0.3, 2.8, 1.25))


def table(random):
    """Yield the table, set for four, and its chairs."""
    x, y = TABLE
    yield box("wood", (x - 0.9, y - 0.45, 0.72), (x + 0.9, y + 0.45, 0.76))
    for dx in (-0.82, 0.82):
        for dy in (-0.37, 0.37):
            yield box("wood", (x + dx - 0.04, y + dy - 0.04, 0), (x + dx + 0.04, y + dy + 0.04, 0.72))
    for dx, dy, turn in ((-0.45, -0.75, 0), (0.45, -0.75, 0), (-0.4, 0.75, 180), (0.45, 0.75, 180), (1.25, 0, 90)):
        yield from chair(x + dx, y + dy, turn + random.uniform(-18, 18))
    for dx, dy in ((-0.45, -0.25), (0.45, -0.25), (-0.45, 0.25), (0.45, 0.25)):
        yield from drum("china", (x + dx, y + dy, 0.76), 0.12, 0.012)
        yield from drum("blue", (x + dx + 0.18, y + 0.8 * dy, 0.76), 0.035, 0.1)
    yield from drum("wood", (x, y, 0.76), 0.17, 0.04)
    for index in range(6):
        angle, name = index * np.pi / 3, ("red", "yellow", "red")[index % 3]
        yield ball(name, (x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), 0.845), 0.045)


def chair(x, y, angle):
    """Yield a chair with its back towards smaller y, rotated by `angle` about its centre."""

    def part(low, high):
        centre = np.array((x, y, 0))
        return box("red" if low[2] == 0.43 else "wood", centre + low, centre + high, (x, y), angle)

    for dx in (-0.19, 0.16):
        yield part((dx, -0.2, 0), (dx + 0.03, -0.17, 0.95))
        yield part((dx, 0.17, 0), (dx + 0.03, 0.2, 0.43))
    yield part((-0.2, -0.2, 0.43), (0.2, 0.2, 0.47))
    for z in (0.6, 0.73, 0.86):
        yield part((-0.16, -0.195, z), (0.16, -0.175, z + 0.07))


def pendant(x, y, z, random):
    """Yield a pendant lamp: a bulb in a shade open at the bottom, on a cord from the ceiling; `z`: rim of the shade."""
    yield tube("copper", (x, y, z), (x, y, z + 0.18), 0.13)
    yield flat("disk", "copper", (x, y, z + 0.18), UP, (0.13, 0.13))
    yield tube("black", (x, y, z + 0.18), (x, y, HEIGHT), 0.006)
    yield ball("lamp", (x, y, z + 0.08), 0.045, glow(300, WARM, random))


def sconce(x, y, random):
    """Yield a wall lamp: a bulb behind a screen open at the top, bottom and sides."""
    yield box("copper", (x - 0.09, y - 0.17, 1.8), (x + 0.09, y - 0.16, 2.0))
    yield box("copper", (x - 0.02, y - 0.16, 1.79), (x + 0.02, y, 1.8))
    yield ball("lamp", (x, y - 0.09, 1.9), 0.035, glow(220, WARM, random))


def ceiling_lamps(random):
    """Yield 12 ceiling panels in frames that limit their visibility, and 3 lamps of the range hood."""
    for x in (0.9, 2.4, 3.9, 5.4):
        for y in (0.9, 2.1, 3.2):
            for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                across = (0.01, 0.16) if dx else (0.16, 0.01)
                centre, reach = np.array((x + 0.16 * dx, y + 0.16 * dy)), np.array(across)
                yield box("plaster", (*centre - reach, HEIGHT - 0.08), (*centre + reach, HEIGHT))
            yield flat("rectangle", "lamp", (x, y, HEIGHT - 0.01), DOWN, (0.14, 0.14), glow(22, WHITE, random))
    for x in (2.1, 2.35, 2.6):
        yield flat("disk", "lamp", (x, DEPTH - 0.28, 1.675), DOWN, (0.035, 0.035), glow(250, COOL, random))


def strips(random):
    """Yield 36 strips at the furniture: under cabinets, in shelves, at plinths, above cabinets."""
    low, high = CABINETS
    middle = (low + high) / 2

    def lamp(side, along, out, z, half, facing, radiance, colour):
        centre, _ = side((along, out, z), (along, out, z))
        half = half if side is back else half[::-1]
        return flat("rectangle", "lamp", centre, facing, half, glow(radiance, colour, random))

    for side, places in (
        (back, (0.55, 0.9, 1.3, 1.65)),
        (back, (3.0, 3.3, 3.65, 4.0)),
        (left, (3.35, 3.75, 4.2, 4.65)),
    ):
        for along in places:
            yield lamp(side, along, 0.26, low - 0.005, (0.13, 0.012), DOWN, 170, WARM)
    for side, start, end in ((back, 0.4, 1.85), (left, 3.2, 4.8)):
        for bay in range(3):
            along = start + (bay + 0.5) * (end - start) / 3
            for z in (middle - 0.005, high - 0.035):
                yield lamp(side, along, 0.3, z, (0.18, 0.008), DOWN, 90, WHITE)
    for side, places in ((back, (0.9, 1.6, 3.2)), (left, (2.8, 3.5, 4.3))):
        for along in places:
            yield lamp(side, along, 0.53, 0.095, (0.25, 0.01), DOWN, 110, COOL)
    for side, places in ((back, (0.8, 1.4, 3.5)), (left, (3.5, 4.0, 4.5))):
        for along in places:
            yield lamp(side, along, 0.15, high + 0.01, (0.22, 0.02), UP, 120, WARM)


def lamps(random):
    """Yield all 72 lights with their fittings."""
    yield from ceiling_lamps(random)  # 15
    yield from strips(random)  # 36
    x, y = TABLE
    for spot in ((x - 0.6, y, 1.62), (x, y, 1.62), (x + 0.6, y, 1.62), (0.85, 3.6, 1.75), (0.85, 4.5, 1.75)):  # 5
        yield from pendant(*spot, random)
    for place in ((PANTRY_X + 0.12, PANTRY_Y - 0.1), (5.75, PANTRY_Y - 0.1), (0.2, DEPTH), (4.1, DEPTH)):  # 4
        yield from sconce(*place, random)
    for x in (4.7, 5.3, 5.9):  # 10 in the pantry
        for y in (4.1, 4.8):
            yield flat("disk", "lamp", (x, y, HEIGHT - 0.01), DOWN, (0.1, 0.1), glow(70, WARM, random))
    for z in (0.495, 0.995, 1.495, 1.995):
        yield flat("rectangle", "lamp", (5.3, DEPTH - 0.37, z), DOWN, (0.6, 0.01), glow(70, WARM, random))
    for y in (2.55, 2.85):  # 2 in the niche
        yield flat("disk", "lamp", (0.3, y, 1.415), DOWN, (0.03, 0.03), glow(200, WHITE, random))


def kitchen(seed, windows=False):
    """Return the scene as XML text, determined by the seed; `windows` adds the sky."""
    furniture, power = np.random.default_rng(7), np.random.default_rng(seed)
    name, option = ("kitchen_windows", "--windows ") if windows else ("kitchen_lamps", "")
    command = f"kitchen_lamps.py {option}--seed {seed} --output scenes/{name}.xml"
    parts = [header(command, "A kitchen with 72 lamps", 76, (4.3, 0.3, 1.65), (2.9, 4.2, 1.12)), *MATERIALS]
    parts += [*shell(), *pantry(), *counter(back, 0, PANTRY_X), *counter(left, 2.4, DEPTH - 0.62)]
    parts += [*cabinets(back, 2.85, 4.1), *shelves(back, 0.4, 1.85, furniture), *shelves(left, 3.2, 4.8, furniture)]
    parts += [*stove(), *appliances(), *table(furniture), *lamps(power)]
    parts += [sky(SKY)] if windows else []
    return "\n".join([*parts, "</scene>"]) + "\n"


def kitchen_sky():
    """Return the texels of a clear sky with a low sun behind the camera."""
    return sky_image((0.6, 1.2, 2.6), (2.2, 2.4, 2.8), (0.16, 0.15, 0.12), (1600, 1300, 900), (0.35, -1, 0.42), 6, 0.01)


def main(arguments=None):
    command_line = parser(__doc__, "kitchen_lamps.xml, or kitchen_windows.xml")
    command_line.add_argument("--windows", action="store_true", help=f"add the sky, and write its texture {SKY}")
    options = command_line.parse_args(arguments)
    output = options.output or Path("kitchen_windows.xml" if options.windows else "kitchen_lamps.xml")
    try:
        output.write_text(kitchen(options.seed, options.windows))
        if options.windows:
            write_image(output.parent / SKY, kitchen_sky())
    except (ValueError, OSError) as error:
        command_line.exit(2, f"kitchen_lamps: {error}\n")


if __name__ == "__main__":
    main()
