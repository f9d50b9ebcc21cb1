"""Generate a banquet hall: a grid of downlights in the ceiling, lamps on the tables, and light strips in coves.

Purpose: many lights, most of them visible, and strong indirect light. 60 spots, 42 small globes and 24 long panels; the
panels shine upwards behind a ledge, so that half of the light arrives via the ceiling. No large surface is in shadow,
but chairs and glasses cast soft shadows.

    python scenes/banquet.py --output scenes/banquet.xml
"""

import numpy as np
from elements import ball, box, corners, downlight, drum, flat, glow, header, material, tube, write_scene

LENGTH, HALF, HEIGHT, WALL = 24.0, 7.0, 4.6, 0.25  # metres: x from 0 to LENGTH, |y| < HALF
LEDGE = 3.7  # height of the ledge in front of the light strips
TABLES, TABLE_LENGTH, TABLE_WIDTH, TABLE_HEIGHT = (-4.4, 0.0, 4.4), 16.8, 1.3, 0.76
FIRST = 4.2  # x of the near end of the tables

WARM, WHITE, AMBER = (1.0, 0.66, 0.36), (1.0, 0.86, 0.70), (1.0, 0.52, 0.2)
MATERIALS = [
    material("lamp", (0.6, 0.6, 0.6)),
    material("plaster", (0.72, 0.69, 0.63)),
    material("panel", (0.36, 0.20, 0.11), "plastic", 0.2),
    material("parquet", (0.34, 0.22, 0.13), "plastic", 0.15),
    material("linen", (0.76, 0.74, 0.70)),
    material("runner", (0.45, 0.07, 0.08)),
    material("china", (0.80, 0.80, 0.78), "plastic", 0.1),
    material("silver", (0.85, 0.83, 0.80), "metal", 0.2),
    material("velvet", (0.10, 0.16, 0.34)),
    material("wine", (0.30, 0.03, 0.05)),
    material("leaf", (0.12, 0.28, 0.09)),
]


def shell():
    """Yield the floor, the ceiling with beams, panelled walls, and the ledges of the coves."""
    yield box("parquet", (0, -HALF, -WALL), (LENGTH, HALF, 0))
    yield box("plaster", (0, -HALF, HEIGHT), (LENGTH, HALF, HEIGHT + WALL))
    for x in np.arange(2.0, LENGTH, 4.0):
        yield box("plaster", (x - 0.15, -HALF, HEIGHT - 0.3), (x + 0.15, HALF, HEIGHT))
    for x in (-WALL, LENGTH):
        yield box("plaster", (x, -HALF, 0), (x + WALL, HALF, HEIGHT))
    for side in (-1, 1):
        yield box("plaster", *corners(side, (0, HALF, 0), (LENGTH, HALF + WALL, HEIGHT)))
        yield box("plaster", *corners(side, (0, HALF - 0.55, LEDGE - 0.08), (LENGTH, HALF, LEDGE)))
        yield box("plaster", *corners(side, (0, HALF - 0.55, LEDGE), (LENGTH, HALF - 0.5, LEDGE + 0.22)))
        for x in np.arange(0.6, LENGTH - 1, 2.0):
            yield box("panel", *corners(side, (x, HALF - 0.04, 0.15), (x + 1.6, HALF, 1.3)))
        for x in np.arange(2.0, LENGTH, 4.0):
            yield box("panel", *corners(side, (x - 0.25, HALF - 0.2, 0), (x + 0.25, HALF, LEDGE - 0.08)))
    yield box("velvet", (LENGTH - 0.06, -2.4, 0.9), (LENGTH, 2.4, 3.2))


def chair(x, y, side):
    """Yield a chair facing the table from this `side`."""
    seat = y + side * (TABLE_WIDTH / 2 + 0.25)
    for dx in (-0.18, 0.18):
        for dy in (-0.18, 0.18):
            yield box("panel", (x + dx - 0.02, seat + dy - 0.02, 0), (x + dx + 0.02, seat + dy + 0.02, 0.44))
    yield box("velvet", (x - 0.22, seat - 0.22, 0.44), (x + 0.22, seat + 0.22, 0.5))
    back = seat + side * 0.2
    yield box("velvet", (x - 0.22, back - 0.03, 0.5), (x + 0.22, back + 0.03, 1.0))


def setting(x, y, side, random):
    """Yield a plate with cutlery, and a glass."""
    edge = y + side * (TABLE_WIDTH / 2 - 0.25)
    yield from drum("china", (x, edge, TABLE_HEIGHT), 0.13, 0.015)
    for dx in (-0.18, 0.18):
        yield box(
            "silver", (x + dx - 0.01, edge - 0.1, TABLE_HEIGHT), (x + dx + 0.01, edge + 0.1, TABLE_HEIGHT + 0.006)
        )
    place = (x + 0.16 + random.uniform(-0.03, 0.03), edge - side * 0.2)
    yield tube("silver", (*place, TABLE_HEIGHT), (*place, TABLE_HEIGHT + 0.1), 0.008)
    yield ball("wine", (*place, TABLE_HEIGHT + 0.14), 0.045)


def table(y, random):
    """Yield a set table with cloth, chairs and bouquets."""
    end = FIRST + TABLE_LENGTH
    low, high = y - TABLE_WIDTH / 2, y + TABLE_WIDTH / 2
    yield box("linen", (FIRST, low, TABLE_HEIGHT - 0.3), (end, high, TABLE_HEIGHT))
    yield box("runner", (FIRST - 0.01, y - 0.2, TABLE_HEIGHT - 0.32), (end + 0.01, y + 0.2, TABLE_HEIGHT + 0.004))
    for x in np.arange(FIRST + 0.5, end, 2.2):
        yield box("panel", (x - 0.05, low + 0.2, 0), (x + 0.05, high - 0.2, TABLE_HEIGHT - 0.3))
    for x in np.arange(FIRST + 0.6, end - 0.3, 0.78):
        for side in (-1, 1):
            yield from chair(x, y, side)
            yield from setting(x, y, side, random)
    for x in np.arange(FIRST + 1.8, end - 1, 2.4):
        yield from drum("china", (x, y, TABLE_HEIGHT), 0.05, 0.12)
        for _ in range(6):
            offset = random.uniform(-0.09, 0.09, 3) + (0, 0, TABLE_HEIGHT + 0.22)
            yield ball(random.choice(["leaf", "runner"]), (x + offset[0], y + offset[1], offset[2]), 0.06)


def lights(random):
    """Yield the 126 lights: spots, table lamps with stands, strips in the coves."""
    for x in np.linspace(1.0, LENGTH - 1.0, 12):
        for y in np.linspace(-5.6, 5.6, 5):
            yield downlight((x, y, HEIGHT - 0.31), 32, 16, WHITE, random)
    for y in TABLES:
        for x in np.linspace(FIRST + 0.6, FIRST + TABLE_LENGTH - 0.6, 14):
            yield from drum("silver", (x, y, TABLE_HEIGHT), 0.06, 0.02)
            yield tube("silver", (x, y, TABLE_HEIGHT + 0.02), (x, y, TABLE_HEIGHT + 0.3), 0.012)
            yield ball("lamp", (x, y, TABLE_HEIGHT + 0.36), 0.06, glow(26, AMBER, random))
    for side in (-1, 1):
        for x in np.arange(1.0, LENGTH, 2.0):
            yield flat("rectangle", "lamp", (x, side * (HALF - 0.25), LEDGE + 0.02), (0, 0, 1), (0.9, 0.06),
                       glow(40, WARM, random))  # fmt: skip


def banquet(seed):
    """Return the scene as XML text, determined by the seed."""
    furniture, power = np.random.default_rng(7), np.random.default_rng(seed)
    command = f"banquet.py --seed {seed} --output scenes/banquet.xml"
    parts = [header(command, "A banquet hall with 126 lights", 78, (0.5, -2.3, 2.2), (11, 0.9, 1.2), 6), *MATERIALS]
    parts += [*shell()] + [line for y in TABLES for line in table(y, furniture)]
    return "\n".join([*parts, *lights(power), "</scene>"]) + "\n"


def main(arguments=None):
    write_scene(__doc__, "banquet", banquet, arguments=arguments)


if __name__ == "__main__":
    main()
