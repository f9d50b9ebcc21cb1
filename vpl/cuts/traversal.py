"""Traversal of a light tree for many points at once, with the nodes of the cuts stored as they are found.

The sizes of the cuts are unknown before the traversal.  It therefore has rounds: a point stores a limited number of
nodes in a round, and the points whose cuts have more nodes continue in the next round, gathered into full packets.  A
processor that works on packets of points waits for the longest cut of a packet: the rounds also save this time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NO_LIMIT, download, upload
from ..lights.light_set import LightGroup
from ..points.surfaces import Receiver
from ..transport.bounds import contribution_bound, expected_error

# Nodes of a cut stored in the first round, and the factor from round to round; powers of two. Time of cuts over that
# without rounds, 64 samples: kitchen 0.79, staircase2 0.89, veach_ajar 0.84, living_room 0.89; 64 nodes
# take as long, 128 up to 0.09 more
_FIRST, _GROWTH = 16, 4
# Largest number of entries for the nodes of the cuts of some points through all trees (64 MB). Nodes beyond are found
# again
LARGEST_STORE = 1 << 24


def _step(group: LightGroup, receiver: Receiver, threshold, smallest_distance, i):
    """Visit node ``i``: (whether the cut contains it, next node).  A bound of zero skips the node's subtree."""
    node = group.tree.gather(i)
    bound = contribution_bound(group.kind, receiver, node, smallest_distance)
    error = expected_error(group.kind, receiver, node, bound) if receiver.by_expected_error else bound
    reached = bound > 0
    taken = reached & ((node.escape == i + 1) | (error <= threshold))
    return taken, dr.select(taken | ~reached, node.escape, i + 1)


@dr.syntax
def _walk(
    group: LightGroup, receiver: Receiver, threshold, smallest_distance: float, start, stored, most, nodes, offset
):  # fmt: skip
    """Traverse a group's tree for every point from the node ``start`` on, until ``most`` nodes of the cut are found:
    (next node, nodes found, nodes visited, whether the tree goes on behind ``most`` nodes).

    Writes the first ``stored`` nodes found to ``nodes``, from the index ``offset`` on.
    """
    end, clamp = dr.opaque(mi.UInt32, group.tree.count), dr.opaque(mi.Float, smallest_distance)
    i, count, visits = mi.UInt32(start), dr.zeros(mi.UInt32, dr.width(start)), dr.zeros(mi.UInt32, dr.width(start))
    while dr.hint((i < end) & (count < most), exclude=[group, receiver, stored, most, nodes, offset]):
        taken, following = _step(group, receiver, threshold, clamp, i)
        dr.scatter(nodes, i, offset + count, taken & (count < stored))
        count += dr.select(taken, 1, 0)
        visits += 1
        i = following
    going = (i < end) & (count == most)
    dr.eval(i, count, visits, going, nodes)
    return i, count, visits, going


@dataclass
class Round:
    """Nodes of a round: ``size`` entries in ``nodes`` for each of the points ``rows`` (k,), ascending, the nodes of
    their cuts from the place ``place`` on."""

    rows: np.ndarray
    place: int
    size: int
    nodes: mi.UInt32

    def copy(self, first: int, known, offset, nodes) -> None:
        """Copy the nodes of the points from ``first`` on to ``nodes``: the first ``known`` (n,) nodes of each cut, from
        the index ``offset`` (n,) on."""
        begin, end = np.searchsorted(self.rows, [first, first + dr.width(known)])
        if begin == end:
            return
        lane, size = dr.arange(mi.UInt32, int(end - begin) * self.size), dr.opaque(mi.UInt32, self.size)
        # Processors have no division of packets of integers: sizes are powers of two
        own = upload(mi.UInt32, several(self.rows[begin:end] - first))
        row = dr.gather(mi.UInt32, own, lane >> dr.opaque(mi.UInt32, self.size.bit_length() - 1))
        place = (lane & (size - 1)) + dr.opaque(mi.UInt32, self.place)
        found = place < dr.gather(mi.UInt32, known, row)
        node = dr.gather(mi.UInt32, self.nodes, lane + dr.opaque(mi.UInt32, int(begin) * self.size))
        dr.scatter(nodes, node, dr.gather(mi.UInt32, offset, row) + place, found)
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

    @property
    def entries(self) -> int:
        """Number of entries for stored nodes."""
        return sum(dr.width(one.nodes) for one in self.rounds)

    def add(self, rows: mi.UInt32, place: int, count, visits, onward) -> None:
        """Add ``count`` nodes of the points ``rows``, after ``place`` nodes; ``onward``: next node, None if the nodes
        are not stored."""
        whole = count + dr.opaque(mi.UInt32, place)
        dr.scatter(self.count, whole, rows)
        dr.scatter(self.visits, dr.gather(mi.UInt32, self.visits, rows) + visits, rows)
        if onward is not None:
            dr.scatter(self.known, whole, rows)
            dr.scatter(self.onward, onward, rows)
        dr.eval(self.count, self.visits, self.known, self.onward)

    def replace(self, rows: mi.UInt32, count: mi.UInt32, visits: mi.UInt32) -> None:
        """Replace the cuts of the points ``rows`` by those of ``count`` nodes with other thresholds, which are not
        stored; add to ``visits``."""
        for target in (self.known, self.onward):
            dr.scatter(target, mi.UInt32(0), rows)
        self.add(rows, 0, count, visits, None)


def several(index: np.ndarray) -> np.ndarray:
    """Indices (n,), a single one twice: arrays of one entry would change the kernels."""
    return np.repeat(index, 2) if len(index) == 1 else index


def traverse(
    group: LightGroup, receiver: Receiver, threshold, smallest_distance: float, most: int, room: int
) -> Cuts:  # fmt: skip
    """The cuts of all points ``receiver``; cuts end at the first node beyond ``most`` (0: no limit).

    ``room``: largest number of entries for stored nodes.
    """
    cuts = Cuts(*(dr.zeros(mi.UInt32, receiver.count) for _ in range(4)))
    rows, start = np.arange(receiver.count), dr.zeros(mi.UInt32, receiver.count)
    dr.make_opaque(cuts.count, cuts.visits, cuts.known, cuts.onward, start)
    place, size, most = 0, _FIRST, most or NO_LIMIT - 1
    while len(rows):
        points, stores = len(rows), len(rows) * size <= room
        nodes = dr.empty(mi.UInt32, points * size if stores else 2)
        limit = min(size, most + 1 - place) if stores else most + 1 - place
        row, offset = upload(mi.UInt32, rows), dr.arange(mi.UInt32, points) * dr.opaque(mi.UInt32, size)
        stored, limits = (dr.opaque(mi.UInt32, x, points) for x in (size if stores else 0, limit))
        thresholds = dr.gather(mi.Float, threshold, row)
        dr.eval(nodes, offset, thresholds)
        i, count, visits, going = _walk(
            group, receiver, thresholds, smallest_distance, start, stored, limits, nodes, offset
        )
        cuts.add(row, place, count, visits, i if stores else None)
        if stores:
            cuts.rounds.append(Round(rows, place, size, nodes))
        place, room, size = place + limit, room - points * size, size * _GROWTH
        if not stores or place > most:
            break
        more = several(np.flatnonzero(download(going)))
        if len(more):
            index = upload(mi.UInt32, more)
            rows, start, receiver = rows[more], dr.gather(mi.UInt32, i, index), receiver.select(index)
            dr.eval(start)
        else:
            rows = more
    return cuts


def collect(group: LightGroup, receiver: Receiver, threshold, smallest_distance: float, cuts: Cuts, first: int, length):
    """(Rows of the points, nodes, offset and number of entries per point, nodes visited per point) of cuts.

    The points ``receiver`` are those of ``cuts`` from ``first`` on, and have ``length`` (n,) nodes, NumPy.  Rounding
    may change the rest of a cut between the traversals; nodes beyond ``length`` are dropped, and a point may have fewer
    entries.
    """
    count = len(length)
    rows = upload(mi.UInt32, np.repeat(np.arange(count, dtype=np.uint32), length))
    nodes, visits = dr.zeros(mi.UInt32, int(length.sum())), dr.zeros(mi.UInt32, count)
    offset, begin = upload(mi.UInt32, np.cumsum(length) - length), dr.opaque(mi.UInt32, first)
    known = dr.gather(mi.UInt32, cuts.known, dr.arange(mi.UInt32, count) + begin)
    dr.eval(known)
    dr.make_opaque(nodes, visits)
    for one in cuts.rounds:
        one.copy(first, known, offset, nodes)
    written, rest = mi.UInt32(known), several(np.flatnonzero(download(known) < length))
    if len(rest):
        row = upload(mi.UInt32, rest)
        start, before = dr.gather(mi.UInt32, cuts.onward, row + begin), dr.gather(mi.UInt32, known, row)
        left, place = upload(mi.UInt32, length[rest]) - before, dr.gather(mi.UInt32, offset, row) + before
        thresholds = dr.gather(mi.Float, threshold, row + begin)
        dr.eval(start, before, left, place, thresholds)
        _, found, visited, _ = _walk(
            group, receiver.select(row), thresholds, smallest_distance, start, left, left, nodes, place
        )
        dr.scatter(written, before + found, row)
        dr.scatter(visits, visited, row)
        dr.eval(written, visits)
    return rows, nodes, offset, written, visits
