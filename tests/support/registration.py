"""Programs that import the project before and after a variant is set."""

FIRST = "import manylights, mitsuba as mi\n"


LATER = "import mitsuba as mi\nmi.set_variant('scalar_rgb')\nimport manylights\n"


LOAD = """
for variant in ("llvm_ad_rgb", "scalar_rgb", "llvm_ad_mono"):
    mi.set_variant(variant)
    for name in manylights.integrators.PLUGINS:
        try:
            print(type(mi.load_dict({"type": name})).__name__)
        except RuntimeError as error:
            print(f'does not support the variant "{variant}"' in str(error))
"""
