"""Traversal of a light tree for many points at once, with the nodes of the cuts stored as they are found.

The sizes of the cuts are unknown before the traversal.  It therefore has rounds: a point stores a limited number of
nodes in a round, and the points whose cuts have more nodes continue in the next round, closed up to full packets.  A
processor that works on packets of points waits for the longest cut of a packet: the rounds also save this time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NO_LIMIT, download, upload
from ..lights.light_set import LightGroup
from ..points.surfaces import Batch
from ..transport.bounds import contribution_bound, expected_error

# Nodes of a cut stored in the first round, and the factor from round to round; powers of two. Time of cuts over that
# without rounds, 64 samples: kitchen 0.79, staircase2 0.89, veach_ajar 0.84, living_room 0.89; with 64 nodes
# as long, with 128 up to 0.09 more
_FIRST, _GROWTH = 16, 4
# Largest number of entries for the nodes of the cuts of a traversal (64 MB). Nodes beyond are found again
_LARGEST_STORE = 1 << 24


def step(group: LightGroup, batch: Batch, threshold, smallest_distance, i):
    """Visit node ``i``: (whether the cut contains it, next node).  A bound of zero skips the node's subtree."""
    node = group.tree.gather(i)
    bound = contribution_bound(group.kind, batch.receiver, node, smallest_distance)
    error = expected_error(group.kind, batch.receiver, node, bound) if batch.receiver.by_expected_error else bound
    reached = bound > 0
    taken = reached & ((node.escape == i + 1) | (error <= threshold))
    return taken, dr.select(taken | ~reached, node.escape, i + 1)


@dr.syntax
def _walk(group: LightGroup, batch: Batch, threshold, smallest_distance: float, start, stored, most, nodes, offset):
    """Traverse a group's tree for every point from the node ``start`` on, until ``most`` nodes of the cut are found:
    (next node, nodes found, nodes visited).

    Writes the first ``stored`` nodes found to ``nodes``, from the index ``offset`` on.
    """
    end, clamp = dr.opaque(mi.UInt32, group.tree.count), dr.opaque(mi.Float, smallest_distance)
    i, count, visits = mi.UInt32(start), dr.zeros(mi.UInt32, batch.count), dr.zeros(mi.UInt32, batch.count)
    while dr.hint((i < end) & (count < most), exclude=[group, batch, stored, most, nodes, offset]):
        taken, following = step(group, batch, threshold, clamp, i)
        dr.scatter(nodes, i, offset + count, taken & (count < stored))
        count += dr.select(taken, 1, 0)
        visits += 1
        i = following
    dr.eval(i, count, visits, nodes)
    return i, count, visits


@dataclass
class Round:
    """Nodes of a round: ``size`` entries in ``nodes`` for each of the points ``rows`` (k,), the nodes of their cuts
    from the place ``place`` on."""

    rows: mi.UInt32
    place: int
    size: int
    nodes: mi.UInt32

    def copy(self, first: mi.UInt32, known, offset, nodes) -> None:
        """Copy the nodes of the points from ``first`` on to ``nodes``: the first ``known`` (n,) nodes of each cut, from
        the index ``offset`` (n,) on."""
        lane, size = dr.arange(mi.UInt32, dr.width(self.nodes)), dr.opaque(mi.UInt32, self.size)
        # Processors have no division of packets of integers: sizes are powers of two
        row = dr.gather(mi.UInt32, self.rows, lane >> dr.opaque(mi.UInt32, self.size.bit_length() - 1)) - first
        place, own = (lane & (size - 1)) + dr.opaque(mi.UInt32, self.place), row < dr.opaque(mi.UInt32, dr.width(known))
        own &= place < dr.gather(mi.UInt32, known, row, own)
        dr.scatter(nodes, self.nodes, dr.gather(mi.UInt32, offset, row, own) + place, own)
        dr.eval(nodes)


@dataclass
class Cuts:
    """Cuts of points (n,) through the tree of a group of lights, UInt32.

    ``count``: nodes in the cut; ``visits``: computed bounds; ``known``: number of the stored nodes, the first of the
    cut; ``onward``: node from which a traversal finds the rest; ``rounds``: the stored nodes.
    """

    count: mi.UInt32
    visits: mi.UInt32
    known: mi.UInt32
    onward: mi.UInt32
    rounds: list[Round] = field(default_factory=list)

    def replace(self, rows: mi.UInt32, count: mi.UInt32, visits: mi.UInt32) -> None:
        """Replace the cuts of the points ``rows`` by those of ``count`` nodes with other thresholds, which are not
        stored; add to ``visits``."""
        for target, value in ((self.count, count), (self.known, mi.UInt32(0)), (self.onward, mi.UInt32(0))):
            dr.scatter(target, value, rows)
        dr.scatter(self.visits, dr.gather(mi.UInt32, self.visits, rows) + visits, rows)
        dr.eval(self.count, self.visits, self.known, self.onward)


def several(index: np.ndarray) -> np.ndarray:
    """Indices (n,), a single one twice: arrays of one entry would change the kernels."""
    return np.repeat(index, 2) if len(index) == 1 else index


def traverse(group: LightGroup, batch: Batch, threshold, smallest_distance: float, most: int) -> Cuts:
    """The cuts of all points of a ``batch``; cuts end at the first node beyond ``most`` (0: no limit)."""
    cuts = Cuts(*(dr.zeros(mi.UInt32, batch.count) for _ in range(4)))
    rows, start, batch_of = dr.arange(mi.UInt32, batch.count), dr.zeros(mi.UInt32, batch.count), batch
    place, size, room, most = 0, _FIRST, _LARGEST_STORE, most or NO_LIMIT - 1
    while dr.width(rows):
        points = dr.width(rows)
        stores = points * size <= room
        # At least two entries: arrays of one change the kernels
        nodes = dr.empty(mi.UInt32, max(points * size, 2) if stores else 2)
        offset = dr.arange(mi.UInt32, points) * dr.opaque(mi.UInt32, size)
        limit = min(size, most + 1 - place) if stores else most + 1 - place
        stored, limits = (dr.opaque(mi.UInt32, x, points) for x in (size if stores else 0, limit))
        thresholds = dr.gather(mi.Float, threshold, rows)
        dr.eval(rows, nodes, offset, thresholds)
        dr.make_opaque(start)
        i, count, visits = _walk(
            group, batch_of, thresholds, smallest_distance, start, stored, limits, nodes, offset
        )  # fmt: skip
        dr.scatter(cuts.count, count + dr.opaque(mi.UInt32, place), rows)
        dr.scatter(cuts.visits, dr.gather(mi.UInt32, cuts.visits, rows) + visits, rows)
        if stores:
            cuts.rounds.append(Round(rows, place, size, nodes))
            dr.scatter(cuts.known, count + dr.opaque(mi.UInt32, place), rows)
            dr.scatter(cuts.onward, i, rows)
        dr.eval(cuts.count, cuts.visits, cuts.known, cuts.onward)
        place, room = place + limit, room - points * size
        if not stores or place > most:
            break
        more = dr.compress((i < group.tree.count) & (count == limit))
        if len(more) == 1:
            more = upload(mi.UInt32, several(download(more)))
        rows, start = (dr.gather(mi.UInt32, x, more) for x in (rows, i))
        batch_of, size = batch_of.select(more) if len(more) else batch_of, size * _GROWTH
    return cuts


def collect(group: LightGroup, batch: Batch, threshold, smallest_distance: float, cuts: Cuts, first: int, length):
    """(Rows of the ``batch``, nodes, offset and number of entries per point, nodes visited per point) of cuts.

    The points of the batch are those of ``cuts`` from ``first`` on, and have ``length`` (n,) nodes, NumPy.  Rounding
    may change the rest of a cut between the traversals; nodes beyond ``length`` are dropped, and a point may have fewer
    entries.
    """
    count = len(length)
    rows, nodes = upload(mi.UInt32, np.repeat(np.arange(count), length)), dr.zeros(mi.UInt32, int(length.sum()))
    offset, begin = upload(mi.UInt32, np.cumsum(length) - length), dr.opaque(mi.UInt32, first)
    points = dr.arange(mi.UInt32, count) + begin
    known, visits = dr.gather(mi.UInt32, cuts.known, points), dr.zeros(mi.UInt32, count)
    dr.eval(nodes, known, visits)
    for one in cuts.rounds:
        one.copy(begin, known, offset, nodes)
    written, rest = mi.UInt32(known), several(np.flatnonzero(download(known) < length))
    if len(rest):
        row = upload(mi.UInt32, rest)
        start = dr.gather(mi.UInt32, cuts.onward, row + begin)
        place, left = dr.gather(mi.UInt32, known, row), upload(mi.UInt32, length[rest])
        left -= place
        place += dr.gather(mi.UInt32, offset, row)
        thresholds = dr.gather(mi.Float, threshold, row + begin)
        dr.eval(row, start, place, left, thresholds)
        _, found, visited = _walk(
            group, batch.select(row), thresholds, smallest_distance, start, left, left, nodes, place
        )  # fmt: skip
        dr.scatter(written, dr.gather(mi.UInt32, known, row) + found, row)
        dr.scatter(visits, visited, row)
        dr.eval(written, visits)
    return rows, nodes, offset, written, visits
