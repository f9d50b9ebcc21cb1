"""The balance of lights and paths: decisions for images of known noise."""

from dataclasses import fields, replace

import numpy as np
import pytest

from vpl.split import plan
from vpl.split.cost_model import CostModel
from vpl.split.cost_table import table
from vpl.split.emitter_samples import EmitterSamples
from vpl.split.plan import Decision, Evidence, Option, choose, priced

DENOISED = CostModel()
# Lights pay as in raw images, and are as many as in denoised ones
MODEL = replace(DENOISED, denoised_power=1.0)
# No emitter is seen directly
UNSEEN = 0.0


def price(evidence, option):
    """The price alone."""
    return priced(evidence, option)[0]


def balanced(direct, indirect, paths, samples, left=None):
    """The balance of an image of an even brightness; ``left``: of it besides lights on surfaces, if measured."""
    option = Option(True, False, direct + indirect, indirect, left if left is None else lambda: left)
    return choose(
        Evidence(direct + indirect, UNSEEN, direct, np.ones(len(direct)), paths, samples, False, MODEL), [option]
    )


def test_lights_pay_where_indirect_light_is_the_noise_and_only_there():
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    none = np.zeros(10_000)
    assert balanced(none, indirect, 10**8, 64).light_paths > 0
    assert balanced(none, indirect, 10**4, 64).light_paths == 0
    assert balanced(direct, 1e-3 * indirect, 10**7, 64).light_paths == 0
    assert choose(Evidence(direct, UNSEEN, direct, none + 1, 10**8, 64, False, MODEL), []).light_paths == 0


def test_images_that_are_denoised_have_more_lights():
    """The number of lights grows with the root of the weight of shared variance."""
    rng = np.random.default_rng(0)
    indirect, none = rng.exponential(size=10_000), np.zeros(10_000)

    def light_paths(model):
        option = Option(True, False, indirect, indirect)
        evidence = Evidence(indirect, UNSEEN, none, np.ones(10_000), 10**7, 1024, False, model)
        return choose(evidence, [option]).light_paths

    unlimited = replace(MODEL, most_light_share=1.0, most_light_paths=10**9)
    assert light_paths(unlimited) == pytest.approx(2 * light_paths(unlimited.without_denoiser()), rel=0.05)


def test_images_that_are_denoised_need_lights_that_remove_more_variance():
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    none = np.zeros(10_000)
    for share, pays in ((0.0, True), (2.0, False)):
        traced = share * direct + indirect
        evidence = Evidence(traced, UNSEEN, share * direct + none, np.ones(10_000), 10**8, 64, False, MODEL)
        option = [Option(True, False, traced, indirect)]
        assert choose(evidence, option).light_paths > 0
        assert (choose(replace(evidence, model=DENOISED), option).light_paths > 0) == pays


def test_a_pass_of_plain_paths_is_predicted_to_cost_less():
    """The costs of passes of 8 and 64 samples, of which the larger one has plain paths."""
    none = np.zeros(1000)
    evidence = Evidence(none + 1, none, none + 1, none + 1, 8000, 8, False, MODEL, plain_from=64_000)
    effect = EmitterSamples(0.0, np.zeros(1), np.zeros(1), none, 1.0, MODEL)
    effects = {False: effect, True: effect}
    decision = Decision(None, evidence, choose(evidence, []), [], effects)
    assert decision.costs(8) == pytest.approx((1.0, 0.0, 0.0))
    assert decision.costs(64) == pytest.approx((MODEL.plain_cost, 0.0, 0.0))


def test_edges_of_emitters_in_a_pixel_are_less_noise_the_more_samples_there_are():
    """Stratified samples resolve the edges, and leave the rest."""
    rng = np.random.default_rng(0)
    indirect, seen = rng.exponential(size=10_000), 10.0 * rng.integers(0, 2, 10_000)

    def variance(seen, samples):
        evidence = Evidence(indirect + seen, seen, 0 * indirect, np.ones(10_000), 10**8, samples, False, MODEL)
        return evidence.variance(indirect + seen)

    alone = variance(0 * seen, 1)
    assert variance(0 * seen, 10_000) == pytest.approx(alone)
    assert variance(seen, 1) > 20 * alone
    assert variance(seen, 10_000) - alone == pytest.approx((variance(seen, 1) - alone) / 100)


def test_lights_do_not_pay_where_they_leave_what_they_should_carry():
    """Veils stop the light of virtual lights and let paths pass."""
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    assert balanced(0.1 * direct, indirect, 10**8, 64).light_paths > 0
    assert balanced(0.1 * direct, indirect, 10**8, 64, left=0.95 * indirect).light_paths == 0


def price_of_lights(samples=64, **constants):
    """Price of lights on surfaces that carry all of an image's noise but a tenth, with as many lights in any case."""
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    model = replace(MODEL, fewest_light_paths=10**5, most_light_paths=10**5, **constants)
    traced = 0.3 * direct + indirect
    evidence = Evidence(traced, UNSEEN, 0.3 * direct, np.ones(10_000), 10**6, samples, False, model)
    option = Option(True, False, traced, indirect)
    return price(evidence, option), choose(evidence, [option])


def test_the_noise_of_lights_counts_in_their_price():
    """With the weight of noise that a denoiser leaves."""
    (none, plan), (usual, _), (heavy, _) = (
        price_of_lights(light_variance=noise, shared=shared) for noise, shared in ((0.0, 1.0), (50.0, 1.0), (50.0, 4.0))
    )
    assert heavy - none == pytest.approx(4 * (usual - none)) and usual > 1.01 * none
    assert plan.light_paths == 10**5 and price_of_lights(light_variance=5000.0)[1].light_paths == 0
    # It does not count in raw images
    assert MODEL.without_denoiser().noise_of_lights == 0
    assert price_of_lights(light_variance=5000.0, shared=1.0, noise_of_lights=0.0)[0] == pytest.approx(none)


def test_the_choice_of_lit_vertices_counts_in_the_price_unless_all_are_lit():
    prices = [price_of_lights(vertex_variance=noise, least_vertices=1.0)[0] for noise in (0.03, 0.06)]
    assert prices[0] == prices[1]
    # An eighth of the vertices is lit
    few = [price_of_lights(vertex_variance=noise, vertex_cost=1e6)[0] for noise in (0.03, 0.06)]
    assert few[1] - few[0] == pytest.approx(few[0] - price_of_lights(vertex_variance=0.0, vertex_cost=1e6)[0])


@pytest.mark.parametrize("power", (0.2, 0.45, 1.0))
def test_cuts_have_the_shadow_rays_of_the_least_price(power):
    unlimited = replace(MODEL, denoised_power=power, most_rays=1e9, finest_error=1e-12, coarsest_error=1e12)
    tried = np.geomspace(1e-3, 1e3, 100_001)
    for rest in (1e-4, 0.01, 1.0, 100.0):
        for cuts in (0.4, 1.0, 1.4):
            variance, cost = cuts * unlimited.cut_variance / tried, cuts * unlimited.chosen_ray_cost * tried
            rays, _ = plan._cut_rays(rest, cuts, 64, unlimited)
            assert rays / 64 == pytest.approx(tried[np.argmin((rest + variance) ** power * (1 + cost))], rel=0.01)


def test_stratified_samples_retain_the_less_noise_of_direct_light_the_more_they_are():
    rng = np.random.default_rng(0)
    direct, none = rng.exponential(size=10_000), np.zeros(10_000)

    def variance(samples, emitters=False):
        return Evidence(direct, none, direct, none + 1, 10**8, samples, emitters, MODEL).variance(direct)

    assert variance(64) / variance(1) == pytest.approx(64**-MODEL.stratified_power)
    assert variance(64, emitters=True) == variance(1)


def test_cuts_are_the_coarser_the_more_noise_the_pilot_measures():
    """Until it measures, lights carry all of the indirect light."""
    rng = np.random.default_rng(0)
    indirect, direct = 3 * rng.exponential(size=(2, 10_000))
    found = [
        balanced(0.1 * direct, indirect, 10**8, 64, left) for left in (None, *(x * direct for x in (0, 0.05, 0.2, 0.3)))
    ]
    assert found[0] == found[1] == found[2]
    assert found[2].rays > found[3].rays > found[4].rays > 0


def measured(option, residual):
    """The option with a measured residual."""
    found = replace(option, to_measure=lambda: residual)
    found.measure()
    assert found.residual is residual and found.to_measure is None
    return found


@pytest.mark.parametrize("model", (MODEL, DENOISED))
@pytest.mark.parametrize("emitters", (False, True))
@pytest.mark.parametrize("samples", (1, 64, 1024))
@pytest.mark.parametrize("paths", (10**4, 10**6, 10**9))
def test_the_more_lights_leave_the_higher_their_price(paths, samples, emitters, model):
    """The lights prove worse than assumed only after they are measured."""
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    for scale in (1e-3, 1, 1e3):
        traced, small = direct + scale * indirect, 1e-3 * indirect
        evidence = Evidence(traced, UNSEEN, direct, np.ones(10_000), paths, samples, emitters, model)
        assumed = Option(True, emitters, traced, scale * indirect)
        prices = [price(evidence, measured(assumed, noise * traced)) for noise in (0, 0.1, 0.5, 1, 2, 8, 64)]
        assert prices[0] == price(evidence, assumed)
        assert (np.diff(prices) >= 0).all() and prices[-1] > 10**model.denoised_power * prices[0]
        assert price(evidence, measured(assumed, small)) == prices[0]


def test_options_are_measured_once_and_only_where_they_may_pay():
    rng, calls = np.random.default_rng(0), []
    indirect, direct = rng.exponential(size=(2, 10_000))
    evidence = Evidence(direct + indirect, UNSEEN, direct, np.ones(10_000), 10**8, 64, False, MODEL)

    def option(scale, residual, name):
        return Option(True, False, direct + indirect, scale * indirect, lambda: calls.append(name) or residual)

    good, worse = option(1.0, None, "good"), option(0.6, None, "worse")
    assert choose(replace(evidence, paths=10), [good]).light_paths == 0 and not calls
    assert choose(evidence, [good], measures=False).light_paths > 0 and not calls
    both = choose(evidence, [worse, good])
    assert both.light_paths > 0 and calls == ["good"]
    assert choose(evidence, [worse, good]) == both and calls == ["good"]
    # A residual that proves useless: the next option is measured
    useless = option(1.0, 4 * indirect, "useless")
    assert choose(evidence, [useless, worse]) == choose(evidence, [worse])
    assert calls == ["good", "useless", "worse"]


@pytest.mark.parametrize("model", (MODEL, DENOISED))
@pytest.mark.parametrize("emitters", (False, True))
def test_a_choice_is_independent_of_earlier_measurements(emitters, model):
    """Passes of a render share options, and workers render the passes in any order."""
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))

    def options(left):
        kinds = [(True, False, 1.0), (False, True, 0.0), (True, True, 0.9)][: 3 if emitters else 1]
        measures = [(lambda x=left: x) if surfaces else None for surfaces, *_ in kinds]
        return [
            Option(*kinds[k][:2], direct + indirect, kinds[k][2] * indirect, measures[k]) for k in range(len(kinds))
        ]

    for share in (0.0, 0.01, 0.03, 0.1, 0.3, 2.0):
        for paths in 4 ** np.arange(6, 16):
            evidence = Evidence(direct + indirect, UNSEEN, direct, np.ones(10_000), int(paths), 64, emitters, model)
            fresh, shared = options(share * indirect), options(share * indirect)
            choose(replace(evidence, paths=10**9), shared)
            choose(replace(evidence, paths=10**5), shared)
            chosen, expected = (replace(choose(evidence, some), reason="") for some in (fresh, shared))
            assert chosen == expected


@pytest.mark.parametrize("samples", (16, 64))
def test_no_residual_lowers_a_price(samples):
    """Other numbers of rays than the best, and the noise of lights, would let the price fall by half a percent where
    more variance remains."""
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    evidence = Evidence(direct + indirect, UNSEEN, 0 * direct, np.ones(10_000), 10**9, samples, True, DENOISED)
    option = Option(True, True, 0.18 * direct + 0.036 * indirect, 0.036 * indirect)
    assumed = price(evidence, option)
    for share in np.geomspace(0.1, 1, 100):
        assert price(evidence, measured(option, share * direct)) >= assumed


def decision(samples, pixels=10**6):
    """The decision for an image whose indirect light is all of its noise, of which lights leave a tenth."""
    indirect = 3 * np.random.default_rng(0).exponential(size=10_000)
    option = Option(True, False, indirect, indirect, residual=0.1**0.5 * indirect)
    evidence = Evidence(indirect, UNSEEN, 0 * indirect, np.ones(10_000), samples * pixels, samples, False, MODEL)
    same = EmitterSamples(0.0, np.zeros(1), np.zeros(1), np.zeros(1), 1.0, MODEL)
    return Decision(None, evidence, choose(evidence, [option]), [option], {False: same, True: same})


def test_samples_of_larger_passes_share_lights_and_cuts():
    """The largest error limits how coarse the cuts of few samples are."""
    one, sizes = decision(1), np.array([1, 2, 4, 8, 16])
    assert one.plan.gathers and sum(one.costs(1)) == pytest.approx(one.emitter_samples.cost)
    paths, lights, cuts = np.array([one.costs(int(size)) for size in sizes]).T
    assert (paths == 1).all() and (np.diff(lights) < 0).all() and (np.diff(cuts) <= 0).all()
    assert cuts[2] < 0.7 * cuts[0]
    # The whole pass costs more
    assert (np.diff((paths + lights + cuts) * sizes) > 0).all()
    np.testing.assert_allclose(decision(16).costs(1), one.costs(1))


def test_the_variance_of_paths_is_computed_once(monkeypatch):
    one, calls = decision(16), []
    monkeypatch.setattr(plan, "relative_variance", lambda *arguments: calls.append(arguments))
    for samples in (1, 4, 16, 64):
        one.costs(samples)
    assert not calls


def test_more_vertices_are_lit_the_less_noise_there_is_besides():
    rng = np.random.default_rng(0)
    indirect, direct = rng.exponential(size=(2, 10_000))
    left = 0.3 * indirect
    shares = (0.0, 0.3, 1.0)
    found = [balanced(x * direct, indirect, 10**8, 64, left + x * direct).vertices for x in shares]
    assert 64 >= found[0] > found[1] > found[2] >= 8
    assert balanced(0.1 * direct, indirect, 10**8, 1).vertices == 1


def test_more_light_paths_are_followed_the_noisier_indirect_light_is():
    rng = np.random.default_rng(0)
    direct = rng.exponential(size=10_000)
    found = [balanced(direct, rng.gamma(1 / noise, noise, 10_000), 10**7, 64).light_paths for noise in (1, 4, 16)]
    assert 0 < 1.2 * found[0] < found[1] < found[2] / 1.2


def test_one_sample_has_no_noise_that_lights_could_take_away():
    chosen = balanced(np.full(2, 0.5), np.full(2, 0.5), 1, 1)
    assert chosen.light_paths == 0 and "nan" not in chosen.reason


def test_constants_out_of_range_are_refused_by_name():
    with pytest.raises(ValueError, match=r"stratified_power must be from 0 to 1, got 1\.8"):
        CostModel(stratified_power=1.8)
    with pytest.raises(ValueError, match="ray_cost must be at least 0, got -1"):
        CostModel(ray_cost=-1)


def test_every_constant_has_a_unit_a_meaning_and_evidence():
    about = [one.metadata for one in fields(CostModel)]
    assert len(about) > 30
    assert all(one["unit"] and one["meaning"].endswith(".") and one["evidence"] for one in about)
    assert table().count("\n") == len(about) + 1
