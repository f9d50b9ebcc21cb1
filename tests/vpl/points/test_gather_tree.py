"""Gather trees: a branch per pixel."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.properties import examples
from vpl.points import gather_tree
from vpl.points.gather_tree import build_gather_tree


def nodes_that_hold(tree, pixel):
    """For every pixel, the nodes whose points are exactly those of the pixel."""
    along = pixel[tree.order]
    end = tree.first.astype(np.int64) + tree.count
    whole = (along[tree.first] == along[end - 1]) & (tree.count == np.bincount(pixel)[along[tree.first]])
    return np.bincount(along[tree.first][whole], minlength=pixel.max() + 1)


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 300),
    width=st.integers(1, 9),
    flat=st.booleans(),
    most=st.sampled_from([1, 3, 50]),
)
@settings(max_examples=examples(40), deadline=None)
def test_every_pixel_has_a_branch_of_its_own(seed, count, width, flat, most):
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, 40, count)
    position = rng.normal(size=(count, 3)).astype(np.float32) * (0 if flat else 10.0 ** rng.uniform(-6, 6))
    normal = rng.normal(size=(count, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tree = build_gather_tree(pixel, width, most, position, normal)
    assert np.array_equal(np.sort(tree.order), np.arange(count))
    assert (tree.count[tree.child == 0] <= most).all()
    assert (np.diff(pixel[tree.order])[np.diff(tree.leaf.astype(int)) == 0] == 0).all()
    inner = np.flatnonzero(tree.child)
    assert np.array_equal(tree.count[inner], tree.count[tree.child[inner]] + tree.count[tree.child[inner] + 1])
    assert (nodes_that_hold(tree, pixel)[np.unique(pixel)] == 1).all()


def test_points_of_one_wall_are_divided_from_those_of_another():
    rng = np.random.default_rng(1)
    facing = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 32, axis=0)
    position = rng.uniform(-1, 1, (64, 3)) * (1 - facing)
    mixed = rng.permutation(64)
    tree = build_gather_tree(np.zeros(64, int), 1, 1, position[mixed], facing[mixed])
    walls = facing[mixed][tree.order]
    for child in (tree.child[0], tree.child[0] + 1):
        inside = walls[tree.first[child] : tree.first[child] + tree.count[child]]
        assert len(inside) == 32 and (inside == inside[0]).all()


def test_more_pixels_leave_fewer_bits_for_what_is_inside_of_one(monkeypatch):
    rng = np.random.default_rng(0)
    pixel = np.repeat(np.arange(40_000), 2)
    position, normal = rng.random((80_000, 3)).astype(np.float32), np.tile(np.float32([0, 0, 1]), (80_000, 1))
    for code_bits, expected in ((63, 39), (40, 24)):
        monkeypatch.setattr(gather_tree, "_CODE_BITS", code_bits)
        codes, bits = gather_tree.gather_codes(pixel, 200, position, normal)
        assert bits == expected and int(codes.max()).bit_length() <= code_bits
        of_pixel = codes.reshape(-1, 2) >> np.uint64(bits)
        assert (np.diff(of_pixel) == 0).all() and len(np.unique(of_pixel)) == 40_000
