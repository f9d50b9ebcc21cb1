"""Cost model: every constant of the decisions of ``manylights``, with unit, meaning and evidence.

A pilot measures relative variances.  The constants predict cost and remaining variance (:mod:`vpl.split.plan`,
:mod:`vpl.split.roulette`).  Predictions use counts and never the clock, so the same seed makes the same decisions on
every machine.  ``benchmarks/cost_model.py`` halves and doubles each constant and prints the effect on variance × time.
:mod:`vpl.split.cost_table` lists the constants.

Costs are in units of one camera path without virtual lights that is not plain.  A relative variance is the variance of
one path over the squared brightness of the pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace


def _constant(default: float, unit: str, meaning: str, evidence: str, most: float = math.inf, least: float = 0):
    about = {"unit": unit, "meaning": meaning, "evidence": evidence, "most": most, "least": least}
    return field(default=default, metadata=about)


_SENSITIVITY = "benchmarks/cost_model.py"
_LIGHTS = "benchmarks/manylights.py --parts lights"
_PRODUCT = "benchmarks/manylights.py --parts product"


@dataclass(frozen=True)
class CostModel:
    """Constants of the decisions of ``manylights``; raises ValueError for a value out of range."""

    # ---------------------- Pilot ----------------------
    pilot_rays: int = _constant(
        1 << 15,
        "camera rays",
        "Largest pilot of images of up to `root_from` rays; beyond, it grows with the root of the rays.",
        _SENSITIVITY,
    )
    root_from: float = _constant(
        1 << 21,
        "camera rays",
        "Number of rays of the image from which pilots grow with its root.",
        "256 samples, pilots of 65 536 rays and of 16 384: denoised error 0.96 in kitchen and living_room, 0.98 in "
        "staircase2, raw variance 0.95 to 0.96",
    )
    most_pilot_rays: int = _constant(
        1 << 18, "camera rays", "Largest pilot of any image: bounds memory.", "about 300 bytes a ray"
    )
    pilot_share: float = _constant(
        1 / 36,
        "1 / camera ray",
        "Rays of a pilot for each camera ray of an image that is denoised: a pilot is traced up to five times.",
        "renders of 2.5 and 10 s, denoised, nine scenes (decisions.md)",
        most=1,
    )
    large_pilot_share: float = _constant(
        1 / 16,
        "1 / camera ray",
        "The same for raw images, and for pilots of few rays.",
        "classroom, raw, 10 s: variance 0.236 with a 48th, 0.193 with a 16th",
        most=1,
    )
    small_pilot: int = _constant(
        1 << 12, "camera rays", "Up to this size, pilots have the larger share.", "2.5 s: 4096 as good as 8192"
    )
    learned_cost: float = _constant(
        1.15, "paths", "Cost of a path with learned emitters: more shadow rays reach one.", "15% and more in kitchen"
    )
    learned_sky_cost: float = _constant(
        1.25,
        "paths",
        "The same where regions of the environment are learned, whose rays leave the scene.",
        "64 samples: kitchen_windows 1.15, foliage 1.25, arcade and forest_lights 1.36, living_room 1.40",
    )
    relayed_noise: float = _constant(
        0.1, "variance", "Least part of the noise by glass and mirrors to look for it.", "staircase2 has 0.36"
    )
    relay_cost: float = _constant(
        1.3, "paths", "Cost of a path that samples glass and mirrors.", "6 to 27 lamps in glass: 1.25 to 1.33"
    )
    glass_cost: float = _constant(
        1.2, "paths", "Cost of a path whose shadow rays pass glass.", "staircase2: tracing 1.25, renders 1.2"
    )
    trimmed: float = _constant(
        0.001,
        "fraction",
        "Largest squared errors that a relative variance leaves out, as the comparison's trimmed relMSE does.",
        "definition of the error",
        most=1,
    )
    black: float = _constant(
        0.01, "squared mean", "Added to the squared brightness of each pixel, as in relMSE.", "definition of the error"
    )
    brightness_spread: float = _constant(
        0.15,
        "relative variance",
        "Variance of the brightness of a quarter of an image block around that of the block.",
        _SENSITIVITY,
    )

    # ---------------------- Variance that remains ----------------------
    stratified_power: float = _constant(
        0.3,
        "exponent",
        "Stratified samples, n in a pixel, retain the fraction n^-x of the variance of direct light; this is x.",
        "depth 2, 4, 16 and 64 samples: cornell 0.32, 0.11, 0.07, kitchen 0.61, 0.35, 0.27, staircase2 0.36, 0.19, "
        "0.15, living_room 1.1, 0.62, 0.54, dining_room 0.60, 0.47, 0.41",
        most=1,
    )
    stratified_many: float = _constant(
        1.0,
        "fraction",
        "Fraction of the variance of direct light that stratified samples retain where there are many emitters: "
        "samples are hardly stratified over more emitters than samples.",
        "everything8003: lights are not chosen with 0.5",
        most=1,
    )
    light_variance: float = _constant(
        50.0,
        "paths",
        "Relative variance that a light set leaves in a pixel, times its light paths, over the variance of the "
        "indirect light of one camera path.",
        f"{_LIGHTS}: 52 kitchen, 43 veach_ajar, 64 everything8003",
    )
    noise_of_lights: float = _constant(
        1.0,
        "weight",
        "Weight of the noise of lights and of the choice of lit vertices in the price of lights, in images that are "
        "denoised. In raw images it is 0: stratified paths leave less than the pilot measures.",
        "decisions.md; raw variance × time of staircase2 with lights over that without: predicted with this noise "
        "1.09, without it 0.90 (64 samples), measured 0.82 (96 samples)",
    )
    shared: float = _constant(
        4.0,
        "ratio",
        "Weight of the noise of lights in their price and number, in images that are denoised: neighbouring pixels "
        "share it, and a denoiser keeps half of it, and 7 to 16% of other noise.",
        f"{_LIGHTS} and --parts denoised",
    )
    set_error: float = _constant(
        0.03, "fraction", "Largest standard error of the mean by one light set.", f"{_PRODUCT}: 0.02 to 0.81%", most=1
    )
    cut_variance: float = _constant(
        0.3,
        "shadow rays",
        "Relative variance that the cuts leave in a pixel, times its shadow rays.",
        "0.17 cornell to 4.6 classroom: the optimum is flat",
    )
    vertex_variance: float = _constant(
        0.06,
        "relative variance",
        "Relative variance of a single gather vertex that stands for its pixel; none where all vertices are lit.",
        "0.018 kitchen to 0.23 veach_ajar",
    )

    # ---------------------- Costs ----------------------
    fixed_cost: float = _constant(
        200_000, "paths", "Cost of starting lights and cuts: recorded kernels, trees.", _SENSITIVITY
    )
    light_path_cost: float = _constant(4.0, "paths", "Cost of a line with the lights that it meets.", _LIGHTS)
    ray_cost: float = _constant(
        0.2,
        "paths",
        "Cost of a shadow ray of a cut, with its bounds, less what paths save where lights carry light.",
        _SENSITIVITY,
    )
    chosen_ray_cost: float = _constant(
        0.2,
        "paths",
        "Cost of a shadow ray where the number of rays is chosen, in images that are denoised.",
        "half the rays, 64 samples, denoised error^2.2 × time: kitchen 0.93, veach_ajar 1.53, living_room 1.08",
    )
    raw_chosen_ray_cost: float = _constant(
        0.5,
        "paths",
        "The same in raw images: the whole cost of a ray.",
        "raw variance × time over that with 0.2, 96 samples: kitchen 0.87, veach_ajar 0.84, classroom 0.83, hall 1.02; "
        "with 1.2: 0.89, 0.93, 0.86",
    )
    emitter_cuts: float = _constant(
        0.4,
        "ratio",
        "Variance and rays of cuts through emitters over those of cuts through surface lights.",
        "hall: 0.11 and 0.14 of variance × samples",
    )
    emitter_sample_cost: float = _constant(
        0.13,
        "paths",
        "Cost of a further emitter sample at the first scattering vertex of a path.",
        "bistro_interior 0.14, living_room 0.15, dining_room 0.11, kitchen and staircase2 0.09",
    )
    plain_cost: float = _constant(
        0.9,
        "paths",
        "Cost of a plain path: one of a large image without virtual lights.",
        "0.80 arcade to 1.00 dining_room, seven scenes (decisions.md)",
    )
    vertex_cost: float = _constant(0.8, "paths", "Cost of a gather vertex: its clusters and its cuts.", "hall, kitchen")
    first_edges: float = _constant(
        4.0, "edges", "Cost of a path up to its second vertex, in later edges.", _SENSITIVITY
    )

    # ---------------------- Decisions ----------------------
    pays_below: float = _constant(
        1.0,
        "ratio",
        "Lights are used where variance × cost with lights, their noise included, is below this multiple of that "
        "without.",
        "definition",
    )
    plain_per_material: float = _constant(
        1 << 18,
        "camera rays per material",
        "From so many on, the paths of an image without virtual lights are plain.",
        "saves 0.1 to 0.2 s for a million rays; the kernel compiles in 0.15 s per material: pays after 3 to 6 images",
    )
    denoised_power: float = _constant(
        0.45,
        "exponent",
        "In images that are denoised, the time for equal error falls with this power of the variance that remains. In "
        "raw images it falls with the first power.",
        "-0.4 to 1.2, median 0.3, in nine scenes at 16 to 256 samples; 0.45 keeps the lights that gain twice the time",
    )
    samples_power: float = _constant(
        0.7,
        "exponent",
        "The same power where the number of emitter samples is chosen. Direct light is noise that a denoiser removes.",
        "between 0.45 and 1: images of 10 s, denoised error over that with one sample (decisions.md)",
    )
    emitter_samples_from: float = _constant(
        64,
        "samples of a pixel",
        "With fewer expected samples, denoised images take one emitter sample at each vertex. 0 in raw images.",
        "denoised error over that with one sample: 1.06 with 40 samples, 0.92 to 0.96 with 163",
    )
    fewest_light_paths: int = _constant(20_000, "light paths", "Smallest number of light paths.", _LIGHTS)
    most_light_paths: int = _constant(
        2_000_000, "light paths", "Largest number of light paths: bounds memory.", _LIGHTS
    )
    least_light_share: float = _constant(1 / 64, "1 / camera ray", "Fewest light paths for a camera ray.", _LIGHTS)
    most_light_share: float = _constant(1 / 8, "1 / camera ray", "Most light paths for a camera ray.", _LIGHTS)
    c_per_spacing: float = _constant(
        12.0,
        "spacings",
        "c of the split over the distance between lights, local on surfaces, mean on emitters, in images that are "
        "denoised. With a larger c, pixels share less noise.",
        "denoised error with 6, 8, 12 and 20, 64 samples: kitchen 1, 0.98, 0.96, 0.94, veach_ajar 1, 0.95, 0.86, 0.79; "
        "20 takes 3 and 8% longer",
    )
    raw_c_per_spacing: float = _constant(
        6.0,
        "spacings",
        "The same in raw images.",
        "raw variance with 12 and 20 over that with 6, 64 samples: kitchen 1.02, 1.07, veach_ajar 0.99, 1.01",
    )
    most_rays: float = _constant(
        8.0, "shadow rays", "Most shadow rays of cuts for a sample, however little the paths leave.", _SENSITIVITY
    )
    coarse_rays: float = _constant(
        14,
        "shadow rays",
        "Shadow rays of the cuts of a pixel at an expected error of 1.",
        "raw variance × time with 14 and 18: 0.971 and 0.972 in the mean of six scenes (decisions.md)",
    )
    error_slope: float = _constant(1.6, "exponent", "The error falls with this power of the rays.", _SENSITIVITY)
    finest_error: float = _constant(0.001, "fraction of the pixel", "Smallest error of a pair.", _SENSITIVITY)
    coarsest_error: float = _constant(2.0, "fraction of the pixel", "Largest error of a pair.", _SENSITIVITY)
    dark_pixel: float = _constant(
        0.1, "image means", "Pixels darker than this are lit as precisely as if they were as bright.", _SENSITIVITY
    )
    spread: float = _constant(
        0.4,
        "fraction",
        "Part of the light of virtual lights that all rays of a pixel share, where a film is finer than the image.",
        "denoised error with 0.3 and 0.5 over that with 0, 16 samples: staircase2 0.93, 0.91, living_room 0.98, 1.0, "
        "veach_ajar 0.89, 0.85, classroom 0.94, 0.87; 0.3 and 0.6: cornell 0.95, 1.12; 0.4 lies between",
        most=1,
    )
    largest_cut: int = _constant(1000, "nodes", "Largest cut of a cluster of gather vertices.", _SENSITIVITY)
    emitter_points_share: float = _constant(
        0.03, "1 / camera ray", "Virtual lights on area emitters for a camera ray.", _SENSITIVITY
    )
    fewest_emitter_points: int = _constant(
        10_000, "points", "Smallest number of lights on area emitters.", _SENSITIVITY
    )
    most_emitter_points: int = _constant(200_000, "points", "Largest number of lights on area emitters.", _SENSITIVITY)
    most_emitter_samples: int = _constant(
        16,
        "samples",
        "Most emitter samples at a first scattering vertex.",
        "mean: dining_room 4.7, kitchen 2.0",
        least=1,
    )
    least_vertices: float = _constant(
        1 / 8, "fraction", "Least fraction of a pixel's samples that are lit.", _SENSITIVITY, most=1
    )

    # ---------------------- Russian roulette ----------------------
    least_survival: float = _constant(
        0.1,
        "probability",
        "Least probability of going on: expected contributions are rough.",
        "0.05 to 0.2: living_room −12%, kitchen −7%, others +1 to 4%",
        most=1,
    )
    roulette_gain: float = _constant(
        0.95,
        "ratio",
        "Roulette may raise the variance where the predicted variance × cost falls below this ratio.",
        _SENSITIVITY,
    )
    roulette_rise: float = _constant(
        0.005,
        "fraction",
        "Otherwise, roulette may raise the predicted variance by this fraction.",
        "variance × time of foliage without roulette over that with a rise of 0.2%, 64 samples: 1.18",
    )
    roulette_cells: int = _constant(
        1024, "cells", "Largest number of spatial cells with an outgoing radiance.", _SENSITIVITY
    )
    roulette_prior: float = _constant(
        4.0, "vertices", "Vertices of average radiance that each cell has besides its own.", _SENSITIVITY
    )

    def pilot_size(self, rays: int) -> int:
        """Number of camera rays of a pilot for an image of so many ``rays``."""
        small = min(self.small_pilot, int(self.large_pilot_share * rays))
        most = self.pilot_rays * max(rays / max(self.root_from, 1), 1) ** 0.5
        return int(min(max(self.pilot_share * rays, small), most, self.most_pilot_rays))

    def left_out(self, errors: int) -> int:
        """How many of so many squared ``errors``, the largest, a relative variance leaves out."""
        return int(self.trimmed * errors)

    def without_denoiser(self) -> CostModel:
        """The model of images that are not denoised: shared and other variance have the same weight, and lights pay by
        the variance of paths alone."""
        return replace(
            self, shared=1.0, denoised_power=1.0, samples_power=1.0, emitter_samples_from=0, noise_of_lights=0.0,
            pilot_share=self.large_pilot_share, c_per_spacing=self.raw_c_per_spacing,
            chosen_ray_cost=self.raw_chosen_ray_cost,
        )  # fmt: skip

    def __post_init__(self):
        for one in fields(self):
            value, least, most = getattr(self, one.name), one.metadata["least"], one.metadata["most"]
            if not least <= value <= most:
                limit = f"at least {least:g}" if most == math.inf else f"from {least:g} to {most:g}"
                raise ValueError(f"{one.name} must be {limit}, got {value!r}")
