"""Generate a long corridor without lamps between rooms with partly open doors.

Purpose: purely indirect light. Sixteen rooms on both sides contain a few lamps each, invisible from the corridor. Light
enters through the door gaps and is reflected by floor and walls. Camera paths rarely find a lamp; light paths rarely
leave a room.

    python scenes/corridor.py --output scenes/corridor.xml
"""

import numpy as np
from elements import ball, box, corners, drum, flat, glow, header, material, write_scene

LENGTH, HALF, DEPTH, HEIGHT, WALL = 32.0, 1.3, 5.0, 2.9, 0.15  # metres; corridor: |y| < HALF, rooms: HALF < |y| < DEPTH
ROOM = 4.0  # length of a room along x
DOOR, DOOR_HEIGHT, HINGE = 1.0, 2.15, 1.2  # width and height of doors; distance of the hinge from the start of the room

COLOURS = [
    (1.0, 0.66, 0.36), (0.62, 0.80, 1.0), (1.0, 0.85, 0.68), (1.0, 0.5, 0.2),
    (0.7, 1.0, 0.75), (1.0, 0.85, 0.68), (1.0, 0.45, 0.4), (0.62, 0.80, 1.0),
]  # fmt: skip
MATERIALS = [
    material("lamp", (0.6, 0.6, 0.6)),
    material("plaster", (0.74, 0.72, 0.68)),
    material("linoleum", (0.30, 0.33, 0.30), "plastic", 0.15),
    material("oak", (0.46, 0.30, 0.16)),
    material("steel", (0.75, 0.75, 0.75), "metal", 0.25),
    material("red", (0.55, 0.10, 0.08)),
    material("blue", (0.12, 0.20, 0.46)),
    material("ochre", (0.62, 0.44, 0.14)),
]


def shell():
    """Yield floor, ceiling and outer walls."""
    yield box("linoleum", (0, -DEPTH, -WALL), (LENGTH, DEPTH, 0))
    yield box("plaster", (0, -DEPTH, HEIGHT), (LENGTH, DEPTH, HEIGHT + WALL))
    for x in (-WALL, LENGTH):
        yield box("plaster", (x, -DEPTH, 0), (x + WALL, DEPTH, HEIGHT))
    for side in (-1, 1):
        yield box("plaster", *corners(side, (0, DEPTH, 0), (LENGTH, DEPTH + WALL, HEIGHT)))
    yield box("blue", (LENGTH - 0.04, -0.5, 0.9), (LENGTH, 0.5, 2.1))


def room(side, start, random):
    """Yield the walls of a room, the partly open door, furniture and lamps."""
    hinge = start + HINGE
    yield box("plaster", *corners(side, (start, HALF, 0), (hinge, HALF + WALL, HEIGHT)))
    yield box("plaster", *corners(side, (hinge + DOOR, HALF, 0), (start + ROOM, HALF + WALL, HEIGHT)))
    yield box("plaster", *corners(side, (hinge, HALF, DOOR_HEIGHT), (hinge + DOOR, HALF + WALL, HEIGHT)))
    yield box("plaster", *corners(side, (start - WALL / 2, HALF, 0), (start + WALL / 2, DEPTH, HEIGHT)))
    for x in (hinge - 0.06, hinge + DOOR):
        yield box("oak", *corners(side, (x, HALF - 0.02, 0), (x + 0.06, HALF + WALL, DOOR_HEIGHT)))
    # The door opens into the room, away from the camera
    angle = side * random.uniform(38, 78)
    low, high = corners(side, (hinge, HALF + WALL, 0.01), (hinge + DOOR, HALF + WALL + 0.04, DOOR_HEIGHT))
    yield box("oak", low, high, (hinge, side * (HALF + WALL)), angle)
    wall = random.choice(["red", "blue", "ochre"])
    yield box(wall, *corners(side, (start + 0.3, DEPTH - 0.5, 0), (start + 1.6, DEPTH - 0.1, 1.9)))
    yield box("oak", *corners(side, (start + 2.1, DEPTH - 1.9, 0.7), (start + 3.5, DEPTH - 1.1, 0.76)))
    yield from drum("steel", (start + 2.8, side * (DEPTH - 1.5), 0), 0.08, 0.7)
    colour = COLOURS[random.integers(len(COLOURS))]
    yield flat("rectangle", "lamp", (start + 2.9, side * (DEPTH - 1.6), HEIGHT - 0.01), (0, 0, -1), (0.45, 0.2),
               glow(110, colour, random))  # fmt: skip
    yield ball("lamp", (start + 0.9, side * (DEPTH - 0.3), 2.1), 0.12, glow(90, colour, random))


def things(random):
    """Yield the objects in the corridor: lockers, a bench, balls."""
    for x, side in ((6.4, 1), (15.0, -1), (23.2, 1)):
        yield box("steel", *corners(side, (x, HALF - 0.35, 0), (x + 0.5, HALF, 1.75)))
    yield box("oak", (11.1, HALF - 0.45, 0.4), (12.5, HALF - 0.05, 0.46))
    for x in (11.2, 12.3):
        yield box("steel", (x, HALF - 0.4, 0), (x + 0.1, HALF - 0.1, 0.4))
    for _ in range(7):
        radius = random.uniform(0.08, 0.16)
        place = (random.uniform(3.5, 20), random.uniform(-0.8, 0.8), radius)
        yield ball(random.choice(["red", "blue", "ochre"]), place, radius)


def corridor(seed):
    """Return the scene as XML text, determined by the seed."""
    random = np.random.default_rng(seed)
    command = f"corridor.py --seed {seed} --output scenes/corridor.xml"
    camera = (72, (0.5, -0.35, 1.6), (10, 0.1, 1.3))
    parts = [header(command, "A corridor lit through doors ajar", *camera, 8), *MATERIALS, *shell()]
    for start in np.arange(0, LENGTH, ROOM):
        for side in (-1, 1):
            parts += room(side, start, random)
    return "\n".join([*parts, *things(random), "</scene>"]) + "\n"


def main(arguments=None):
    write_scene(__doc__, "corridor", corridor, arguments=arguments)


if __name__ == "__main__":
    main()
