"""Colours and numbers of node sockets as Mitsuba's textures.

Values are linear (Rec. 709). Both Blender's pixels and its texture coordinates begin at the lower left, so that
Mitsuba takes both unchanged.
"""

import math

import mitsuba as mi
import numpy as np

FILTERS = {"Linear": "bilinear", "Closest": "nearest"}
WRAPS = {"REPEAT": "repeat", "EXTEND": "clamp", "MIRROR": "mirror"}
LINEAR_SPACES = ("Non-Color", "Linear Rec.709", "Linear", "Raw")
MISSING = (1.0, 0.0, 1.0)  # magenta, Blender's colour of a missing image
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of Rec. 709


def rgb(values, scale=1.0):
    """Dictionary of a constant linear colour: the first three of `values`, times `scale`."""
    return {"type": "rgb", "value": [float(value) * scale for value in values[:3]]}


def source(socket):
    """Return the (node, socket) that feeds a socket, past reroutes; (None, None) if it is not linked."""
    while socket.is_linked:
        link = socket.links[0]
        if link.from_node.bl_idname != "NodeReroute":
            return link.from_node, link.from_socket
        socket = link.from_node.inputs[0]
    return None, None


class Textures:
    """Textures of one export. `owner`: the material or world whose sockets are read, for messages."""

    def __init__(self, problems):
        self.problems, self._pixels = problems, {}

    def colour(self, owner, socket, power=1.0, scale=1.0):
        """Dictionary of the linear colour of a socket, raised to `power` and scaled: `rgb` or `bitmap`."""
        node, _ = source(socket)
        if node is not None and node.bl_idname == "ShaderNodeTexImage":
            return self._bitmap(owner, node, lambda pixels: pixels[..., :3] ** power * scale)
        return rgb([value**power for value in self.constant(owner, socket)], scale)

    def constant(self, owner, socket):
        """Linear colour (3) or number of a socket, without textures: of a node with one value, or of the socket itself,
        which replaces any other node."""
        (node, _), value = source(socket), socket.default_value
        is_number = isinstance(value, float)
        if node is not None and node.bl_idname == ("ShaderNodeValue" if is_number else "ShaderNodeRGB"):
            value = node.outputs[0].default_value
        elif node is not None:
            self.problems.add(
                owner, f"node '{node.name}' at '{socket.name}' is not exported; the value of the socket replaces it"
            )
        return float(value) if is_number else np.array(value[:3])

    def number(self, owner, socket):
        """Number of a socket: a float, or the dictionary of a `bitmap` with one channel."""
        node, output = source(socket)
        if node is not None and node.bl_idname == "ShaderNodeTexImage":
            alpha = output.name == "Alpha"
            channel = (lambda pixels: pixels[..., 3:]) if alpha else (lambda pixels: pixels[..., :3] @ LUMINANCE)
            return self._bitmap(owner, node, lambda pixels: channel(pixels).reshape(*pixels.shape[:2], 1))
        return self.constant(owner, socket)

    def _bitmap(self, owner, node, convert):
        """Dictionary of the bitmap of an Image Texture node; `convert` computes its channels from (h, w, 4) pixels."""
        pixels = self.pixels(owner, node.image)
        if pixels is None:
            return rgb(MISSING)
        for value, known, name in (
            (node.interpolation, FILTERS, "interpolation"),
            (node.extension, WRAPS, "extension"),
        ):
            if value not in known:
                self.problems.add(owner, f"{name} '{value}' of node '{node.name}' is not exported")
        if node.projection != "FLAT":
            self.problems.add(owner, f"projection '{node.projection}' of node '{node.name}' is not exported")
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(convert(pixels), np.float32)),
            "raw": True,
            "filter_type": FILTERS.get(node.interpolation, "bilinear"),
            "wrap_mode": WRAPS.get(node.extension, "repeat"),
            "to_uv": mi.ScalarTransform3f(self._mapping(owner, node.inputs["Vector"])),
        }

    def pixels(self, owner, image):
        """Return the linear pixels of an image, float32 (height, width, 4), lowest row first; None without pixels."""
        if image is None or 0 in image.size or image.source not in ("FILE", "GENERATED"):
            name = image.name if image else "None"
            self.problems.add(owner, f"image '{name}' has no pixels, or is tiled or animated; it becomes magenta")
            return None
        if image.name_full not in self._pixels:
            width, height = image.size
            values = np.empty(width * height * 4, np.float32)
            image.pixels.foreach_get(values)
            self._pixels[image.name_full] = self._linear(owner, image, values.reshape(height, width, 4))
        return self._pixels[image.name_full]

    def _linear(self, owner, image, values):
        """Decode sRGB in place. Blender has decoded images of floats already."""
        space = image.colorspace_settings.name
        if image.is_float or space in LINEAR_SPACES:
            return values
        if space != "sRGB":
            self.problems.add(owner, f"colour space '{space}' of image '{image.name}' is read as sRGB")
        colours = values[..., :3]
        values[..., :3] = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
        return values

    def _mapping(self, owner, socket):
        """Matrix (3, 3) from the coordinates of the mesh to those of the image."""
        node, output = source(socket)
        if node is None or (node.bl_idname == "ShaderNodeTexCoord" and output.name == "UV"):
            return np.eye(3)
        if node.bl_idname == "ShaderNodeMapping" and node.vector_type == "POINT":
            below = self._mapping(owner, node.inputs["Vector"])
            (x, y, _), (_, _, angle), (sx, sy, _) = (
                node.inputs[name].default_value for name in ("Location", "Rotation", "Scale")
            )
            c, s = math.cos(angle), math.sin(angle)
            return np.array([[c * sx, -s * sy, x], [s * sx, c * sy, y], [0, 0, 1]]) @ below
        self.problems.add(
            owner, f"texture coordinates from node '{node.name}' are not exported; the mesh's UVs replace it"
        )
        return np.eye(3)
