"""Plugins are loaded when a scene uses them, in every variant."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPT = """
import sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import integrators

def loaded():
    return sorted(name for name in integrators.PLUGINS if f"integrators.{name}" in sys.modules)

print(loaded())
scene = mi.load_file("scenes/cornell.xml", integrator="vpl")
print(loaded(), isinstance(scene.integrator(), mi.SamplingIntegrator))
mi.set_variant("llvm_ad_mono")
print(loaded(), [isinstance(mi.load_dict({"type": name}), mi.SamplingIntegrator) for name in ("vpl", "lightcuts")])
print(loaded())
mi.set_variant("scalar_rgb")
for name in "vpl", "mdlightcuts":
    try:
        mi.load_dict({"type": name})
    except RuntimeError as error:
        print(f'"{name}" does not support the variant "scalar_rgb"' in str(error))
"""


def test_plugins_are_loaded_when_a_scene_uses_them():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "[]", "['vpl'] True", "['vpl'] [True, True]", "['lightcuts', 'vpl']", "True", "True",
    ]  # fmt: skip
