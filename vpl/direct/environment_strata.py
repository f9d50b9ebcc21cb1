"""Regions of an environment map by structured importance sampling (NumPy only) [SIS].

An area of integrated illumination L and solid angle Ω has the importance Γ = L Ω^(1/4) [SIS section 3].  The exponent
compromises between sampling by light and by area, because visibility varies more over a wide area.  Ω is at least
0.01 sr.

The map is thresholded at the levels t_i = iσ, i = 0 ... 5, with σ the standard deviation of the illumination [SIS
section 4].  From the brightest level down, every connected component is allotted a number of samples proportional to Γ,
less the centres that brighter levels have placed inside.  New centres are placed by farthest-first traversal (Hochbaum
and Shmoys): each at the greatest distance from the existing centres of the component.

A component's layer excludes the layers of brighter components.  Finally every cell joins the nearest centre of its
layer, so that a bright spot with a sample of its own shares no region with its surroundings.

Directions are (sin θ cos φ, sin θ sin φ, cos θ): z is up, θ = 0 is the upper edge of the first row, and φ grows from +x
towards +y along the columns.

Departures from the paper, and why:

- The component of t_0 is the set of cells that are not black, connected or not, instead of the whole sphere: samples
  of black areas are wasted.  Black cells join the nearest centre.
- Shares are rounded to the nearest integer: a bright spot with a share of half a sample gets one.  If the sum is too
  large, components with the largest deficits take precedence.  t_0 gets the remaining samples.
- A layer without a centre joins the darker layer around it.
- The first centre of a component is its brightest cell (the first in row order in case of ties).
- Levels and shares are computed from single-precision radiances relative to the greatest: scaling the map does not
  change them.

[SIS] Agarwal, Ramamoorthi, Belongie and Jensen 2003, Structured importance sampling of environment maps.
"""

from __future__ import annotations

from numbers import Integral

import numpy as np

from ..core.cones import mean_axes

_LEVELS = 6
_AREA_EXPONENT, _LEAST_SOLID_ANGLE = 0.25, 0.01
# Cells compared with the centres at a time: the table of distances fits in a second-level cache
_CHUNK = 512
# Length of a mean direction below which it is rounding error
_BALANCED = 1e-6
# Safety margin on the cosines of cones, against rounding
_COSINE_ROUNDING = 1e-14


def stratify(radiance, count: int = 300) -> np.ndarray:
    """Label the region of every cell: (height, width) int32, in the order of placement of the centres.

    radiance: (height, width) real numbers, finite and at least 0: the mean radiance of each cell of a grid of equal
    steps in θ (rows, from +z to -z) and φ (columns, all around), in any unit.  Cells dimmer than 1e-45 of the brightest
    count as black.
    count: number of regions, at least 1.

    The number of regions is the lesser of ``count`` and the number of cells that are not black, but at least one.
    Unless the map is black, every region holds light.  The result is deterministic.

    Raises ValueError, naming the argument, for invalid input.
    """
    radiance = _checked(radiance, count)
    # Rounding to single precision removes the rounding of the division
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

    labels: (height, width) integers; k is the greatest label plus 1.  Cells with negative labels are left out.

    The axis is the mean direction of a region's cells by solid angle.  The cone contains every direction of the cells.
    If the mean vanishes (the whole sphere, two opposite cells, or no cell), the cone is the whole sphere: +z and -1.

    Raises ValueError for invalid ``labels``.
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
    """Validate the arguments of ``stratify``, and return the radiance in double precision."""
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
    """Directions of the centres of cells, (height * width, 3), and solid angles in sr, (height * width,)."""
    theta = ((np.arange(height) + 0.5) * (np.pi / height))[:, None]
    phi = (np.arange(width) + 0.5) * (2 * np.pi / width)
    unit = np.empty((height, width, 3))
    unit[..., 0], unit[..., 1], unit[..., 2] = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    # Difference of the cosines at both edges of a row, without cancellation at the poles
    solid_angle = 2 * np.sin(theta[:, 0]) * np.sin(np.pi / (2 * height)) * (2 * np.pi / width)
    return unit.reshape(-1, 3), np.repeat(solid_angle, width)


def _components(mask: np.ndarray) -> np.ndarray:
    """Number the connected components of ``mask``, (height, width): (height * width,), -1 outside the mask.

    Cells that share an edge are connected, also across φ = 0.  The cells around a pole are connected, too.
    """
    cells = np.arange(mask.size).reshape(mask.shape)
    starts = mask.copy()
    starts[:, 1:] &= ~mask[:, :-1]
    # Union-find: every run of cells along a row is a tree; the root of a tree is its least cell
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
    """Cells of ``count`` centres, in order of placement; ``levels``: from the brightest down."""
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
    """Round to the nearest integers, at most ``spare``, in descending order until the sum is ``total``."""
    order = np.argsort(-wanted, kind="stable")
    given = np.minimum(np.floor(wanted + 0.5).astype(np.int64), spare)[order]
    result = np.empty_like(given)
    result[order] = np.clip(total - (np.cumsum(given) - given), 0, given)
    return result


def _farthest_first(unit: np.ndarray, values: np.ndarray, kept: np.ndarray, new: int) -> list[int]:
    """Indices of ``new`` centres among directions, each farthest from ``kept`` and from the centres before."""
    centres = kept.tolist()
    nearest = np.full(len(unit), -2.0)
    for number in range(len(kept) + new):
        if number == len(centres):
            centres.append(int(np.argmin(nearest) if centres else np.argmax(values)))
        np.maximum(nearest, unit @ unit[centres[number]], out=nearest)
        nearest[centres[number]] = np.inf
    return centres[len(kept) :]


def _assign(levels, unit: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Index into ``centres`` of the centre that every cell joins, (n,) int32."""
    label = np.full(len(unit), -1, np.int32)
    for component in levels:
        free = np.flatnonzero((label[centres] < 0) & (component[centres] >= 0))
        for which in np.unique(component[centres[free]]):
            layer = np.flatnonzero((component == which) & (label < 0))
            own = free[component[centres[free]] == which]
            label[layer] = own[_nearest(unit[layer], unit[centres[own]])]
            # Rounding of distances between tiny cells must not move a centre to another region
            label[centres[own]] = own
    rest = np.flatnonzero(label < 0)
    label[rest] = _nearest(unit[rest], unit[centres])
    return label


def _nearest(unit: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Index of the nearest centre, (k, 3), of every direction in ``unit``, (n, 3)."""
    result = np.empty(len(unit), np.int64)
    for i in range(0, len(unit), _CHUNK):
        np.argmax(unit[i : i + _CHUNK] @ centres.T, axis=1, out=result[i : i + _CHUNK])
    return result


def _lowest_cosine(axis: np.ndarray, row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Least cosine between an axis, (n, 3), and any direction in the cell at a row and a column: (n,)."""
    height, width = shape
    # Azimuth of the cell's first edge relative to the azimuth opposite to the axis, near which the cosine is least
    begin = (column * (2 * np.pi / width) - np.arctan2(axis[:, 1], axis[:, 0]) - np.pi) % (2 * np.pi)
    end = begin + 2 * np.pi / width
    across = -np.hypot(axis[:, 0], axis[:, 1]) * np.where(end >= 2 * np.pi, 1, np.maximum(np.cos(begin), np.cos(end)))
    # Along a meridian the cosine is sinusoidal: least at an end of the cell unless its minimum lies in between
    top, bottom = row * (np.pi / height), (row + 1) * (np.pi / height)
    ends = [across * np.sin(theta) + axis[:, 2] * np.cos(theta) for theta in (top, bottom)]
    trough = np.arctan2(-across, -axis[:, 2])
    return np.where((top <= trough) & (trough <= bottom), -np.hypot(across, axis[:, 2]), np.minimum(*ends))
