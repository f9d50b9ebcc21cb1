"""Render the preview pictures of the scenes by `lightcuts` with adaptive direct light. Exceptions: direct light alone
for the forest, emitters as virtual lights for the veils, `manylights` for the globes.

./run -- python scenes/previews.py [NAME...]
"""

import sys
from pathlib import Path

import mitsuba as mi

FOLDER = Path(__file__).resolve().parent
WIDTH, SAMPLES, FEW_SAMPLES, DEPTH, DEEP = 192, 16, 4, 8, 24
DIRECT = ("forest_lights",)  # tracing light paths through the leaves takes minutes
IN_GLASS, MANY_SAMPLES = ("globes",), 1024  # only `manylights` sends paths to the glass
BEHIND_MASKS = ("veils",)  # next-event estimation does not pass masks, as in Mitsuba's integrators


def preview(name):
    """Write NAME.png beside NAME.xml, with the aspect ratio of the scene's film."""
    path = FOLDER / f"{name}.xml"
    film = mi.load_file(str(path)).sensors()[0].film().size()
    height = round(WIDTH * film[1] / film[0])
    scene = mi.load_file(str(path), resx=str(WIDTH), resy=str(height))
    if name in DIRECT:
        integrator, samples = {"type": "adaptivedirect"}, FEW_SAMPLES
    elif name in IN_GLASS:
        integrator, samples = {"type": "manylights", "max_depth": DEEP}, MANY_SAMPLES
    else:
        direct = "vpl" if name in BEHIND_MASKS else "adaptive"
        depth = DEEP if name in BEHIND_MASKS else DEPTH
        integrator, samples = {"type": "lightcuts", "max_depth": depth, "direct": direct}, SAMPLES
    image = mi.render(scene, integrator=mi.load_dict(integrator), spp=samples)
    mi.util.write_bitmap(str(FOLDER / f"{name}.png"), image, write_async=False)


def main(names):
    mi.set_variant("llvm_ad_rgb")
    sys.path.insert(0, str(FOLDER.parent))
    import integrators  # noqa: F401

    for name in names or sorted(path.stem for path in FOLDER.glob("*.xml")):
        preview(name)


if __name__ == "__main__":
    main(sys.argv[1:])
