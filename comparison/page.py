"""The page `report.html`: one file that needs no other, and no network. Its parts lie in the folder `page`."""

import base64
import json
from pathlib import Path

import jinja2
import numpy as np
from matplotlib import colormaps

from . import analysis, images, paper_tables, plots, tables
from .curves import pareto

PARTS = Path(__file__).parent / "page"
KINDS = {"relative": "relative error", "distance": "distance × 16", "flip": "FLIP"}


def render(results, pictures, reference_text):
    """Return the page for the content of `results.json` and the `Pictures` (or None) of each of its scenes."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PARTS), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html.jinja").render(
        results=results,
        scenes=[_scene(*pair, results) for pair in zip(results["scenes"], pictures, strict=True)],
        columns=tables.COLUMNS,
        explanation=tables.EXPLANATION,
        reference_text=reference_text,
        embedded=embedded,
        kinds=KINDS,
        metric=plots.ERRORS[results["metrics"]["compared"]],
        error_range=[f"{value:.0%}" for value in images.ERROR_RANGE],
        false_colours=", ".join(f"rgb{tuple(map(int, stop))}" for stop in images.FALSE_COLOURS),
        palettes=_palettes(),
        script=(PARTS / "viewer.js").read_text(),
        style=(PARTS / "report.css").read_text(),
    )


def _scene(scene, pictures, results):
    """Return what the template shows of a scene."""
    metric = results["metrics"]["compared"]
    labels = list(dict.fromkeys(render["label"] for render in scene["renders"]))
    views = pictures.views if pictures else []
    shown = {"result": scene, "name": scene["name"], "error": scene.get("error"), "rows": tables.rows(scene)}
    # "</" would end the script element that holds it.
    shown["views"] = json.dumps(views).replace("</", "<\\/") if views else None
    shown["has_maps"] = any(view["maps"] for view in views)
    shown |= {"block": pictures.block if pictures else 1, "plots": [], "comparisons": []}
    for cost, of in analysis.points(scene["renders"], metric):
        if len(of) > 1:
            shown["plots"].append(plots.error_against(cost, of, pareto(of), labels, metric))
        for title, table in (("equal error", tables.equal_errors), ("equal cost", tables.equal_costs)):
            if rows := table(scene, cost):
                shown["comparisons"].append((cost, title, rows))
    shown["paper_tables"] = paper_tables.shown(scene)
    shown["warnings"] = tables.warnings(scene, results["machine"]["cores"])
    counted = {render["label"] for render in scene["renders"] if render.get("rays_per_sample") is not None}
    shown["uncounted"] = [label for label in labels if label not in counted]
    return shown


def _palettes():
    """Return colours (256 times 3 bytes, a list) of each kind of map."""
    steps = np.linspace(0, 1, 256)
    magma = (colormaps["magma"](steps)[:, :3] * 255 + 0.5).astype(int)
    grey = images.tone_map(np.repeat(steps[:, None], 3, axis=1), 1.0)
    found = {"relative": images.palette(steps), "distance": grey, "flip": magma}
    return json.dumps({kind: colours.ravel().tolist() for kind, colours in found.items()})


def embedded(file):
    """Return a PNG file as a data URL."""
    return "data:image/png;base64," + base64.b64encode(Path(file).read_bytes()).decode()
