"""Tables of the documents: columns and result files. docs/tables.py fills the tables."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """Column of a table.

    ``cell``: format of the quantities of a row. ``ratio``: path of a quantity that is bold below 1, with a geometric
    mean below the table. ``bound``: path of a quantity that marks the cell as a bound; ``sign`` is then written before
    the cell. ``measure``: of the error that is equal, in a brief table.
    """

    title: str
    cell: str = ""
    ratio: str = ""
    bound: str = ""
    sign: str = ""
    measure: str = ""


@dataclass(frozen=True)
class Table:
    """Table of one row a scene.

    ``files``: result files by the prefix of their quantities in columns, "" for no prefix. Of several files with the
    same prefix, later files add rows. ``order``: path of the quantity that sorts rows, largest first. ``first``: title
    of the column of row names. ``is_brief``: with equal errors and commits below the columns, in place of the commands
    of the files.
    """

    files: dict
    columns: tuple
    order: str = ""
    first: str = "scene"
    is_brief: bool = False


def numbers(method, *quantities):
    """Cell template of quantities of a method with formats, for example `"seconds:.2f"`."""
    return ", ".join(f"{{{method}[{name}]:{spec}}}" for name, _, spec in (one.partition(":") for one in quantities))


def recovery_columns(*sampled):
    """Columns of the tables of `matrixrecovery`."""
    return (
        Column("error", "{matrixrecovery[absolute]:r%}"),
        Column(*sampled),
        Column("mdlightcuts: s, rays/px, RMSE", numbers("mdlightcuts", "seconds:.2f", "rays:.0f", "rmse:.3f")),
        Column("lightslice: s, rays/px, RMSE", numbers("lightslice", "seconds:.2f", "rays:.0f", "rmse:.3f")),
        *(
            Column(f"{words}{method}", ratio=f"{method}.{ratio}", bound=f"{method}.not_reached", sign="≥ ")
            for ratio, first in (("fewer_rays", "fewer rays "), ("speedup", "faster "))
            for method, words in (("mdlightcuts", f"{first}than "), ("lightslice", "than "))
        ),
    )


TABLES = {
    "overview": Table(
        {
            "manylights": ("manylights_timed10",),
            "denoised": ("manylights_denoised10",),
            "path": ("lightcuts_path",),
            "samples": ("baselines_samples",),
            "ic": ("illuminationcut_table",),
            "slices": ("baselines_slices", "baselines_slices_kitchen"),
            "msr": ("matrixrecovery_table",),
            "direct": ("adaptivedirect_table",),
        },
        (
            Column("`manylights` over `path`, 10 s", ratio="manylights.speedup", measure="variance"),
            Column("the same, denoised", ratio="denoised.speedup", measure="relMSE"),
            Column(
                "`mdlightcuts` over `path`",
                ratio="path.speedup",
                bound="path.mdlightcuts.hidden",
                sign="≥ ",
                measure="relMSE",
            ),
            Column(
                "`mdlightcuts` over `lightcuts`, 16 samples",
                ratio="samples.mdlightcuts.speedup",
                bound="samples.mdlightcuts.not_reached",
                sign="≤ ",
                measure="mean absolute",
            ),
            Column("`illuminationcut` over `lightcuts`", ratio="ic.all.speedup", measure="RMSE"),
            Column(
                "`lightslice` over `lightcuts`",
                ratio="slices.lightslice.speedup",
                bound="slices.lightslice.not_reached",
                sign="≤ ",
                measure="mean absolute",
            ),
            Column(
                "`matrixrecovery` over `mdlightcuts`",
                ratio="msr.mdlightcuts.speedup",
                bound="msr.mdlightcuts.not_reached",
                sign="≥ ",
                measure="mean absolute",
            ),
            Column("`adaptivedirect` over `path`, direct light", ratio="direct.path.speedup", measure="relMSE"),
        ),
        order="manylights.speedup",
        is_brief=True,
    ),
    "manylights": Table(
        {"": ("manylights_product",)},
        (
            Column("`path`", "{path[product]:.4g}"),
            Column("`manylights`", "{manylights[product]:.4g}"),
            Column("ratio", ratio="speedup"),
            Column("bias", "{bias:+.2%} ± {bias_deviation:.2%}"),
            Column("sets", "{set_deviation:.2%}"),
        ),
        order="speedup",
    ),
    "denoised": Table(
        {
            "short": ("manylights_denoised",),
            "": ("manylights_denoised10",),
            "long": ("manylights_denoised60",),
        },
        (
            Column("2.5 s", ratio="short.speedup"),
            Column("over `independent`", ratio="short.independent_speedup"),
            Column("10 s", ratio="speedup"),
            Column("over `independent`", ratio="independent_speedup"),
            Column("60 s", ratio="long.speedup"),
            Column("over `independent`", ratio="long.independent_speedup"),
        ),
        order="speedup",
    ),
    "denoised_wide": Table(
        {"": ("manylights_denoised768",)},
        (Column("ratio", ratio="speedup"), Column("over `independent`", ratio="independent_speedup")),
    ),
    "views": Table({"": ("manylights_views",)}, (Column("ratio", ratio="speedup"),), first="scene, view"),
    "own": Table({"": ("manylights_own",)}, (Column("ratio", ratio="speedup"),)),
    "timed10": Table(
        {"": ("manylights_timed10",)},
        (
            Column("`path`: samples", "{path[samples]:.0f}"),
            Column("`manylights`: samples", "{manylights[samples]:.0f}"),
            Column("ratio", ratio="speedup"),
        ),
        order="speedup",
    ),
    "timed": Table({"": ("manylights_timed",)}, (Column("ratio", ratio="speedup"),)),
    "timed_wide": Table(
        {"": ("manylights_timed_wide",)},
        (
            Column("`path`: samples", "{path[samples]:.0f}"),
            Column("`manylights`: samples", "{manylights[samples]:.0f}"),
            Column("ratio", ratio="speedup"),
        ),
    ),
    "light_paths": Table(
        {"": ("manylights_lights",)},
        (
            Column("light paths", "{light_paths:.0f}"),
            Column("samples", "{samples:.0f}"),
            *(Column(f"× {factor}", f"{{times {factor}[product_ratio]:.2f}}") for factor in ("1/4", "1/2", "2", "4")),
        ),
    ),
    "cost_model": Table(
        {"": ("cost_model",)},
        (
            Column("× 1/2", "{half[product_ratio]:.2f}"),
            Column("× 2", "{double[product_ratio]:.2f}"),
            *(
                Column(
                    f"{scene} × 1/2, × 2",
                    f"{{{scene}[half][product_ratio]:.2f}}, {{{scene}[double][product_ratio]:.2f}}",
                )
                for scene in ("kitchen", "veach_ajar", "everything8003")
            ),
        ),
        first="constant",
    ),
    "cold": Table(
        {"": ("manylights_cold",), "large": ("manylights_memory",)},
        (
            Column("`path` s", "{path[seconds]:.1f}"),
            Column("`manylights` s", "{manylights[seconds]:.1f}"),
            Column("new scene: `path` s", "{path[new_scene_seconds]:.1f}"),
            Column("new scene: `manylights` s", "{manylights[new_scene_seconds]:.1f}"),
            Column("`path` GiB, 1024 wide", "{large[path][memory]:.1f}"),
            Column("`manylights` GiB, 1024 wide", "{large[manylights][memory]:.1f}"),
        ),
    ),
    "brute": Table(
        {"": ("lightcuts_brute",)},
        (
            Column("lightcuts s", "{lightcuts[seconds]:.2f}"),
            Column("light tree s", "{lightcuts[tree_seconds]:.2f}"),
            Column("rays/px", "{lightcuts[rays]:.0f}"),
            Column("bounds/px", "{lightcuts[bounds]:.0f}"),
            Column("cut", "{lightcuts[cut]:.0f}"),
            Column("rel. L1", "{lightcuts[relative_l1]:.2%}"),
            Column("all VPLs s", "{vpl[seconds]:.0f}"),
            Column("ratio", ratio="speedup"),
        ),
    ),
    "path": Table(
        {"": ("lightcuts_path",)},
        (
            Column("path", "{path[relmse]:.4f} ({path[samples]:.0f})"),
            Column("lightcuts", "{lightcuts[relmse]:.4f} ({lightcuts[samples]:.0f}, {lightcuts[bias]:+.1%})"),
            Column(
                "mdlightcuts",
                "{mdlightcuts[relmse]:.4f} ({mdlightcuts[samples]:.0f}, {mdlightcuts[bias]:+.1%})",
                bound="mdlightcuts.hidden",
                sign="< ",
            ),
            Column("ratio", ratio="speedup", bound="mdlightcuts.hidden", sign="≥ "),
        ),
    ),
    "lightcuts_cold": Table(
        {"": ("lightcuts_cold",)},
        (Column("`path` s", "{path[seconds]:.1f}"), Column("`lightcuts` s", "{lightcuts[seconds]:.1f}")),
    ),
    "illuminationcut": Table(
        {"": ("illuminationcut_table",)},
        (
            Column("RMSE", "{lightcuts[rmse]:.2g}"),
            Column("lightcuts: s, rays, bounds", numbers("lightcuts", "seconds:.3g", "rays:.0f", "bounds:.0f")),
            Column(
                "`all`: error, s, rays, bounds", numbers("all", "error:r%", "seconds:.2f", "rays:.0f", "bounds:.0f")
            ),
            Column("ratio", ratio="all.speedup"),
            Column("`adaptive`: error, s, rays", numbers("adaptive", "error:r%", "seconds:.2f", "rays:.0f")),
            Column("ratio", ratio="adaptive.speedup"),
        ),
    ),
    "public": Table(
        {"": ("illuminationcut_public",)},
        (
            Column("public code: CPU s", "{public code[cpu_seconds]:.3g}"),
            Column("rel. L1", "{public code[relative_l1]:.2%}"),
            Column("this project: CPU s", "{cpu_seconds:.2g}"),
            Column("rel. L1", "{relative_l1:.2%}"),
        ),
        first="method",
    ),
    "illuminationcut_memory": Table(
        {"": ("illuminationcut_memory",)},
        (Column("`all` GiB", "{all[memory]:.1f}"), Column("`adaptive` GiB", "{adaptive[memory]:.1f}")),
    ),
    "samples": Table(
        {"": ("baselines_samples",)},
        (
            Column("shared s", "{shared_seconds:.2f}"),
            Column("mean absolute", "{lightcuts[absolute]:.2%}"),
            Column("lightcuts: s, rays/px, RMSE", numbers("lightcuts", "seconds:.2f", "rays:.0f", "rmse:.4f")),
            Column(
                "mdlightcuts: error, s, rays/px, RMSE",
                numbers("mdlightcuts", "error:r%", "seconds:.2f", "rays:.0f", "rmse:.4f"),
            ),
            Column("ratio", ratio="mdlightcuts.speedup", bound="mdlightcuts.not_reached", sign="≤ "),
        ),
    ),
    "slices": Table(
        {"": ("baselines_slices", "baselines_slices_kitchen")},
        (
            Column("shared s", "{shared_seconds:.2f}"),
            Column("lightcuts: s, rays/px, RMSE", numbers("lightcuts", "seconds:.2f", "rays:.0f", "rmse:.4f")),
            Column("mean absolute", "{lightcuts[absolute]:.2%}"),
            Column("lightslice: columns", "{lightslice[columns]:.0f}"),
            Column("s, rays/px, RMSE", numbers("lightslice", "seconds:.2f", "rays:.0f", "rmse:.4f")),
            Column("mean absolute", "{lightslice[absolute]:.2%}"),
            Column("ratio", ratio="lightslice.speedup", bound="lightslice.not_reached", sign="≤ "),
        ),
    ),
    "slices_memory": Table({"": ("baselines_memory",)}, (Column("GiB", "{memory:.1f}"),)),
    "recovery": Table(
        {"": ("matrixrecovery_table",)},
        recovery_columns(
            "matrixrecovery: s, rays/px, rate, columns, RMSE",
            numbers("matrixrecovery", "seconds:.2f", "rays:.0f", "rate:.1%", "columns:.0f", "rmse:.3f"),
        ),
    ),
    "recovery_cost": Table(
        {"": ("matrixrecovery_cost",)},
        recovery_columns(
            "matrixrecovery: s, rays/px, RMSE",
            numbers("matrixrecovery", "seconds:.2f", "rays:.0f", "rmse:.3f"),
        ),
        first="veils",
    ),
    "recovery_steps": Table(
        {"": ("matrixrecovery_steps",)},
        tuple(
            Column(f"{scene}: mean absolute, rays/px", f"{{{scene}[absolute]:.2%}}, {{{scene}[rays]:.0f}}")
            for scene in ("cornell", "kitchen")
        ),
        first="steps",
    ),
    "direct": Table(
        {"": ("adaptivedirect_table",)},
        (
            Column("adaptive: s, rays/px, relMSE", numbers("adaptive", "seconds:.2f", "rays:.0f", "relmse:.5f")),
            Column("unoccluded", numbers("unoccluded", "seconds:.2f", "rays:.0f", "relmse:.5f")),
            Column("faster", ratio="same rule.speedup"),
            Column("fewer rays", ratio="same rule.fewer_rays"),
            Column("unoccluded", ratio="unoccluded.speedup"),
            Column("all", ratio="all.speedup"),
            Column("`direct`", ratio="direct.speedup"),
            Column("`path`", ratio="path.speedup"),
        ),
    ),
    "direct_lights": Table(
        {"": ("adaptivedirect_lights",)},
        (Column("`auto` s", "{auto[seconds]:.2g}"), Column("`all` s", "{all[seconds]:.2g}")),
        first="lights",
    ),
    "direct_cold": Table(
        {"": ("adaptivedirect_cold",)},
        (
            Column("first render s", "{adaptivedirect[seconds]:.1f}"),
            Column("second render s", "{adaptivedirect[second_seconds]:.1f}"),
        ),
    ),
}
