"""Generate a hall with many lights, the standard scene for many-light methods.

A two-storey hall (36 m long; a nave with pillars; galleries above twelve side rooms with partly open doors) contains
any number of lights: bulbs on strings across the nave and in the rooms (point emitters), uplights at the pillars and
wall washers in the galleries (spots, whose light arrives via ceilings and walls), globes and panels (small area
emitters). Most lights are occluded from most points, every light contributes somewhere, and all surfaces are diffuse:
uniform light selection gives noisy images of a simple scene. The total power and the building do not depend on the
number of lights, so that renders with different numbers are comparable.

    python scenes/hall.py --lights 1000 --seed 1 --output scenes/hall.xml
"""

import argparse
from pathlib import Path

import numpy as np

LENGTH, NAVE, SIDE = 36.0, 4.5, 9.5  # metres: 0 < x < LENGTH; nave: |y| < NAVE, rooms: NAVE < |y| < SIDE
ROOM_HEIGHT, HEIGHT, WALL = 3.8, 8.0, 0.2
ROOM = 6.0  # length of a side room along x
DOOR_WIDTH, DOOR_HEIGHT = 1.3, 2.5

WARM, WHITE, COOL = (1.0, 0.62, 0.3), (1.0, 0.85, 0.68), (0.6, 0.78, 1.0)
ROOM_COLOURS = [
    (1.0, 0.45, 0.15), (0.3, 0.6, 1.0), (1.0, 0.8, 0.5), (0.9, 0.25, 0.3), (0.4, 1.0, 0.6), (1.0, 0.6, 0.25),
    (0.55, 0.4, 1.0), (1.0, 0.75, 0.4), (0.25, 0.8, 0.9), (1.0, 0.5, 0.6), (1.0, 0.7, 0.3), (0.5, 0.7, 1.0),
]  # fmt: skip
MATERIALS = {
    "plaster": (0.66, 0.63, 0.58),
    "stone": (0.55, 0.52, 0.48),
    "floor": (0.34, 0.27, 0.22),
    "wood": (0.30, 0.17, 0.09),
    "red": (0.55, 0.09, 0.07),
    "blue": (0.10, 0.18, 0.45),
    "gold": (0.65, 0.47, 0.14),
}

HEADER = """<!-- Made by: python scenes/hall.py --lights {lights} --seed {seed}
     A hall with many lights; scenes/hall.py says what it is for. Metres; z is up. -->
<scene version="3.0.0">
<default name="integrator" value="path"/>
<default name="max_depth" value="6"/>
<default name="spp" value="64"/>
<default name="resx" value="256"/>
<default name="resy" value="144"/>
<integrator type="$integrator"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="perspective">
<float name="fov" value="72"/>
<transform name="to_world"><lookat origin="1.0, -2.6, 2.7" target="14, 1.2, 3.2" up="0, 0, 1"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="$resy"/>
<string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
</sensor>"""


def numbers(values, digits=4):
    """Format numbers for XML with `digits` significant digits."""
    return ", ".join(f"{value:.{digits}g}" for value in values)


def material(name):
    reflectance = numbers(MATERIALS[name])
    return (
        f'<bsdf type="twosided" id="{name}"><bsdf type="diffuse">'
        f'<rgb name="reflectance" value="{reflectance}"/></bsdf></bsdf>'
    )


def box(name, low, high, pivot=None, angle=0.0):
    """Return a cuboid between the corners `low` and `high` (metres), rotated by `angle` degrees about the vertical axis
    through `pivot` (x, y)."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    turn = ""
    if angle:
        x, y = pivot
        turn = f'<translate x="{-x:.4g}" y="{-y:.4g}"/><rotate z="1" angle="{angle:.4g}"/>'
        turn += f'<translate x="{x:.4g}" y="{y:.4g}"/>'
    return (
        f'<shape type="cube"><transform name="to_world"><scale value="{numbers((high - low) / 2)}"/>'
        f'<translate value="{numbers((high + low) / 2)}"/>{turn}</transform><ref id="{name}"/></shape>'
    )


def shell():
    """Yield the floor, ceiling and outer walls, and the galleries."""
    yield box("floor", (0, -SIDE, -WALL), (LENGTH, SIDE, 0))
    yield box("plaster", (0, -SIDE, HEIGHT), (LENGTH, SIDE, HEIGHT + WALL))
    for x in (-WALL, LENGTH):
        yield box("plaster", (x, -SIDE, 0), (x + WALL, SIDE, HEIGHT))
    for side in (-1, 1):
        yield box("plaster", *corners(side, (0, SIDE, 0), (LENGTH, SIDE + WALL, HEIGHT)))
        yield box("plaster", *corners(side, (0, NAVE, ROOM_HEIGHT), (LENGTH, SIDE, ROOM_HEIGHT + WALL)))
        yield from railing(side)


def railing(side):
    """Yield the handrail of a gallery and its closely spaced posts."""
    bottom, top = ROOM_HEIGHT + WALL, ROOM_HEIGHT + 1.2
    yield box("wood", *corners(side, (0, NAVE, top - 0.1), (LENGTH, NAVE + 0.12, top)))
    for x in np.arange(0.6, LENGTH, 0.6):
        yield box("wood", *corners(side, (x - 0.06, NAVE, bottom), (x + 0.06, NAVE + 0.12, top - 0.1)))


def corners(side, low, high):
    """Mirror a box to the side -1 or +1 of the nave; return its low and high corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return (x0, min(side * y0, side * y1), z0), (x1, max(side * y0, side * y1), z1)


def rooms(random):
    """Yield the walls of the side rooms, each with a partly open door and furniture."""
    for index in range(12):
        side, start = (-1 if index < 6 else 1), (index % 6) * ROOM
        door = start + random.uniform(1.2, ROOM - 1.2 - DOOR_WIDTH)
        y, top = (NAVE, NAVE + WALL), ROOM_HEIGHT
        yield box("plaster", *corners(side, (start, y[0], 0), (door, y[1], top)))
        yield box("plaster", *corners(side, (door + DOOR_WIDTH, y[0], 0), (start + ROOM, y[1], top)))
        yield box("plaster", *corners(side, (door, y[0], DOOR_HEIGHT), (door + DOOR_WIDTH, y[1], top)))
        yield box("plaster", *corners(side, (start + ROOM - WALL, y[1], 0), (start + ROOM, SIDE, top)))
        hinge = door + DOOR_WIDTH  # on the far side, so that the light of the gap is visible to the camera
        leaf = corners(side, (door, NAVE - 0.05, 0.02), (hinge, NAVE, DOOR_HEIGHT - 0.03))
        yield box("wood", *leaf, pivot=(hinge, side * NAVE), angle=side * random.uniform(25, 75))
        shelf = start + random.uniform(1.0, ROOM - 3.0)
        yield box("wood", *corners(side, (shelf, SIDE - 0.4, 0), (shelf + 1.8, SIDE, random.uniform(1.2, 2.2))))
        table = start + random.uniform(1.5, ROOM - 2.5)
        yield box("red", *corners(side, (table, NAVE + 2.2, 0), (table + 1, NAVE + 3, 0.8)))


def nave(random):
    """Yield the pillars, the banners between them, and statues on plinths."""
    for index in range(7):
        x = min(max(index * ROOM, 0.3), LENGTH - 0.3)
        for side in (-1, 1):
            yield box("stone", *corners(side, (x - 0.3, NAVE - 0.6, 0), (x + 0.3, NAVE, HEIGHT)))
            yield box("stone", *corners(side, (x - 0.42, NAVE - 0.72, 0), (x + 0.42, NAVE, 0.5)))
            cloth = "red" if (index + (side > 0)) % 2 else "blue"
            yield box(cloth, *corners(side, (x + 2.3, NAVE - 0.08, 2.2), (x + 3.7, NAVE - 0.04, ROOM_HEIGHT + 1.1)))
        if 0 < index < 6:
            y = 1.3 * (-1) ** index
            yield box("stone", (x - 0.45, y - 0.45, 0), (x + 0.45, y + 0.45, 0.9))
            yield box("gold", (x - 0.3, y - 0.3, 0.9), (x + 0.3, y + 0.3, 1.5), (x, y), random.uniform(10, 80))
            yield ball("gold", (x, y, 1.85), 0.35)
    for x in np.arange(0.0, LENGTH + 0.1, ROOM):
        yield box("wood", (x - 0.15, -SIDE, HEIGHT - 0.45), (x + 0.15, SIDE, HEIGHT))


def ball(name, centre, radius, emitter=""):
    """Return a sphere, optionally with an emitter."""
    return (
        f'<shape type="sphere"><point name="center" value="{numbers(centre)}"/>'
        f'<float name="radius" value="{radius:g}"/><ref id="{name}"/>{emitter}</shape>'
    )


def spectrum(name, power, colour, random):
    """Return an `<rgb>` with a random strength around `power` (within a factor of about two) and a varied colour."""
    tint = np.asarray(colour) * random.uniform(0.85, 1.0, 3)
    return f'<rgb name="{name}" value="{numbers(power * random.lognormal(0, 0.7) * tint, 3)}"/>'


def room_of(random):
    """Choose a random side room; return its colour and a function from (along, across, z) in [0, 1]² × metres to
    positions."""
    index = random.integers(12)
    side, start = (-1 if index < 6 else 1), (index % 6) * ROOM

    def place(along, across, z):
        return (start + 0.5 + along * (ROOM - 1.2), side * (NAVE + 0.7 + across * (SIDE - NAVE - 1.2)), z)

    return ROOM_COLOURS[index], place


def point(random, power):
    """Return a bulb on one of nine strings across the nave, in a side room, or above a gallery."""
    where = random.random()
    if where < 0.25:
        string, t = random.integers(9), random.uniform(-1, 1)
        position = (3.5 + string * 3.5, t * (NAVE - 0.3), 5.0 + 1.2 * t * t)
        colour = (WARM, WHITE)[string % 2]
    elif where < 0.8:
        colour, place = room_of(random)
        position = place(random.random(), random.random(), random.uniform(1.2, 3.4))
        power *= 2
    else:
        side = random.choice((-1, 1))
        position = (random.uniform(0.5, LENGTH - 0.5), side * random.uniform(NAVE + 1, SIDE - 0.4), 6.5)
        colour = WARM
    return (
        f'<emitter type="point"><point name="position" value="{numbers(position)}"/>'
        f"{spectrum('intensity', power, colour, random)}</emitter>"
    )


def spot(random, power):
    """Return an uplight at a pillar, a wall washer in a gallery, or a ceiling spot on a statue."""
    where, side = random.random(), random.choice((-1, 1))
    if where < 0.45:
        x = random.integers(0, 7) * ROOM + random.choice((-0.55, 0.55))
        origin = np.array((np.clip(x, 0.6, LENGTH - 0.6), side * (NAVE - random.uniform(0.2, 0.6)), 0.55))
        target, cutoff, colour = origin + np.array((0, -0.6 * side, HEIGHT)), 28, WARM
    elif where < 0.85:
        origin = np.array((random.uniform(1, LENGTH - 1), side * (NAVE + 1.2), ROOM_HEIGHT + 0.4))
        target, cutoff, colour = (origin[0] + random.uniform(-1, 1), side * SIDE, 6.2), 45, COOL
    else:
        index = random.integers(1, 6)
        target = np.array((index * ROOM, 1.3 * (-1) ** index, 1.5))
        origin, cutoff, colour = (target[0] + random.choice((-2.5, 2.5)), side * 3.0, HEIGHT - 0.6), 14, WHITE
    # At equal flux a narrower beam has a higher intensity
    power *= 0.6 / (1 - np.cos(np.radians(cutoff)))
    return (
        f'<emitter type="spot"><transform name="to_world"><lookat origin="{numbers(origin)}" '
        f'target="{numbers(target)}" up="1, 0, 0"/></transform><float name="cutoff_angle" value="{cutoff}"/>'
        f"{spectrum('intensity', power, colour, random)}</emitter>"
    )


def area(random, power):
    """Return a globe in the nave or in a gallery, or a panel on the ceiling of a side room."""
    if random.random() < 0.5:
        # Large and moderately bright: otherwise antialiasing of its edge would dominate the error at few samples
        radius = round(random.uniform(0.12, 0.2), 3)
        nave, side = random.random() < 0.3, random.choice((-1, 1))
        across, height = (random.uniform(2.2, 3.4), 4.8) if nave else (random.uniform(NAVE + 1, SIDE - 0.6), 6.2)
        position = (random.uniform(2.5, LENGTH - 1), side * across, height)
        radiance = spectrum("radiance", 0.6 * power / (np.pi * radius**2), random.choice((WARM, WHITE)), random)
        return ball("plaster", position, radius, f'<emitter type="area">{radiance}</emitter>')
    width, depth = random.uniform(0.15, 0.5, 2)
    colour, place = room_of(random)
    position = place(random.random(), random.random(), ROOM_HEIGHT - 0.01)
    radiance = spectrum("radiance", 2 * power / (4 * width * depth), colour, random)
    return (
        f'<shape type="rectangle"><transform name="to_world"><scale x="{width:.3g}" y="{depth:.3g}"/>'
        f'<rotate x="1" angle="180"/><translate value="{numbers(position)}"/></transform><ref id="plaster"/>'
        f'<emitter type="area">{radiance}</emitter></shape>'
    )


def lights(count, random):
    """Yield `count` lights with constant total power: 10% area, 30% spot, otherwise point emitters."""
    power = 1500.0 / count  # mean radiant intensity of a bulb, W/sr
    areas, spots = count // 10, 3 * count // 10
    yield from (area(random, power) for _ in range(areas))
    yield from (spot(random, power) for _ in range(spots))
    yield from (point(random, power) for _ in range(count - areas - spots))


def hall(count, seed):
    """Return the scene as XML text, determined by the number of lights (at least 1) and the seed."""
    if count < 1:
        raise ValueError(f"a hall needs at least one light, not {count}")
    # Two random streams, so that the building does not depend on the number of lights or on the seed
    building, lamps = np.random.default_rng(7), np.random.default_rng(seed)
    parts = [HEADER.format(lights=count, seed=seed), *map(material, MATERIALS)]
    parts += [*shell(), *rooms(building), *nave(building), *lights(count, lamps), "</scene>"]
    return "\n".join(parts) + "\n"


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--lights", type=int, default=1000, metavar="N", help="number of lights (default: 1000)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the lights (default: 1)")
    parser.add_argument("--output", type=Path, default=Path("hall.xml"), help="output file (default: hall.xml)")
    options = parser.parse_args(arguments)
    try:
        options.output.write_text(hall(options.lights, options.seed))
    except (ValueError, OSError) as error:
        parser.exit(2, f"hall: {error}\n")


if __name__ == "__main__":
    main()
