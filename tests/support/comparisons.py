"""Scene files and results of comparisons."""

import json

import jsonschema

from tests.support.paths import CORNELL, ROOT

SWEEP = [
    CORNELL, "-i", "path,lightcuts,vpl", "--width", "24", "--max-depth", "3", "--sweep", "path:spp=1,8", "--sweep",
    "lightcuts:error=0.4,0.1", "--sweep", "vpl:vpl_count=2000", "-p", "lightcuts.vpl_count=2000", "--seeds", "2",
    "--reference", "path:auto:0.9", "--spp", "1",
]  # fmt: skip


SCHEMA = json.loads((ROOT / "comparison" / "results.schema.json").read_text())


def results_of(out):
    results = json.loads((out / "results.json").read_text())
    jsonschema.validate(results, SCHEMA, jsonschema.Draft202012Validator)
    return results


TWO_SENSORS = """
<scene version="3.0.0"><emitter type="constant"/><integrator type="path"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/>
</film></sensor>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="6"/>
</film></sensor></scene>
"""
