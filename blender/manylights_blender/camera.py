"""Blender's camera as Mitsuba's sensor."""

import math

import mitsuba as mi
import numpy as np

# Blender's camera looks along −Z with +X to the right, Mitsuba's along +Z with +X to the left
TURN = np.diag([-1.0, 1.0, -1.0, 1.0])
MILLIMETRE = 1e-3  # in units of the scene, as Cycles takes the aperture


def image_size(render):
    """Width and height in pixels of Blender's render settings."""
    return tuple(int(size * render.resolution_percentage / 100) for size in (render.resolution_x, render.resolution_y))


def sensor(camera, render, problems):
    """Return the dictionary of the sensor for an evaluated camera object and render settings.

    The film has RGBA pixels and a box filter: the filter of Cycles is hardly wider, and noise of a box is easier to
    remove. Raises ValueError for a panoramic camera.
    """
    data = camera.data
    if data.type not in ("PERSP", "ORTHO"):
        raise ValueError(f"camera '{camera.name}': its type must be Perspective or Orthographic, got {data.type}")
    if render.pixel_aspect_x != render.pixel_aspect_y:
        problems.add_setting("Aspect", "pixels that are not square are not exported")
    if render.use_border:
        problems.add_setting("Render Region", "not exported; the whole image is rendered")
    size = image_size(render)
    wide = size[0] >= size[1] if data.sensor_fit == "AUTO" else data.sensor_fit == "HORIZONTAL"
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgba", "rfilter": {"type": "box"}}
    clip = {"near_clip": data.clip_start, "far_clip": data.clip_end}
    matrix = np.array(camera.matrix_world.normalized())
    make = _perspective if data.type == "PERSP" else _orthographic
    return {**make(camera, matrix, size, wide, problems), **clip, "film": film}


def _perspective(camera, matrix, size, wide, problems):
    data = camera.data
    across = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    found = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(matrix @ TURN),
        "fov": math.degrees(2 * math.atan(across / (2 * data.lens))),
        "fov_axis": "x" if wide else "y",
    }
    lens = _lens(camera, matrix, problems)
    if lens:
        if data.shift_x or data.shift_y:
            problems.add(data, "'Shift' together with depth of field is not exported")
        return {**found, "type": "thinlens", **lens}
    # Blender shifts the view, in units of the fitted side; Mitsuba shifts the image, in units of its own side
    unit = size[0] if wide else size[1]
    offsets = (data.shift_x * unit / size[0], -data.shift_y * unit / size[1])
    return {**found, "principal_point_offset_x": offsets[0], "principal_point_offset_y": offsets[1]}


def _lens(camera, matrix, problems):
    """Radius and distance of a thin lens, empty without depth of field."""
    dof = camera.data.dof
    if not dof.use_dof:
        return {}
    if dof.aperture_blades or dof.aperture_ratio != 1:
        problems.add(camera.data, "'Blades' and 'Ratio' of the aperture are not exported; it is round")
    distance = dof.focus_distance
    if dof.focus_object is not None:
        offset = np.array(dof.focus_object.matrix_world)[:3, 3] - matrix[:3, 3]
        distance = abs(float(offset @ matrix[:3, 2]))
    radius = camera.data.lens * MILLIMETRE / (2 * dof.aperture_fstop)
    return {"aperture_radius": radius, "focus_distance": distance}


def _orthographic(camera, matrix, size, wide, problems):
    data = camera.data
    if data.dof.use_dof:
        problems.add(data, "depth of field of an orthographic camera is not exported")
    half = data.ortho_scale / 2 * (1 if wide else size[0] / size[1])  # of the width, which Mitsuba maps to -1 .. 1
    shift = np.eye(4)
    shift[:2, 3] = data.shift_x * data.ortho_scale, data.shift_y * data.ortho_scale
    return {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f(matrix @ shift @ TURN @ np.diag([half, half, 1, 1])),
    }
