"""Result tables of the papers whose methods are compared, with their published figures.

`paper_tables` fills the tables with runs. Figures are listed by the paper's scenes, in the paper's order. Omitted are
pictures ([IC] Table 2), emitters visible to a pixel ([IAS] Table 5; not counted by the integrators), regions of pixels
([IAS] Table 4; absent in `adaptivedirect`), and numbers of triangles and emitters, which do not depend on a method.
"""

from .published_table import Method, Ratio, Table

PAPERS = {
    "IC": "Bus, Mustafa and Biri 2015, IlluminationCut",
    "IAS": "Donikian et al. 2006, Accurate direct illumination using iterative adaptive sampling",
    "MSR": "Huo et al. 2015, A matrix sampling-and-recovery approach for many-lights rendering",
}


def _lightcuts(name, **figures):
    return Method(name, "lightcuts", figures)


def _light_slice(name, **figures):
    return Method(name, "lightslice", figures)


def _illumination_cut(name, **figures):
    return Method(name, "illuminationcut", figures)


def _sampled(name, **figures):
    return Method(name, "illuminationcut", figures, {"visibility": "adaptive"})


# --- [IC] Scenes: Banquet, San Miguel, Sponza, Kitchen ---

_IC = {
    "paper": "IC",
    "needed": ("lightcuts", "illuminationcut"),
    "ratios": {"speed_up": Ratio("times faster", "render_seconds")},
    "equal": "error",
    "metric": "rmse",
}
_IC_DEPARTURES = (
    "Paper: 1600 × 1200 pixels, 20 cores, about 650 000 VPLs. The paper's errors are relative to the image of all VPLs "
    "(as with --reference vpl), ours to the reference of this run. lights: tracing VPLs and building light trees "
    "(paper: trees only); render: all further work. The paper does not state the normalization of its RMSE, so its "
    "RMSE is omitted. The paper's relative error is a mean over pixels, our rel. L1 is sum |x - r| / sum r."
)


_ILLUMINATION_CUT = (
    Table(
        name="Table 1",
        title="Lightcuts, LightSlice and IlluminationCut with 1 sample per pixel",
        takes=lambda run: run["spp"] == 1,
        methods=(
            _lightcuts(
                "LC(1%)",
                light_seconds=(56.05, 109.22, 80.57, 89.80),
                render_seconds=(116.71, 749.41, 233.31, 183.07),
                rays=(947, 5161, 2294, 1597),
                bounds=(2878, 14202, 6183, 4313),
                relative_l1=(0.02740, 0.02770, 0.04316, 0.08957),
            ),
            _light_slice(
                "LS",
                render_seconds=(365.74, 227.88, 263.35, 116.61),
                rays=(2879, 2722, 2849, 1362),
                columns=(3200, 3200, 3200, 1600),
                relative_l1=(0.03470, 0.07719, 0.04049, 0.10412),
            ),
            _illumination_cut(
                "IC(1.5%)",
                light_seconds=(58.28, 112.48, 82.07, 93.02),
                render_seconds=(36.94, 186.12, 71.83, 43.04),
                rays=(1301, 5561, 3064, 1258),
                bounds=(90, 236, 69, 216),
                relative_l1=(0.02442, 0.03137, 0.04114, 0.09543),
            ),
            _sampled(
                "IC-S(1%)",
                light_seconds=(58.32, 112.40, 82.31, 92.31),
                render_seconds=(23.30, 78.58, 23.89, 30.26),
                rays=(463, 1849, 720, 602),
                bounds=(155, 362, 102, 350),
                relative_l1=(0.02639, 0.03807, 0.04382, 0.09088),
            ),
        ),
        quantities=("light_seconds", "render_seconds", "rays", "bounds", "columns", "rmse", "relative_l1"),
        departures=_IC_DEPARTURES,
        **_IC,
    ),
    Table(
        name="Table 3",
        title="imperceptible errors (an error of 0.2% or less)",
        # LightSlice has no such bound
        takes=lambda run: run["integrator"] == "lightslice" or run["parameters"].get("error", 1) <= 0.002,
        methods=(  # Banquet alone
            _lightcuts("LC(0.1%)", render_seconds=(602.98,), relative_l1=(0.0112375,)),
            _light_slice("LS(6400)", render_seconds=(720.46,), relative_l1=(0.0237685,)),
            _illumination_cut("IC(0.15%)", render_seconds=(180.57,), relative_l1=(0.0108088,)),
            _sampled("IC-S(0.1%)", render_seconds=(178.83,), relative_l1=(0.0118181,)),
        ),
        quantities=("render_seconds", "rmse", "relative_l1"),
        departures=_IC_DEPARTURES,
        **_IC,
    ),
    Table(
        paper="IC",
        name="Table 4",
        title="Lightcuts with a maximum cut size",
        takes=lambda run: run["parameters"].get("max_cut", 0) > 0,
        methods=(
            _lightcuts(
                "LC(1%), at most 2000",
                render_seconds=(103.88, 175.54, 99.34, 82.47),
                relative_l1=(0.03048, 0.08960, 0.05165, 0.10106),
            ),
        ),
        needed=("lightcuts",),
        quantities=("render_seconds", "columns", "rmse", "relative_l1"),
        departures="Runs with an explicit max_cut (default: 1000). " + _IC_DEPARTURES,
    ),
    Table(
        paper="IC",
        name="Table 5",
        title="peak memory by the number of VPLs",
        methods=(  # 50, 300, 600 and 1200 thousand lights in Banquet
            _lightcuts("LC(1%)", lights=(50e3, 300e3, 600e3, 1.2e6), memory=(0.31, 0.62, 1.02, 1.74)),
            _light_slice("LS(800)", lights=(50e3, 300e3, 600e3, 1.2e6), memory=(2.95, 14.18, 29.53, 55.10)),
            _illumination_cut("IC(1%)", lights=(50e3, 300e3, 600e3, 1.2e6), memory=(1.35, 1.65, 2.24, 2.70)),
        ),
        needed=_IC["needed"],
        quantities=("lights", "points", "memory"),
        departures="Our peak memory covers the whole process, including scene, image and compiled kernels.",
    ),
    Table(
        name="Table 6",
        title="Lightcuts, LightSlice and IlluminationCut with several samples per pixel",
        takes=lambda run: run["spp"] > 1,
        methods=(
            _lightcuts(
                "LC(1%)",
                light_seconds=(53.70, 92.53, 82.36, 68.16),
                render_seconds=(1031.02, 6665.94, 2007.74, 1522.25),
                relative_l1=(0.02543, 0.02681, 0.03279, 0.09398),
            ),
            _light_slice(
                "LS(800)",
                render_seconds=(346.61, 399.48, 332.62, 221.34),
                columns=(800, 800, 800, 800),
                relative_l1=(0.04011, 0.06959, 0.02938, 0.08923),
            ),
            _illumination_cut(
                "IC(1.5%)",
                light_seconds=(55.14, 95.35, 84.90, 70.48),
                render_seconds=(281.11, 1567.65, 665.01, 360.33),
                relative_l1=(0.02281, 0.02773, 0.02816, 0.09152),
            ),
            _sampled(
                "IC-S(1%)",
                light_seconds=(55.20, 95.21, 83.57, 70.10),
                render_seconds=(117.58, 444.25, 143.87, 170.65),
                relative_l1=(0.02258, 0.02687, 0.02792, 0.09766),
            ),
        ),
        quantities=("light_seconds", "render_seconds", "rays", "bounds", "columns", "rmse", "relative_l1"),
        departures="Paper: 9 samples per pixel. " + _IC_DEPARTURES,
        **_IC,
    ),
)


# --- [IAS] Scenes: Kitchen, Kitchen 2, Ponderosa, Grand Central Terminal ---

_IAS = {"paper": "IAS", "needed": ("unoccludeddirect", "adaptivedirect")}
_IAS_EQUAL = {"equal": "error", "metric": "relmse_trimmed", "curves_only": True}
_IAS_DEPARTURES = (
    "Paper: 1024 × 1024 pixels, two processors of 1.7 GHz. The paper equates quality by the stopping rule of pixels "
    "(our parameter error), not by a measured error."
)
_REFERENCE_SECONDS, _ADAPTIVE_SECONDS = (15364, 68392, 53328, 57432), (1726, 8368, 5604, 7136)
_REFERENCE_RAYS, _ADAPTIVE_RAYS = (1870, 9916, 10772, 6048), (278, 1604, 1290, 1012)
_TIMES_FASTER = Ratio("times faster", "seconds")
_TIMES_FEWER_RAYS = Ratio("times fewer rays", "rays")


def _unoccluded(**figures):
    return Method("reference", "unoccludeddirect", figures)


def _adaptive(**figures):
    return Method("adaptive", "adaptivedirect", figures)


_ADAPTIVE_SAMPLING = (
    Table(
        name="Table 2",
        title="time of adaptive sampling and of its reference method",
        methods=(
            _unoccluded(seconds=_REFERENCE_SECONDS),
            _adaptive(seconds=_ADAPTIVE_SECONDS),
        ),
        quantities=("seconds", "relmse_trimmed"),
        ratios={"speed_up": _TIMES_FASTER},
        departures=_IAS_DEPARTURES,
        **_IAS,
        **_IAS_EQUAL,
    ),
    Table(
        name="Table 3",
        title="shadow rays of adaptive sampling and of its reference method",
        methods=(
            _unoccluded(rays=_REFERENCE_RAYS),
            _adaptive(rays=_ADAPTIVE_RAYS),
        ),
        quantities=("rays", "relmse_trimmed"),
        ratios={"fewer_rays": _TIMES_FEWER_RAYS},
        departures=_IAS_DEPARTURES,
        **_IAS,
        **_IAS_EQUAL,
    ),
    Table(
        name="Tables 2 and 3, same rule",
        title="adaptive sampling and its reference method with the same stopping rule",
        methods=(
            _unoccluded(seconds=_REFERENCE_SECONDS, rays=_REFERENCE_RAYS),
            _adaptive(seconds=_ADAPTIVE_SECONDS, rays=_ADAPTIVE_RAYS),
        ),
        quantities=("seconds", "rays", "relmse_trimmed"),
        ratios={"speed_up": _TIMES_FASTER, "fewer_rays": _TIMES_FEWER_RAYS},
        departures="Ratios compare runs of the same setting, as in the paper. " + _IAS_DEPARTURES,
        **_IAS,
    ),
    Table(
        paper="IAS",
        name="Tables 4 and 6",
        title="passes and clusters of adaptive sampling",
        methods=(_adaptive(passes=(2.7, 4.5, 3.3, 5.5), clusters=(24.4, 24.4 + 175, 47.6 + 164, 81.0)),),
        needed=("adaptivedirect",),
        quantities=("passes", "clusters", "rays", "relmse_trimmed"),
        departures="Means over gather points (paper: passes per pixel). Clusters include clusters of emitters and of "
        "environment regions, also for points whose direct light is summed over all emitters.",
    ),
)


# --- [MSR] Scenes: San Miguel, carnival, room, Sponza ---

_MSR = {
    "paper": "MSR",
    "quantities": (
        "slices", "columns", "rays", "sampling_rate", "choosing_seconds", "separation_seconds", "render_seconds",
        "relative_l1",
    ),
    "ratios": {
        "times_as_long": Ratio("times as long", "render_seconds", less=False),
        "times_the_rays": Ratio("times the rays", "rays", less=False),
    },
    "metric": "relative_l1",
}  # fmt: skip
_MSR_DEPARTURES = (
    "Paper: 1600 × 1200 or 1920 × 1080 pixels with 4 samples, a million VPLs, 16 threads. The paper's errors are "
    "relative to the image of all VPLs (as with --reference vpl), ours to the reference of this run. columns or cut: "
    "mean over samples (paper: maximum). choosing: slices, columns and prediction of matrixrecovery (paper: matrix "
    "generation); slices, rows and columns of LightSlice (paper: clustering). separation: including unoccluded light "
    "and correction. render: everything except VPLs and light trees. sampling rate: shadow rays over entries of all "
    "matrices."
)
_RECOVERY = Method(
    "matrix recovery",
    "matrixrecovery",
    {
        "columns": (2000, 4000, 2000, 2000),
        "rays": (46, 96, 41, 28),
        "sampling_rate": (0.044, 0.052, 0.058, 0.04),
        "choosing_seconds": (70, 92, 45, 38),
        "separation_seconds": (15, 33, 10, 7),
        "render_seconds": (85, 125, 55, 45),
        "relative_l1": (0.064, 0.045, 0.042, 0.042),
    },
)


def _multidimensional(**figures):
    return Method("multidimensional lightcuts", "mdlightcuts", figures)


def _matrix_slices(gathering, **figures):
    """LightSlice with the common clustering time of equal error and equal rays, followed by `gathering` seconds."""
    clustering = (71, 39, 61, 57)
    whole = tuple(map(sum, zip(clustering, gathering, strict=True)))
    slices = (3147, 1492, 2742, 2655)
    return _light_slice("LightSlice", slices=slices, choosing_seconds=clustering, render_seconds=whole, **figures)


_MATRIX_RECOVERY = (
    Table(
        name="Table 1, equal quality",
        title="matrix recovery and further methods at equal error",
        methods=(
            _RECOVERY,
            _multidimensional(
                columns=(2000, 4000, 2000, 2000),
                rays=(1250, 981, 831, 635),
                render_seconds=(1583, 941, 795, 821),
                relative_l1=(0.063, 0.042, 0.047, 0.043),
            ),
            _matrix_slices(
                gathering=(542, 401, 420, 372),
                columns=(300, 500, 300, 300),
                rays=(1145, 1953, 1088, 1164),
                relative_l1=(0.062, 0.097, 0.056, 0.043),
            ),
        ),
        needed=("matrixrecovery",),
        departures=_MSR_DEPARTURES,
        equal="error",
        **_MSR,
    ),
    Table(
        name="Table 1, equal rays",
        title="matrix recovery and further methods with equal shadow rays per pixel",
        methods=(
            _RECOVERY,
            _multidimensional(
                columns=(60, 200, 50, 80),
                rays=(46, 94, 40, 41),
                render_seconds=(75, 121, 58, 50),
                relative_l1=(0.4789, 0.19, 0.47, 0.33),
            ),
            _matrix_slices(
                gathering=(35, 40, 24, 21),
                columns=(50, 100, 45, 35),
                rays=(47, 98, 43, 31),
                relative_l1=(0.4036, 0.16, 0.39, 0.42),
            ),
        ),
        needed=("matrixrecovery",),
        departures=_MSR_DEPARTURES,
        equal="rays",
        curves_only=True,
        **_MSR,
    ),
)

TABLES = (*_ILLUMINATION_CUT, *_ADAPTIVE_SAMPLING, *_MATRIX_RECOVERY)
