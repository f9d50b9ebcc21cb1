"""Pictures of the matrices of a slice [MSR figure 7]."""

from __future__ import annotations

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

from vpl.core.arrays import download


def draw_slice(plugin, job, number: int, file, note: dict) -> None:
    """Recover the slices of a batch and draw slice ``number``, from 0 and clipped to the last.

    ``plugin``: a ``matrixrecovery`` integrator; ``job``: the batch; ``note``: metadata of the file.
    """
    work = plugin.start(job)
    number = min(number, work.entries.rows.slices - 1)
    for block, found in plugin.recovered(job, work):
        inside = block.begin <= number < block.begin + block.slices
        if inside and found.part is not None and found.part.counts[number - block.begin][0]:
            _draw(_panels(block, found, number), f"slice {number}", file, note | {"plugin": str(plugin)})
            return
    raise ValueError(f"slice {number} was skipped: it receives no light, or no entries are uncertain")


def _panels(block, found, number: int) -> dict:
    """Matrices to draw, (rows, columns) each, restricted to the separated columns."""
    part, piece = found.part, number - block.begin
    rows = part.counts[piece][1]

    def matrix(values, of):
        return download(values).reshape(of.shape)[piece][: of.counts[piece][0], :rows].T

    chosen = np.isin(block.slot[block.columns.piece == number], _slots(block, part, number))
    whole = {"light": found.unoccluded, "predicted": found.predicted, "recovered": found.visibility}
    light, predicted, recovered = (matrix(values, block)[:, chosen] for values in whole.values())
    traced = matrix(mi.Float(found.traced), block)[:, chosen]
    exact = mi.Float(found.predicted)
    everything = mi.UInt32(np.flatnonzero(download(found.unoccluded) > 0).astype(np.uint32))
    block.trace(exact, everything, mi.UInt32(1))
    exact = matrix(exact, block)[:, chosen]
    panels = {
        "(a) D, corrupted": predicted * light,
        "(b) traced": traced,
        "(c) L, separated": np.clip(predicted - matrix(found.error, part), 0, 1) * light,
        "(d) Z, errors": np.abs(matrix(found.error, part)) * light,
    }
    if found.density is not None:
        panels["(e) density of errors"] = matrix(found.density, part)
    panels |= {
        "(f) recovered": recovered * light,
        "(g) remaining errors": np.abs(recovered - exact) * light,
        "(h) all traced": exact * light,
    }
    values = {
        "of light": np.linalg.svd(exact * light, compute_uv=False),
        "of V": np.linalg.svd(exact, compute_uv=False),
    }
    return panels | {"(i) singular values": values}


def _slots(block, part, number: int) -> np.ndarray:
    """Slots of a part's columns within the block."""
    inside, wanted = block.columns.piece == number, part.columns.piece == number
    keys = {(g, n) for g, n in zip(part.columns.group[wanted], part.columns.node[wanted], strict=True)}
    pairs = zip(block.columns.group[inside], block.columns.node[inside], block.slot[inside], strict=True)
    return np.array([slot for group, node, slot in pairs if (group, node) in keys])


def _draw(panels: dict, title: str, file, note: dict) -> None:
    figure, axes = plt.subplots(3, 3, figsize=(13, 13), layout="constrained")
    light = max(np.percentile(panels["(h) all traced"], 99), 1e-30)
    for axis, (name, values) in zip(axes.flat, panels.items(), strict=False):
        axis.set_title(name)
        if isinstance(values, dict):
            for label, one in values.items():
                axis.semilogy(np.arange(1, len(one) + 1), one / max(one[0], 1e-30), label=label)
            axis.set_ylim(1e-4, 1.2)
            axis.legend()
            continue
        largest = 1.0 if "traced" == name[4:] or "density" in name else light
        axis.imshow(values, aspect="auto", cmap="magma", vmin=0, vmax=largest, interpolation="nearest")
        axis.set_xlabel("columns")
        axis.set_ylabel("rows")
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    figure.suptitle(f"{note['scene']}, {title}")
    figure.savefig(file, dpi=80, metadata={key: str(value) for key, value in note.items()})
    plt.close(figure)
