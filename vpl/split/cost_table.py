"""The constants of the cost model as a Markdown table."""

from __future__ import annotations

from dataclasses import fields

from .cost_model import CostModel


def table() -> str:
    """Name, value, unit, meaning and evidence of each constant of :class:`vpl.split.cost_model.CostModel`."""
    lines = ["| constant | value | unit | meaning | evidence |", "|---|---|---|---|---|"]
    for one in fields(CostModel):
        about = one.metadata
        lines.append(
            f"| `{one.name}` | {one.default:.6g} | {about['unit']} | {about['meaning']} | {about['evidence']} |"
        )
    return "\n".join(lines)
