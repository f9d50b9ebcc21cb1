"""Files of a comparison: tables as text, `results.json` (see results.schema.json) and `report.html`."""

import json
from datetime import UTC, datetime
from pathlib import Path

from . import images, machine, metrics, paper_tables, tables, verdict

FORMAT = 2  # of results.json; incremented by incompatible changes


def describe(command, options, scenes, complete):
    """Return the content of `results.json` for the results (dicts) of scenes; `complete`: no runs are pending."""
    return {
        "format": FORMAT,
        "command": command,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "complete": complete,
        "seeds": options.seeds,
        "variant": options.mode,
        "versions": machine.software(),
        "machine": machine.describe(),
        "metrics": {"epsilon": metrics.EPSILON, "trimmed": metrics.TRIMMED, "compared": options.metric},
        "summary": verdict.summarise(scenes, options.metric),
        "scenes": scenes,
    }


def text(scene):
    """Return the results of a scene as plain-text tables."""
    parts = [f"{scene['name']}: FAILED: {scene['error']}"] if "error" in scene else []
    rows = tables.rows(scene)
    if not rows:
        return "\n".join(parts)
    parts.append(f"{scene['name']}, reference: {reference_text(scene)}")
    parts.append(tables.text([list(tables.COLUMNS), *(row for row in rows if len(row) > 2)]))
    parts += [f"{row[0]}: FAILED: {row[1]}" for row in rows if len(row) == 2]
    for title, table in (
        ("time [s] at equal error", tables.equal_errors(scene, "seconds")),
        ("error at equal time", tables.equal_costs(scene, "seconds")),
    ):
        if table:
            parts += ["", f"{title} (in brackets: improvement factor over {table[0][1]}, 95% interval)"]
            parts.append(tables.text(table))
    for table in paper_tables.shown(scene):
        parts += ["", table["title"], tables.text([table["head"], *table["rows"]]), table["reading"]]
    parts += tables.warnings(scene, machine.cores())
    return "\n".join(parts)


def reference_text(scene):
    """Describe the reference of a scene in a few words."""
    reference = scene.get("reference")
    if reference is None:
        return "vpl, with the same VPLs" if any(map(_has_vpl, scene["renders"])) else "none"
    text = ", ".join(
        f"{reference[key]}{unit}" for key, unit in (("integrator", ""), ("spp", " spp")) if key in reference
    )
    if reference["noise"]:
        text += f" (noise: rel. L1 {reference['noise']['relative_l1']:.2%}, relMSE {reference['noise']['relmse']:.2g})"
    return (text or "an image of unknown origin") + _limit_text(scene)


def _limit_text(scene):
    """Return a note if --reference-limit stopped the reference above its permitted noise, else an empty text."""
    if not any("errors" in render for render in scene["renders"]) or "reference_fraction" not in scene:
        return ""
    share = scene["reference_share"]
    if share is None:
        return "; stopped at --reference-limit with noise larger than an error"
    if share > scene["reference_fraction"]:
        return f"; stopped at --reference-limit with noise up to {share:.0%} of an error"
    return ""


def write(folder, results, pictures, finished=()):
    """Write `results.json` and `report.html` to a folder; return the sections of the page. `pictures`: the `Pictures`
    (or None) of each scene; `finished`: sections of the first scenes, as an earlier call returned them."""
    from . import page  # needs matplotlib, an optional package

    folder, scenes = Path(folder), list(zip(results["scenes"], pictures, strict=True))
    with images.replacing(folder / "results.json") as file:
        file.write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    sections = [*finished, *(page.section(*one, results, reference_text) for one in scenes[len(finished) :])]
    with images.replacing(folder / "report.html") as file:
        file.write_text(page.render(results, sections), encoding="utf-8")
    return sections


def _has_vpl(render):
    return bool(render.get("vpl_output"))
