"""Generate a bush of 4000 leaves under a sky.

Purpose: paths that virtual lights do not shorten.  Every leaf is lit by the sky through gaps, and light between leaves
travels short distances.

    python scenes/foliage.py --output scenes/foliage.xml
"""

import numpy as np
from elements import box, header, material, sky, sky_image, write_scene
from forest_lights import leaves

SKY, MESH = "foliage_sky.exr", "foliage_leaves.ply"
LEAVES, RADIUS, HEIGHT = 4000, 1.5, 1.4  # number; of the bush, in metres
LENGTH, WIDTH = 0.2, 0.11  # of a leaf, in metres
MATERIALS = [material("leaf", (0.28, 0.42, 0.10)), material("ground", (0.34, 0.28, 0.2))]


def bush():
    """Return the triangles of leaves throughout an ellipsoid."""
    random = np.random.default_rng(7)
    outward = random.normal(0, 1, (LEAVES, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    inside = random.uniform(0, 1, (LEAVES, 1)) ** (1 / 3)
    return leaves(outward * inside * (RADIUS, RADIUS, HEIGHT) + (0, 0, HEIGHT + 0.1), outward, LENGTH, WIDTH, random)


def garden(seed):
    """Return the scene as XML text."""
    command = f"foliage.py --seed {seed} --output scenes/foliage.xml"
    mesh = (
        f'<shape type="ply"><string name="filename" value="{MESH}"/><boolean name="face_normals" value="true"/>'
        '<ref id="leaf"/></shape>'
    )
    parts = [header(command, "A bush under a sky", 48, (3.2, -2.4, 1.7), (0, 0, 1.35), 6), *MATERIALS, mesh]
    return "\n".join([*parts, box("ground", (-9, -9, -0.2), (9, 9, 0)), sky(SKY), "</scene>"]) + "\n"


def day_sky():
    """Return the texels of a sky with a sun."""
    return sky_image((0.4, 0.6, 1.1), (0.8, 0.8, 0.7), (0.1, 0.1, 0.1), (400, 360, 290), (0.5, -0.6, 0.9), 4, 0.003)


def main(arguments=None):
    write_scene(__doc__, "foliage", garden, {SKY: day_sky()}, arguments, meshes={MESH: bush()})


if __name__ == "__main__":
    main()
