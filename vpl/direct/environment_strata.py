"""Regions of an environment map for few, well-placed samples: structured importance sampling (NumPy only) [SIS].

An area of integrated illumination L and solid angle Ω has the importance Γ = L Ω^(1/4) [SIS section 3]: between
sampling by light alone and by area alone, because what blocks a wide area varies more.  No Ω counts as less than
0.01 sr.

The map is cut at the levels t_i = iσ, i = 0 ... 5, σ being the standard deviation of its illumination [SIS section 4].
From the brightest level down, every connected component is due its share of the samples by Γ, less the centres that
brighter levels have already placed inside it.  The missing ones are placed farthest first (Hochbaum and Shmoys): each
where the distance to all centres of the component is greatest.

A component's layer is what is left of it without the layers of brighter components.  At the end, every cell joins the
nearest of the centres that lie in its layer, so that a bright spot which is due a sample shares no region with what is
around it.

Directions are (sin θ cos φ, sin θ sin φ, cos θ): z is up, θ = 0 is the upper edge of the first row, and φ grows from +x
towards +y along the columns.

Departures from the paper, and why:

- The component of t_0 is every cell that is not black, connected or not, instead of the whole sphere: samples of black
  areas are wasted.  Black cells join the nearest of all centres.
- Shares are rounded to the nearest number, so that a bright spot worth half a sample gets one; where that makes too
  many, the components that miss most come first.  t_0 gets all samples that are left.
- A layer in which no centre lies is dissolved into the darker layer around it, as it was not worth a sample.
- The first centre of a component that has none is its brightest cell (the first of several in the order of the rows).
- Levels and shares are found from radiances relative to the greatest one in single precision: the rounding that a scale
  of the map brings does not move them.

[SIS] Agarwal, Ramamoorthi, Belongie and Jensen 2003, Structured importance sampling of environment maps.
"""

from __future__ import annotations

from numbers import Integral

import numpy as np

from ..core.cones import mean_axes

_LEVELS = 6
_AREA_EXPONENT, _LEAST_SOLID_ANGLE = 0.25, 0.01
# Cells whose distances to all centres are compared at a time: the table fits in a second-level cache
_CHUNK = 512
# A mean direction that is shorter than this is rounding
_BALANCED = 1e-6
# Cosines of cones are lowered by this much, so that no cone loses a corner to rounding
_COSINE_ROUNDING = 1e-14


def stratify(radiance, count: int = 300) -> np.ndarray:
    """Label the region of every cell: (height, width) int32, from 0 for the first centre that was placed.

    radiance: (height, width) real numbers, finite and at least 0: the mean radiance of each cell of a grid of equal
    steps in θ (rows, from the pole at +z to the one at -z) and φ (columns, all around); any unit, only ratios count.
    Cells dimmer than 1e-45 of the brightest one count as black.
    count: regions to make, at least 1.

    There are as many regions as ``count`` or as cells that are not black, whichever is less, but at least one; unless
    the map is black, every region holds light.  The same input gives the same labels.

    Raises ValueError, naming the argument, where an input is not as described.
    """
    radiance = _checked(radiance, count)
    # Single precision forgets how the division rounded
    values = (radiance.reshape(-1) / (radiance.max() or 1)).astype(np.float32).astype(np.float64)
    lit = values > 0
    if not lit.any():
        return np.zeros(radiance.shape, np.int32)
    unit, solid_angle = _cells(*radiance.shape)
    share_of_sphere = solid_angle / solid_angle.sum()
    deviation = np.sqrt(np.dot((values - np.dot(values, share_of_sphere)) ** 2, share_of_sphere))
    levels = [_components((values >= i * deviation).reshape(radiance.shape)) for i in range(_LEVELS - 1, 0, -1)]
    levels.append(np.where(lit, 0, -1))
    centres = _place(levels, values, unit, solid_angle, min(count, int(np.count_nonzero(lit))))
    return _assign(levels, unit, centres).reshape(radiance.shape)


def cones(labels) -> tuple[np.ndarray, np.ndarray]:
    """Cones around regions: axes (k, 3), unit vectors, and cosines of half-angles (k,), both float64.

    labels: (height, width) integers; k is the greatest one plus 1.  Cells with negative labels are left out.

    The axis is the mean direction of a region's cells by solid angle; the cone holds these cells whole, edges and
    inside as well as corners.  Where the mean vanishes (the region is the whole sphere, two opposite cells, or empty),
    the cone is the whole sphere: +z and -1.

    Raises ValueError if ``labels`` is not as described.
    """
    labels = np.asarray(labels)
    if labels.ndim != 2 or labels.size == 0 or labels.dtype.kind not in "iu":
        raise ValueError(
            f"labels must be integers of a shape (height, width) that is not empty, got {labels.dtype} {labels.shape}"
        )
    used = np.flatnonzero(labels >= 0)
    label = labels.reshape(-1)[used].astype(np.int64)
    size = int(label.max(initial=-1)) + 1
    unit, solid_angle = (of_cells[used] for of_cells in _cells(*labels.shape))
    total = np.bincount(label, solid_angle, size)
    axis = np.stack([np.bincount(label, solid_angle * unit[:, k], size) for k in range(3)], axis=1, dtype=np.float64)
    axis, balanced = mean_axes(axis, (0, 0, 1), _BALANCED * total)
    cosine = np.ones(size)
    np.minimum.at(cosine, label, _lowest_cosine(axis[label], *np.divmod(used, labels.shape[1]), labels.shape))
    cosine[balanced] = -1
    return axis, np.maximum(cosine - _COSINE_ROUNDING, -1)


def _checked(radiance, count) -> np.ndarray:
    """The radiance in double precision, once both arguments of ``stratify`` are as described there."""
    radiance = np.asarray(radiance)
    if radiance.ndim != 2 or radiance.size == 0 or radiance.dtype.kind not in "fiu":
        raise ValueError(
            "radiance must be real numbers of a shape (height, width) that is not empty, "
            f"got {radiance.dtype} {radiance.shape}"
        )
    radiance = radiance.astype(np.float64)
    allowed = np.isfinite(radiance) & (radiance >= 0)
    if not allowed.all():
        row, column = np.argwhere(~allowed)[0].tolist()
        raise ValueError(f"radiance must be finite and at least 0, but [{row}, {column}] is {radiance[row, column]}")
    if not isinstance(count, Integral) or count < 1:
        raise ValueError(f"count must be an integer of at least 1, got {count!r}")
    return radiance


def _cells(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the middles of all cells, (height * width, 3), and their solid angles in sr, (height * width,)."""
    theta = ((np.arange(height) + 0.5) * (np.pi / height))[:, None]
    phi = (np.arange(width) + 0.5) * (2 * np.pi / width)
    unit = np.empty((height, width, 3))
    unit[..., 0], unit[..., 1], unit[..., 2] = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    # The difference of the cosines at both edges of a row, without its cancellation at the poles
    solid_angle = 2 * np.sin(theta[:, 0]) * np.sin(np.pi / (2 * height)) * (2 * np.pi / width)
    return unit.reshape(-1, 3), np.repeat(solid_angle, width)


def _components(mask: np.ndarray) -> np.ndarray:
    """Number the connected components of the cells in ``mask``, (height, width): (height * width,), -1 outside it.

    Cells that share an edge are connected, also across φ = 0, and so are all cells around a pole.
    """
    cells = np.arange(mask.size).reshape(mask.shape)
    starts = mask.copy()
    starts[:, 1:] &= ~mask[:, :-1]
    # Every run of cells along a row is a tree whose root is the first of them; roots are the least cells of their trees
    root = np.where(mask.reshape(-1), np.maximum.accumulate(np.where(starts, cells, 0).reshape(-1)), cells.reshape(-1))
    below, across = mask[:-1] & mask[1:], mask[:, 0] & mask[:, -1]
    edges = [(cells[:-1][below], cells[1:][below]), (cells[across, 0], cells[across, -1])]
    for pole in (0, -1):
        around = cells[pole, mask[pole]]
        edges.append((around, np.broadcast_to(around[:1], around.shape)))
    one, other = (np.concatenate(ends) for ends in zip(*edges, strict=True))
    while len(one):
        one, other = root[one], root[other]
        apart = one != other
        one, other = one[apart], other[apart]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while ((higher := root[root]) != root).any():
            root = higher
    number = np.cumsum((root == cells.reshape(-1)) & mask.reshape(-1)) - 1
    return np.where(mask.reshape(-1), number[root], -1)


def _place(levels, values: np.ndarray, unit: np.ndarray, solid_angle: np.ndarray, count: int) -> np.ndarray:
    """Cells of ``count`` centres, in the order in which they are placed; ``levels``: from the brightest down."""
    whole = _importance(levels[-1], values, solid_angle)
    is_centre, centres = np.zeros(len(values), bool), []
    for component in levels:
        importance = _importance(component, values, solid_angle)
        placed = np.bincount(component[centres], minlength=len(importance))
        spare = np.bincount(component[component >= 0], minlength=len(importance)) - placed
        new = _round_off(count - len(centres), np.maximum(importance * (count / whole) - placed, 0), spare)
        for which in np.flatnonzero(new):
            cells = np.flatnonzero(component == which)
            kept = np.flatnonzero(is_centre[cells])
            chosen = cells[_farthest_first(unit[cells], values[cells], kept, int(new[which]))]
            is_centre[chosen] = True
            centres.extend(chosen.tolist())
    return np.array(centres)


def _importance(component: np.ndarray, values: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """Importance Γ of every component [SIS section 3]."""
    inside = component >= 0
    light = np.bincount(component[inside], (values * solid_angle)[inside])
    return light * np.maximum(np.bincount(component[inside], solid_angle[inside]), _LEAST_SOLID_ANGLE) ** _AREA_EXPONENT


def _round_off(total: int, wanted: np.ndarray, spare: np.ndarray) -> np.ndarray:
    """Round to the nearest whole numbers, none above ``spare``, the greatest first until their sum is ``total``."""
    order = np.argsort(-wanted, kind="stable")
    given = np.minimum(np.floor(wanted + 0.5).astype(np.int64), spare)[order]
    result = np.empty_like(given)
    result[order] = np.clip(total - (np.cumsum(given) - given), 0, given)
    return result


def _farthest_first(unit: np.ndarray, values: np.ndarray, kept: np.ndarray, new: int) -> list[int]:
    """Indices of ``new`` more centres among directions, each as far as can be from ``kept`` and those before it."""
    centres = kept.tolist()
    nearest = np.full(len(unit), -2.0)
    for number in range(len(kept) + new):
        if number == len(centres):
            centres.append(int(np.argmin(nearest) if centres else np.argmax(values)))
        np.maximum(nearest, unit @ unit[centres[number]], out=nearest)
        nearest[centres[number]] = np.inf
    return centres[len(kept) :]


def _assign(levels, unit: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The centre that every cell joins, as an index into ``centres``: (n,) int32."""
    label = np.full(len(unit), -1, np.int32)
    for component in levels:
        free = np.flatnonzero((label[centres] < 0) & (component[centres] >= 0))
        for which in np.unique(component[centres[free]]):
            layer = np.flatnonzero((component == which) & (label < 0))
            own = free[component[centres[free]] == which]
            label[layer] = own[_nearest(unit[layer], unit[centres[own]])]
            # Whatever the rounding of distances between the smallest of cells
            label[centres[own]] = own
    rest = np.flatnonzero(label < 0)
    label[rest] = _nearest(unit[rest], unit[centres])
    return label


def _nearest(unit: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Index of the nearest of ``centres``, (k, 3), for every direction of ``unit``, (n, 3)."""
    result = np.empty(len(unit), np.int64)
    for i in range(0, len(unit), _CHUNK):
        np.argmax(unit[i : i + _CHUNK] @ centres.T, axis=1, out=result[i : i + _CHUNK])
    return result


def _lowest_cosine(axis: np.ndarray, row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The least cosine between an axis, (n, 3), and any direction in the cell at its row and column: (n,)."""
    height, width = shape
    # The azimuth at which the cell begins, seen from the one opposite to the axis; the least cosine is next to that
    begin = (column * (2 * np.pi / width) - np.arctan2(axis[:, 1], axis[:, 0]) - np.pi) % (2 * np.pi)
    end = begin + 2 * np.pi / width
    across = -np.hypot(axis[:, 0], axis[:, 1]) * np.where(end >= 2 * np.pi, 1, np.maximum(np.cos(begin), np.cos(end)))
    # Along a meridian the cosine is a wave, lowest at an end of the cell unless its trough lies in between
    top, bottom = row * (np.pi / height), (row + 1) * (np.pi / height)
    ends = [across * np.sin(theta) + axis[:, 2] * np.cos(theta) for theta in (top, bottom)]
    trough = np.arctan2(-across, -axis[:, 2])
    return np.where((top <= trough) & (trough <= bottom), -np.hypot(across, axis[:, 2]), np.minimum(*ends))
