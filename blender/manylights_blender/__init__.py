"""Add-on for Blender 4.2 or newer: the render engine "Many lights (Mitsuba)".

``settings``: properties and panels; ``engine``: the render engine. The other modules export a scene, and need Mitsuba:
``scene`` calls ``meshes``, ``materials`` with ``textures``, ``lights``, ``world`` and ``camera``; ``problems`` collects
what cannot be exported. Blender's Python needs the package `manylights` when a render begins, not to enable the add-on.
"""

bl_info = {
    "name": "Many lights (Mitsuba)",
    "description": "Renders with the many-light integrators of Mitsuba 3",
    "author": "The Manylights authors",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "Render properties, Render Engine",
    "category": "Render",
}

from . import engine, settings  # noqa: E402 (older versions of Blender read bl_info without running the file)


def register():
    """Add the engine, its properties `scene.manylights` and its panels to Blender."""
    settings.register()
    engine.register()


def unregister():
    """Remove what `register` added."""
    engine.unregister()
    settings.unregister()
