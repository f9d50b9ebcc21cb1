"""Modules of plugins are imported when a scene uses them, in every variant."""

import subprocess
import sys

from tests.support.paths import ROOT
from tests.support.processes import PATIENCE

BEGIN = """
import sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import integrators

def loaded():
    return sorted(name for name in integrators.PLUGINS if f"integrators.{name}" in sys.modules)

def belongs(*names):
    return [isinstance(mi.load_dict({"type": name}), mi.SamplingIntegrator) for name in names]
"""
USES = """
print(loaded())
scene = mi.load_file("scenes/cornell.xml", integrator="vpl")
print(loaded(), isinstance(scene.integrator(), mi.SamplingIntegrator))
mi.set_variant("llvm_ad_mono")
print(loaded(), belongs("vpl", "lightcuts"))
print(loaded())
mi.set_variant("scalar_rgb")
for name in "vpl", "mdlightcuts":
    try:
        mi.load_dict({"type": name})
    except RuntimeError as error:
        print(f'"{name}" does not support the variant "scalar_rgb"' in str(error))
"""
SHARED = """
print(belongs("adaptivedirect"))
mi.set_variant("llvm_ad_mono")
print(belongs("vpl", "manylights", "adaptivedirect"))
mi.set_variant("llvm_ad_rgb")
print(belongs(*integrators.PLUGINS) == len(integrators.PLUGINS) * [True])
"""
TWICE = """
parts = "".join(f'<integrator type="vpl"><integer name="vpl_count" value="{n}"/></integrator>' for n in range(90, 98))
text = f'<scene version="3.0.0"><integrator type="moment">{parts}</integrator></scene>'
print(mi.load_string(text).integrator().class_name(), loaded())
"""


def lines(script):
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + script], capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_plugins_are_loaded_when_a_scene_uses_them():
    expected = ["[]", "['vpl'] True", "['vpl'] [True, True]", "['lightcuts', 'vpl']", "True", "True"]
    assert lines(USES) == expected


def test_modules_first_loaded_in_another_variant_share_their_base_class():
    assert lines(SHARED) == ["[True]", "[True, True, True]", "True"]


def test_threads_of_mitsuba_load_a_plugin_once():
    assert lines(TWICE) == ["MomentIntegrator ['vpl']"]
