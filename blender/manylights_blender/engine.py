"""The render engine: export, render in passes, and the image for Blender."""

import bpy
import numpy as np

from .settings import ENGINE

VARIANT = "llvm_ad_rgb"
BACKGROUND_SPP = 16  # samples per pixel of the world behind the image: smooth between pixels, unlike edges of objects
BACKGROUND_DEPTH = 1  # `max_depth`: light that reaches the camera directly
DIRECT_DEPTH = 2  # `max_depth` of direct light, 0 bounces: Mitsuba counts the edges from camera to light


class ManylightsEngine(bpy.types.RenderEngine):
    """Final renders by ``manylights``."""

    bl_idname = ENGINE
    bl_label = "Many lights (Mitsuba)"
    bl_use_preview = False
    bl_use_eevee_viewport = True  # Material Preview in the viewport

    def render(self, depsgraph):
        """Render a view layer. Called by Blender, in a thread of its own if Blender has a window."""
        try:
            import mitsuba as mi

            import manylights
        except ModuleNotFoundError as error:
            self.report(
                {"ERROR"}, f"{error}: install the package manylights into Blender's Python (see docs/blender.md)"
            )
            return
        if mi.variant() != VARIANT:
            mi.set_variant(VARIANT)
        try:
            self._render(manylights, depsgraph)
        except (ValueError, RuntimeError, ModuleNotFoundError) as error:
            self.report({"ERROR"}, str(error))

    def _render(self, manylights, depsgraph):
        import mitsuba as mi

        from vpl.core.garbage import garbage_kept

        from .scene import export

        self.update_stats("", "Exporting the scene")
        # Blender's own Python runs beside this thread
        with garbage_kept():
            exported = export(depsgraph)
        for sentence in exported.problems:
            self.report({"WARNING"}, sentence)
        settings = depsgraph.scene.manylights
        integrator = mi.load_dict(
            {
                "type": "manylights",
                "max_depth": settings.max_bounces + DIRECT_DEPTH,
                "hide_emitters": exported.hide_emitters,
                "denoised": settings.use_denoising,
            }
        )
        opaque = not depsgraph.scene.render.film_transparent
        screen = Screen(self, depsgraph.view_layer_eval.name, _background(exported.background), opaque)
        image, _ = manylights.render(
            exported.scene, integrator, progress=Progress(self, screen, integrator), **limits(settings)
        )
        screen.show(image)

    def update_render_passes(self, scene=None, renderlayer=None):
        """Blender asks which passes there are."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")


def limits(settings):
    """Arguments of `manylights.render` for the settings of a scene."""
    return {
        "spp": settings.samples,
        "error": settings.noise_threshold if settings.use_noise_threshold else None,
        "time": settings.time_limit or None,
        "denoise": settings.use_denoising,
    }


def _background(scene):
    """Image of the world alone (height, width, 3), None without a scene."""
    if scene is None:
        return None
    import mitsuba as mi

    from vpl.core.garbage import garbage_kept

    path = mi.load_dict({"type": "path", "max_depth": BACKGROUND_DEPTH})
    with garbage_kept():
        return np.array(mi.render(scene, integrator=path, spp=BACKGROUND_SPP))[..., :3]


class Screen:
    """Shows images of one render in Blender. `background` (height, width, 3): lies behind the image, or None; `opaque`:
    whether the film is not transparent."""

    def __init__(self, engine, layer, background, opaque):
        self._engine, self._layer, self._background, self._opaque = engine, layer, background, opaque

    def show(self, image):
        """Show an image (height, width, 4), highest row first."""
        pixels = np.array(image, np.float32)
        if self._background is not None:
            pixels[..., :3] += (1 - pixels[..., 3:]) * self._background
        if self._opaque:
            pixels[..., 3] = 1
        height, width = pixels.shape[:2]
        result = self._engine.begin_result(0, 0, width, height, layer=self._layer)
        result.layers[0].passes["Combined"].rect.foreach_set(np.ascontiguousarray(pixels[::-1]).ravel())
        self._engine.end_result(result)


class Progress:
    """Shows the progress of a render and ends it by Esc: the `progress` of `manylights.render`."""

    def __init__(self, engine, screen, integrator):
        self._engine, self._screen, self._integrator = engine, screen, integrator

    def __call__(self, took, image):
        """Called at the beginning of each stage, without an image, and after each pass."""
        parts = [f"Sample {took.spp}", f"Noise {took.error:.3g}" if took.error is not None else "", took.stage or ""]
        self._engine.update_stats("", " | ".join(part for part in parts if part))
        if took.seconds_left is not None:
            self._engine.update_progress(took.seconds / (took.seconds + took.seconds_left))
        if image is not None and took.ended_by is None:
            self._screen.show(image)
        if self.is_stopped():
            if took.passes:
                self._integrator.cancel()  # not before the first pass is finished, as there would be no image
            return False
        return None

    def is_stopped(self):
        """Whether the user pressed Esc."""
        return self._engine.test_break()


def register():
    """Add the engine to Blender."""
    bpy.utils.register_class(ManylightsEngine)


def unregister():
    """Remove the engine."""
    bpy.utils.unregister_class(ManylightsEngine)
