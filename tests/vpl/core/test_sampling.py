"""Sequences of numbers that fill the unit cube evenly."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.rendering import render
from tests.support.scenes import area_light, sensor, wall
from vpl.core.arrays import download, upload
from vpl.core.sampling import (
    Choice,
    PairNumbers,
    RowChoice,
    SpreadSamples,
    independent_sampler,
    precise_sample,
)

SEQUENCES, MEMBERS = 2000, 64


@pytest.fixture
def members(variant):
    """The first members of many sequences, (sequences, members, 3)."""
    lane = dr.arange(mi.UInt32, SEQUENCES * MEMBERS)
    return download(SpreadSamples.of(lane // MEMBERS, 5).at(lane % MEMBERS)).reshape(SEQUENCES, MEMBERS, 3)


def test_every_number_alone_is_uniform_and_below_one(members):
    assert members.min() >= 0 and members.max() < 1
    for member in (0, 1, MEMBERS - 1):
        for axis in range(3):
            assert stats.kstest(members[:, member, axis], "uniform").pvalue > 1e-4


def test_sequences_and_axes_are_independent(members):
    starts = members[:, 0].T
    assert np.abs(np.corrcoef(starts) - np.eye(3)).max() < 0.1
    assert np.abs(np.corrcoef(starts[:, :-1], starts[:, 1:])[:3, 3:]).max() < 0.1


@pytest.mark.parametrize("count", [4, 16, 64])
def test_means_have_far_less_noise_than_those_of_independent_numbers(members, count):
    values = np.prod(1 + np.cos(np.pi * members[:, :count]), axis=2)
    independent = values[:, 0].var() / count
    assert values.mean(1).var() < independent * 2 / count**0.5
    assert values.mean() == pytest.approx(1, abs=4 * float(values.mean(1).std()) / SEQUENCES**0.5)


def test_other_seeds_give_other_sequences(variant):
    lane = dr.arange(mi.UInt32, 8)
    first, second = (download(SpreadSamples.of(lane, seed).at(mi.UInt32(0))[0]) for seed in (1, 2))
    assert np.abs(first - second).min() > 0


def test_rays_of_a_pixel_share_a_sequence(variant):
    """Sixteen rays with a sample each have as little variance as a ray with sixteen samples."""
    floor = wall([0, -1, 0], [1, 0, 0], -90, 2.0)
    scene = mi.load_dict({"type": "scene", "sensor": sensor(16, 1), "floor": floor, "lamp": area_light()})

    def noise(rays, samples):
        given = {"max_depth": 2, "emitter_samples": samples}
        images = np.stack([render(scene, "lightcuts", rays, seed, **given) for seed in range(12)])
        lit = images.mean(0) > 0
        return np.median(images.std(0)[lit] / images.mean(0)[lit])

    assert noise(16, 1) < 1.5 * noise(1, 16)
    assert noise(16, 1) < 0.3 * noise(1, 1)


@pytest.mark.parametrize("rows", [1, 3, 8000, 100_000])
def test_rows_are_drawn_with_exactly_the_claimed_probability(rows):
    """By every number that a sampler of Mitsuba may draw."""
    weight = np.random.default_rng(0).random(rows) ** 20
    weight[1::7] = 0
    choice = Choice(weight)
    count = 1 << 23
    drawn = download(choice.row(mi.Float(dr.arange(mi.UInt32, count)) * 2.0**-23))
    assert np.array_equal(np.bincount(drawn, minlength=rows) / count, choice.pmf)
    assert np.array_equal(choice.pmf > 0, weight > 0)
    assert np.array_equal(download(choice.probability(dr.arange(mi.UInt32, rows))), choice.pmf.astype(np.float32))
    assert np.abs(choice.pmf - weight / weight.sum()).max() < 1e-5 + rows * 2.0**-22 * weight.max() / weight.sum()


@pytest.mark.parametrize("lengths", [[1], [1, 5, 1], [300, 2, 7, 4000], [3] * 2000])
def test_members_of_rows_are_drawn_with_exactly_the_claimed_probability(lengths):
    lengths, random = np.array(lengths), np.random.default_rng(0)
    weight = random.random(lengths.sum()) ** 20
    # Of each row, at the beginning, in the middle or at the end, some that are never drawn
    row, first = np.repeat(np.arange(len(lengths)), lengths), np.cumsum(lengths) - lengths
    weight[random.random(len(weight)) < 0.3] = 0
    weight[first + random.integers(0, lengths)] += 1e-3
    share = weight / np.bincount(row, weight)[row]
    choice = RowChoice(share, lengths)
    count = (1 << 23) // len(lengths)
    number, of = np.arange(1 << 23) % count, np.minimum(np.arange(1 << 23) // count, len(lengths) - 1)
    number = number * ((1 << 23) // count)
    place = choice.draw(upload(mi.UInt32, of), upload(mi.Float, number * 2.0**-23))
    drawn = np.searchsorted(choice.place, download(place))
    assert np.array_equal(choice.place[drawn], download(place))
    assert np.array_equal(download(choice.probability(place)), choice.pmf[drawn].astype(np.float32))
    assert np.array_equal(row[drawn], of)
    after = np.cumsum(choice.pmf)
    whole = np.concatenate([[0.0], after])[first][of]
    assert (after[drawn] - choice.pmf[drawn] - whole <= number * 2.0**-23).all()
    assert (number * 2.0**-23 < after[drawn] - whole).all()
    assert np.array_equal(choice.pmf > 0, share > 0)
    assert np.abs(choice.pmf - share).max() < 1e-5
    assert np.array_equal(np.bincount(row, choice.pmf), np.ones(len(lengths)))


def test_numbers_of_pairs_are_uniform_uncorrelated_and_independent_of_the_lane(variant):
    first, second = (x.ravel().astype(np.uint32) for x in np.mgrid[0:300, 0:300])
    later = slice(len(first) // 2, None)

    def numbers(seed, rows=slice(None)):
        pairs = PairNumbers(seed, dr.full(mi.UInt32, 8, 300))
        return download(pairs.random(*(upload(mi.UInt32, x[rows]) for x in (first, second))))

    number, again, other = numbers(5), numbers(5, later), numbers(6)
    assert number.min() >= 0 and number.max() < 1 and stats.kstest(number, "uniform").pvalue > 1e-4
    assert np.array_equal(number[later], again)
    # Neighbours along either index, and two seeds
    grid = number.reshape(300, 300)
    for one, two in [(grid[1:], grid[:-1]), (grid[:, 1:], grid[:, :-1]), (number, other)]:
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 5 / np.sqrt(one.size)


def test_systematic_samples_are_uniform_and_select_successive_intervals(variant):
    sequences, places, sizes = 3000, 40, np.array([1, 3, 7, 64, 1000], np.uint32)
    sequence, place = (x.ravel().astype(np.uint32) for x in np.mgrid[0:sequences, 0:places])
    size = sizes[np.arange(sequences) % len(sizes)]
    pairs = [upload(mi.UInt32, x) for x in (sequence, place)]
    samples = [download(PairNumbers(seed, upload(mi.UInt32, size)).systematic(*pairs)) for seed in (5, 6)]
    for at in (0, 1, places - 1):
        assert stats.kstest(samples[0][place == at], "uniform").pvalue > 1e-4
    assert 0 <= samples[0].min() and samples[0].max() < 1
    starts = [one[place == 0] for one in samples]
    assert abs(np.corrcoef(*starts)[0, 1]) < 5 / np.sqrt(sequences)
    interval = np.floor(samples[0] * size[sequence]).reshape(sequences, places)
    # A step is rounded down to a multiple of 2^-32
    moved = (np.diff(interval, axis=1) - 1) % size[:, None]
    assert np.mean(moved == 0) > 0.999


def test_precise_numbers_have_bits_below_those_of_the_sampler(variant):
    values = download(precise_sample(independent_sampler(1, 100_000)))
    assert values.dtype == np.float64 and values.min() >= 0 and values.max() < 1
    for fraction in (values, values * 2**23 % 1):
        assert stats.kstest(fraction, "uniform").pvalue > 1e-4
