"""Properties of the engine, named as in Cycles, and their panel."""

import bpy

ENGINE = "MANYLIGHTS"
# Panels of Eevee that show nodes and values that the engine exports; absent in some versions of Blender
PANELS_OF_EEVEE = (
    "EEVEE_MATERIAL_PT_context_material", "EEVEE_MATERIAL_PT_surface", "EEVEE_WORLD_PT_surface", "DATA_PT_EEVEE_light",
    "DATA_PT_camera_dof", "DATA_PT_camera_dof_aperture",
)  # fmt: skip


class ManylightsSettings(bpy.types.PropertyGroup):
    """Settings of a scene. The first limit that is reached ends the render."""

    samples: bpy.props.IntProperty(
        name="Max Samples", description="Most samples per pixel", default=1024, min=1, max=1 << 24
    )
    use_noise_threshold: bpy.props.BoolProperty(
        name="Noise Threshold", description="End the render at this noise", default=True
    )
    noise_threshold: bpy.props.FloatProperty(
        name="Noise Threshold",
        description="Relative standard error that 95% of the pixels do not exceed, before denoising",
        default=0.05, min=1e-4, max=1.0, precision=4,
    )  # fmt: skip
    time_limit: bpy.props.FloatProperty(
        name="Time Limit",
        description="Most seconds of the render; 0: no limit",
        default=0.0,
        min=0.0,
        unit="TIME_ABSOLUTE",
    )
    use_denoising: bpy.props.BoolProperty(name="Denoise", description="Denoise by Open Image Denoise", default=True)
    max_bounces: bpy.props.IntProperty(
        name="Max Bounces", description="Most bounces of light; 0: direct light only", default=12, min=0, max=1024
    )


class RENDER_PT_manylights(bpy.types.Panel):
    """Panel in the render properties."""

    bl_label = "Sampling"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = frozenset({ENGINE})

    @classmethod
    def poll(cls, context):
        """Show the panel for this engine only."""
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context):
        """Draw all properties."""
        settings, layout = context.scene.manylights, self.layout
        layout.use_property_split = True
        row = layout.row(heading="Noise Threshold")
        row.prop(settings, "use_noise_threshold", text="")
        threshold = row.row()
        threshold.active = settings.use_noise_threshold
        threshold.prop(settings, "noise_threshold", text="")
        for name in ("samples", "time_limit", "use_denoising", "max_bounces"):
            layout.prop(settings, name)


def shared_panels():
    """Panels of Blender that the engine also shows."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", ())
        if "BLENDER_RENDER" in engines or panel.__name__ in PANELS_OF_EEVEE:
            yield panel


def register():
    """Add `scene.manylights` and the panels."""
    bpy.utils.register_class(ManylightsSettings)
    bpy.types.Scene.manylights = bpy.props.PointerProperty(type=ManylightsSettings)
    bpy.utils.register_class(RENDER_PT_manylights)
    for panel in shared_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister():
    """Remove what `register` added."""
    for panel in shared_panels():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.utils.unregister_class(RENDER_PT_manylights)
    del bpy.types.Scene.manylights
    bpy.utils.unregister_class(ManylightsSettings)
