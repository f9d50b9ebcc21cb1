"""Generate the concourse of a railway station with 613 point emitters and 219 glowing globes.

Purpose: methods that learn, per pixel, which of many lights are visible. The numbers of lights match `GCT` in Donikian
et al., "Accurate direct illumination using iterative adaptive sampling" (2006), Table 1: 613 point and 219 spherical
area emitters, of which an average point sees about a third. Point emitters are stars below the vault, lamps behind
cornices and under balconies, and bulbs in side passages, booths and stairs. Globes hang in chandeliers and stand on
columns, balustrades and the clock. Columns, piers, balusters, booths and arches occlude them. Floor and brass are
glossy.

    python scenes/concourse.py --output scenes/concourse.xml
"""

from pathlib import Path

import numpy as np
from elements import ball, box, bulb, corners, drum, glow, header, material, parser, slab, tube

LENGTH, HALF, HEIGHT, WALL = 60.0, 15.0, 13.0, 0.4  # metres: x from 0 to LENGTH, |y| < HALF; the vault starts at HEIGHT
PASSAGE, PASSAGE_HEIGHT, ARCH = 22.0, 6.0, 5.2  # |y| of the outer wall; heights of the passages and their openings
BAY = 6.0  # length along x; each bay has an opening of 3.6 m on each side
BALCONY, FLOOR, RAIL = 10.6, 6.4, 1.1  # balconies: |y| of the edge, height of the floor, height of the balustrade
MEZZANINE, LANDING = 48.0, 4.0  # mezzanine: x of the edge, height
STEPS = 20
BOOTHS = np.arange(15.0, 43.0, 3.0)  # x of the booth centres, on the side y < 0
CLOCK = (29.0, 1.5)
RISE = 6.0  # of the vault above its springing

WARM, WHITE, COOL, AMBER = (1.0, 0.66, 0.36), (1.0, 0.85, 0.68), (0.62, 0.8, 1.0), (1.0, 0.5, 0.18)

MATERIALS = [
    material("lamp", (0.6, 0.6, 0.6)),
    material("stone", (0.60, 0.54, 0.45)),
    material("pale", (0.68, 0.63, 0.54)),
    material("marble", (0.42, 0.38, 0.33), "plastic", 0.15),
    material("inlay", (0.20, 0.12, 0.09), "plastic", 0.15),
    material("vault", (0.16, 0.34, 0.38)),
    material("brass", (0.85, 0.62, 0.30), "metal", 0.22),
    material("bronze", (0.45, 0.31, 0.18), "metal", 0.35),
    material("wood", (0.30, 0.15, 0.08), "plastic", 0.25),
    material("red", (0.50, 0.07, 0.06)),
    material("blue", (0.08, 0.14, 0.36)),
    material("coat", (0.10, 0.10, 0.12)),
    material("green", (0.10, 0.30, 0.16)),
]


def shell():
    """Yield the floor with inlays, the outer walls, and the end walls with tall windows, dark at night."""
    yield box("marble", (0, -PASSAGE, -WALL), (LENGTH, PASSAGE, 0))
    for x in np.arange(3, MEZZANINE - 7, 3.0):
        yield box("inlay", (x - 0.2, -9.5, 0), (x + 0.2, 9.5, 0.004))
    for y in np.arange(-9, 9.1, 3.0):
        yield box("inlay", (0, y - 0.2, 0), (MEZZANINE - 7, y + 0.2, 0.005))
    top = HEIGHT + RISE + WALL
    for x in (-WALL, LENGTH):
        yield box("stone", (x, -PASSAGE, -WALL), (x + WALL, PASSAGE, top))
    for y in (-8, 0, 8):
        yield box("blue", (LENGTH - 0.1, y - 2.2, 6.0), (LENGTH, y + 2.2, 13.5))
        for dy in np.linspace(-2.2, 2.2, 5):
            yield box("bronze", (LENGTH - 0.25, y + dy - 0.08, 6.0), (LENGTH - 0.1, y + dy + 0.08, 13.5))
        for z in (6.0, 8.5, 11.0, 13.5):
            yield box("bronze", (LENGTH - 0.2, y - 2.2, z - 0.08), (LENGTH - 0.1, y + 2.2, z + 0.08))


def vault_height(y):
    """Return the inner height of the vault at `y`."""
    return HEIGHT + RISE * np.sqrt(np.maximum(1 - (y / HALF) ** 2, 0))


def vault():
    """Yield the vault of tilted slabs, and its roof."""
    turn = np.linspace(0, np.pi, 13)
    y, z = HALF * np.cos(turn), HEIGHT + RISE * np.sin(turn)
    for index in range(12):
        dy, dz = y[index + 1] - y[index], z[index + 1] - z[index]
        centre = (LENGTH / 2, (y[index] + y[index + 1]) / 2, (z[index] + z[index + 1]) / 2 + WALL)
        angle = np.degrees(np.arctan2(dz, dy)) + 180
        yield slab("vault", centre, (LENGTH, np.hypot(dy, dz) + 0.45, 2 * WALL * 0.9), "x", angle)
    yield box("stone", (0, -HALF - 1, HEIGHT + RISE + WALL), (LENGTH, HALF + 1, HEIGHT + RISE + 2 * WALL))


def sides():
    """Yield the side walls with openings, the passages behind them, and the cornices."""
    for side in (-1, 1):
        for x in np.arange(0, LENGTH, BAY):
            for start, end in ((x, x + 1.2), (x + 4.8, x + BAY)):
                yield box("stone", *corners(side, (start, HALF, 0), (end, HALF + 0.8, ARCH)))
            for start, end in ((x + 1.2, x + 1.7), (x + 4.3, x + 4.8)):  # corbels, which narrow the tops of openings
                yield box("pale", *corners(side, (start, HALF, ARCH - 0.7), (end, HALF + 0.8, ARCH)))
            if x % 12:  # walls across the passages, with doorways
                yield box("stone", *corners(side, (x - 0.15, HALF + 0.8, 0), (x + 0.15, HALF + 3, PASSAGE_HEIGHT)))
                yield box("stone", *corners(side, (x - 0.15, HALF + 5, 0), (x + 0.15, PASSAGE, PASSAGE_HEIGHT)))
            yield box("red", *corners(side, (x + 2.2, PASSAGE - 0.1, 1.2), (x + 3.8, PASSAGE, 3.6)))
        yield box("stone", *corners(side, (0, HALF, ARCH), (LENGTH, HALF + 0.8, HEIGHT + 2)))
        yield box("stone", *corners(side, (0, PASSAGE, 0), (LENGTH, PASSAGE + WALL, PASSAGE_HEIGHT)))
        yield box(
            "pale", *corners(side, (0, HALF + 0.8, PASSAGE_HEIGHT), (LENGTH, PASSAGE + WALL, PASSAGE_HEIGHT + WALL))
        )
        # A cornice is a ledge with a lip; lamps behind the lip light the vault
        yield box("pale", *corners(side, (0, HALF - 1, HEIGHT - 1), (LENGTH, HALF, HEIGHT - 0.8)))
        yield box("pale", *corners(side, (0, HALF - 1, HEIGHT - 0.8), (LENGTH, HALF - 0.85, HEIGHT - 0.35)))
        for x in np.arange(BAY, LENGTH - 1, BAY):
            yield box("pale", *corners(side, (x - 0.5, HALF - 0.3, FLOOR), (x + 0.5, HALF, HEIGHT - 1)))


def balconies():
    """Yield the balconies on both sides with columns and balustrades."""
    for side in (-1, 1):
        yield box("pale", *corners(side, (0, BALCONY, FLOOR - 0.4), (LENGTH, HALF, FLOOR)))
        yield box("stone", *corners(side, (0, BALCONY, FLOOR + RAIL - 0.15), (LENGTH, BALCONY + 0.25, FLOOR + RAIL)))
        for x in np.arange(0.75, LENGTH, 1.5):
            yield box(
                "pale",
                *corners(side, (x - 0.14, BALCONY + 0.05, FLOOR), (x + 0.14, BALCONY + 0.2, FLOOR + RAIL - 0.15)),
            )
        for x in np.arange(0, LENGTH, BAY):
            yield from column(x + 0.6 if x else 0.9, side * (BALCONY + 0.55))


def column(x, y):
    """Yield a column with base and capital."""
    yield box("stone", (x - 0.6, y - 0.55, 0), (x + 0.6, y + 0.55, 0.8))
    yield tube("marble", (x, y, 0.8), (x, y, FLOOR - 0.9), 0.42)
    yield box("pale", (x - 0.6, y - 0.55, FLOOR - 0.9), (x + 0.6, y + 0.55, FLOOR - 0.4))


def stairs():
    """Yield the mezzanine at the far end, its stairs, and the balustrades."""
    yield box("stone", (MEZZANINE, -BALCONY, 0), (LENGTH, BALCONY, LANDING))
    for index in range(STEPS):
        x = MEZZANINE - (STEPS - index) * 0.35
        yield box("marble", (x, -4, 0), (MEZZANINE, 4, LANDING * (index + 1) / STEPS))
    for side in (-1, 1):
        slope, run = LANDING / (STEPS * 0.35), STEPS * 0.35
        centre = (MEZZANINE - run / 2, side * 4.2, LANDING / 2 + 0.6)
        yield slab("stone", centre, (np.hypot(run, LANDING) + 0.2, 0.4, 1.5), "y", -np.degrees(np.arctan(slope)))
        yield box("stone", *corners(side, (MEZZANINE, 4.0, LANDING + 0.95), (MEZZANINE + 0.3, BALCONY, LANDING + RAIL)))
        for y in np.arange(4.5, BALCONY, 0.8):
            yield box(
                "pale", *corners(side, (MEZZANINE + 0.05, y, LANDING), (MEZZANINE + 0.25, y + 0.25, LANDING + 0.95))
            )


def booths():
    """Yield a row of ticket booths: counters, backs, partitions, canopies, window bars."""
    start, end = BOOTHS[0] - 1.5, BOOTHS[-1] + 1.5
    yield box("marble", (start, -7.4, 0), (end, -7.0, 1.1))
    yield box("wood", (start, -9.4, 0), (end, -9.25, 2.9))
    yield box("bronze", (start - 0.2, -9.5, 2.9), (end + 0.2, -6.8, 3.05))
    yield box("bronze", (start - 0.2, -6.9, 2.55), (end + 0.2, -6.8, 2.9))
    for x in np.append(BOOTHS - 1.5, end):
        yield box("wood", (x - 0.08, -9.25, 0), (x + 0.08, -7.0, 2.9))
    for x in BOOTHS:
        for dx in np.linspace(-1.2, 1.2, 6):
            yield box("brass", (x + dx - 0.03, -7.2, 1.1), (x + dx + 0.03, -7.14, 2.55))
        yield box("green", (x - 0.9, -9.24, 1.2), (x + 0.9, -9.2, 2.0))


def kiosk():
    """Yield the information kiosk with its clock in the middle of the hall."""
    x, y = CLOCK
    yield from drum("marble", (x, y, 0), 1.9, 1.1)
    yield from drum("brass", (x, y, 1.1), 2.0, 0.06)
    for index in range(8):
        angle = index * np.pi / 4
        yield tube("brass", *((x + 1.6 * np.cos(angle), y + 1.6 * np.sin(angle), z) for z in (1.1, 2.6)), 0.06)
    yield tube("bronze", (x, y, 2.6), (x, y, 2.8), 1.9)
    yield box("bronze", (x - 1.2, y - 1.2, 2.62), (x + 1.2, y + 1.2, 2.78))
    yield from drum("brass", (x, y, 2.78), 0.35, 0.9)
    yield box("brass", (x - 0.32, y - 0.32, 3.68), (x + 0.32, y + 0.32, 4.3))


def travellers(random):
    """Yield simplified people with luggage."""
    for _ in range(20):
        x, y = random.uniform(8, 38), random.uniform(-5.5, 8.5)
        if np.hypot(x - CLOCK[0], y - CLOCK[1]) < 3:
            continue
        name, height = random.choice(["coat", "red", "blue", "green", "wood"]), random.uniform(1.35, 1.55)
        yield tube(name, (x, y, 0), (x, y, height), 0.2)
        yield ball(name, (x, y, height), 0.2)
        yield ball("stone", (x, y, height + 0.28), 0.12)
        yield box("wood", (x + 0.3, y - 0.12, 0), (x + 0.75, y + 0.12, 0.5), (x, y), random.uniform(0, 360))


def chandeliers(random):
    """Yield six chandeliers with 18 globes each, in two rings partly hidden by iron hoops and a central drum."""
    for x, y in ((9, -4), (9, 4), (24, -4.5), (24, 4.5), (39, -4.5), (39, 4.5)):
        yield tube("bronze", (x, y, 8.6), (x, y, vault_height(y)), 0.04)
        yield from drum("brass", (x, y, 7.9), 0.45, 1.2)
        for count, radius, z in ((11, 1.5, 8.0), (7, 0.95, 8.8)):
            yield tube("brass", (x, y, z - 0.14), (x, y, z - 0.04), radius)
            for index in range(count):
                angle = 2 * np.pi * index / count
                place = (x + radius * np.cos(angle), y + radius * np.sin(angle), z + 0.12)
                yield ball("lamp", place, 0.13, glow(60, WARM, random))
            yield slab("bronze", (x, y, z - 0.09), (2 * radius, 0.06, 0.05), "z", 20)
            yield slab("bronze", (x, y, z - 0.09), (2 * radius, 0.06, 0.05), "z", 110)


def globes(random):
    """Yield 219 globes and their supports."""
    yield from chandeliers(random)  # 108
    for side in (-1, 1):
        for x in np.arange(0, LENGTH, BAY):
            foot, y = x + 0.6 if x else 0.9, side * (BALCONY + 0.55)
            yield box("brass", (foot - 0.6, y - 0.03, 3.42), (foot + 0.6, y + 0.03, 3.48))
            for dx in (-0.6, 0.6):  # 40 at the columns
                yield ball("lamp", (foot + dx, y, 3.59), 0.11, glow(50, AMBER, random))
            yield ball("lamp", (x + 3, side * (HALF + 3.6), 5.8), 0.2, glow(25, WHITE, random))  # 20 in the passages
    for x in BOOTHS:  # 30 in the booths
        for dx in (-0.8, 0, 0.8):
            yield ball("lamp", (x + dx, -8.0, 2.83), 0.07, glow(45, WHITE, random))
    x, y = CLOCK
    for dx, dy, z in ((-0.5, -0.5, 2.96), (0.5, -0.5, 2.96), (-0.5, 0.5, 2.96), (0.5, 0.5, 2.96), (0, 0, 4.48)):  # 5
        yield ball("lamp", (x + dx, y + dy, z), 0.18, glow(40, WHITE, random))
    for side in (-1, 1):  # 16 at the stairs and on the mezzanine
        for x, y, z in [(MEZZANINE - 7.2, 4.2, 1.9), *((MEZZANINE + 0.15, y, LANDING + 1.3) for y in (5.0, 7.0, 9.0))]:
            yield ball("lamp", (x, side * y, z), 0.2, glow(25, WHITE, random))
        for y in (2.0, 4.5, 7.0, 9.0):
            yield ball("lamp", (LENGTH - 0.15, side * y, LANDING + 1.6), 0.15, glow(40, AMBER, random))
        yield box("stone", *corners(side, (MEZZANINE - 7.5, 3.9, 0), (MEZZANINE - 6.9, 4.5, 1.7)))


def bulbs(random):
    """Yield 613 point lights."""
    for _ in range(120):  # stars
        y = random.uniform(-11, 11)
        yield bulb((random.uniform(1, LENGTH - 1), y, vault_height(y) - 0.5), 0.5, COOL, random)
    for side in (-1, 1):
        for x in np.linspace(0.5, LENGTH - 0.5, 60):  # 120 behind the cornices
            yield bulb((x, side * (HALF - 0.5), HEIGHT - 0.6), 5, AMBER, random)
        for x in np.linspace(0.8, LENGTH - 0.8, 50):  # 100 under the balconies
            yield bulb((x, side * (HALF - 1.6), FLOOR - 0.5), 1.5, WARM, random)
        for x in np.linspace(1.1, LENGTH - 1.1, 30):  # 60 on the balconies
            yield bulb((x, side * (HALF - 0.8), FLOOR + 2.4), 3.5, WARM, random)
        for x in np.arange(0, LENGTH, BAY):  # 140 in the passages
            for index in range(7):
                across = random.uniform(HALF + 1.3, PASSAGE - 0.6)
                yield bulb(
                    (x + 0.6 + 0.8 * index, side * across, random.uniform(3.8, 5.6)),
                    4,
                    (WHITE, COOL)[index % 2],
                    random,
                )
    for x in BOOTHS:  # 60 in the booths
        for dx in (-1.1, 0, 1.1):
            for y in (-8.9, -7.6):
                yield bulb((x + dx, y, 2.75), 0.9, WARM, random)
    for index in range(13):  # along both sides of the stairs, near the floor
        x = MEZZANINE - 6.6 + 0.5 * index
        yield bulb((x, -4.6 if index % 2 else 4.6, 0.4), 1.2, AMBER, random)


def concourse(seed):
    """Return the scene as XML text, determined by the seed."""
    crowd, power = np.random.default_rng(3), np.random.default_rng(seed)
    command = f"concourse.py --seed {seed} --output scenes/concourse.xml"
    camera = (74, (1.2, 6.2, 6.9), (27, -2.2, 5.2))
    parts = [header(command, "A station concourse with 832 lights", *camera), *MATERIALS]
    parts += [*shell(), *vault(), *sides(), *balconies(), *stairs(), *booths(), *kiosk(), *travellers(crowd)]
    return "\n".join([*parts, *globes(power), *bulbs(power), "</scene>"]) + "\n"


def main(arguments=None):
    command_line = parser(__doc__, "concourse.xml")
    options = command_line.parse_args(arguments)
    try:
        (options.output or Path("concourse.xml")).write_text(concourse(options.seed))
    except (ValueError, OSError) as error:
        command_line.exit(2, f"concourse: {error}\n")


if __name__ == "__main__":
    main()
