"""Images of every plugin on small scenes, saved for a comparison with another version of the code.

    python benchmarks/equal_images.py --save before.npz     in the checkout of one version
    python benchmarks/equal_images.py --against before.npz  in that of another

For changes that must keep images.  Two runs of one version differ by about 1e-6 of an image's mean, because sums over
threads have no fixed order.  Prints the largest difference of each image, and exits with 1 if one exceeds
``TOLERANCE``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SCENES = ("cornell", "glossy", "kitchen_windows")
# Scenes of ``manylights`` besides, for its many emitters, and images that are large enough for its pilot
SPLIT_SCENES = (*SCENES, "hall", "concourse", "veils")
SPLIT_SIZE, SPLIT_SPP = "32", 16
# Largest difference of a pixel, relative to the mean of the image
TOLERANCE = 1e-5
SETTINGS = {
    "vpl": {"vpl_count": 500},
    "lightcuts": {"vpl_count": 2000, "error": 0.05},
    "mdlightcuts": {"vpl_count": 2000, "error": 0.05},
    "lightslice": {"vpl_count": 2000, "slices": 16, "columns": 60},
    "matrixrecovery": {"vpl_count": 2000},
    "illuminationcut": {"vpl_count": 2000, "error": 0.05},
    "illuminationcut, adaptive": {"vpl_count": 2000, "error": 0.05, "visibility": "adaptive"},
    "lightcuts, adaptive": {"vpl_count": 2000, "error": 0.05, "direct": "adaptive"},
    "lightcuts, vpl": {"vpl_count": 2000, "error": 0.05, "direct": "vpl"},
    "adaptivedirect": {"error": 0.1},
    "unoccludeddirect": {"error": 0.1},
}


def images() -> dict[str, np.ndarray]:
    """An image for every scene and setting, by name."""
    found = {}
    for name in SCENES:
        scene = mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resx="24", resy="24", spp="4")
        for label, settings in SETTINGS.items():
            direct_only = label.endswith("direct")
            plugin = {"type": label.split(",")[0], "max_depth": 2 if direct_only else 4} | settings
            image = mi.render(scene, integrator=mi.load_dict(plugin), spp=4, seed=1)
            found[f"{name}: {label}"] = np.array(image)
            print(f"{name}: {label}", file=sys.stderr, flush=True)
    return found | split_images()


def split_images() -> dict[str, np.ndarray]:
    """Images of ``manylights`` with virtual lights wherever they can carry anything, and without, by name."""
    from vpl.split.cost_model import CostModel

    found = {}
    for name in SPLIT_SCENES:
        scene = mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resx=SPLIT_SIZE, resy=SPLIT_SIZE)
        for lights in (True, False):
            plugin = mi.load_dict({"type": "manylights", "max_depth": 6, "virtual_lights": lights})
            plugin.cost_model = CostModel(pays_below=1e30, fewest_light_paths=4000)
            label = f"{name}: manylights" + ("" if lights else ", traced")
            found[label] = np.array(mi.render(scene, integrator=plugin, spp=SPLIT_SPP, seed=1))
            print(label, file=sys.stderr, flush=True)
    return found


def main() -> int:
    """Render, then save or compare; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--save", type=Path, metavar="FILE", help="write the images to this file (.npz)")
    what.add_argument("--against", type=Path, metavar="FILE", help="compare the images with those of this file")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    import integrators  # noqa: F401

    found = images()
    if arguments.save:
        np.savez_compressed(arguments.save, **found)
        return 0
    differing = 0
    with np.load(arguments.against) as before:
        for name, image in found.items():
            largest = float(np.abs(image - before[name]).max() / max(before[name].mean(), 1e-30))
            differing += not largest <= TOLERANCE
            print(f"{name:45s} {largest:.1e}{'' if largest <= TOLERANCE else '  differs'}")
    return int(differing > 0)


if __name__ == "__main__":
    sys.exit(main())
