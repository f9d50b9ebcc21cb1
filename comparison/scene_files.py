"""Parse scene files, change integrator or image size, compute fingerprints, load scenes.

Mitsuba's parser substitutes `$parameters` and resolves includes. Changes apply to the parsed nodes before objects are
created; a scene may therefore name an integrator that does not exist here, if it is replaced.
"""

import hashlib
import os
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi

from vpl.core.garbage import garbage_kept

# Object types of the camera
_OF_CAMERA = ("Sensor", "Film", "Sampler", "ReconstructionFilter")
# Parameters that a new integrator inherits: they select light paths, not an algorithm
KEPT_PARAMETERS = ("max_depth", "rr_depth", "hide_emitters")
# Names of string properties that plugins of Mitsuba 3.9 open as files: bitmap, envmap, gridvolume, measured,
# measured_polarized, obj, ply, serialized, sdfgrid, bsplinecurve, linearcurve, ellipsoids and ellipsoidsmesh. None has
# another such property; those of sunsky are part of Mitsuba.
FILE_PROPERTIES = ("filename",)
DEFAULT_PARTS = {"Film": "hdrfilm", "Sampler": "independent"}  # of Mitsuba's sensors, by type
GIVEN_TO_RENDER = ("sample_count", "seed")  # sampler parameters overridden by each render
# Nanoseconds after its last change from which on the hash of a file is kept: another change within the steps in which
# the file system counts time, two seconds at most, would not be seen
SETTLED = 3 * 10**9


def short_name(path):
    """Return the short name of a scene file: its stem, or the name of its folder for `scene.xml`."""
    path = Path(path)
    return path.resolve().parent.name if path.stem == "scene" else path.stem


class SceneFile:
    """Parsed scene file. Requires a variant.

    `path` is an XML file; `defines` maps `$parameters` to text; `changes` is a list of (method, arguments) applied
    after parsing. Raises RuntimeError with Mitsuba's message for a parse error, ValueError for a scene without sensor.
    """

    def __init__(self, path, defines=None, changes=()):
        self.path, self.defines, self.changes = Path(path), dict(defines or {}), []
        self._configuration = mi.parser.ParserConfig(mi.variant())
        self._state = mi.parser.parse_file(self._configuration, str(path), **self.defines)
        self._resolver = mi.FileResolver(mi.file_resolver())  # which has the folders of <path> elements now
        self._resolver.prepend(str(self.path.parent))
        self._ids = self._state.id_to_index  # a copy; no method adds identifiers or sensors
        self._sensors = self._found_sensors()
        if not self._sensors:
            raise ValueError(f"{path}: the scene has no sensor")
        for method, arguments in changes:
            getattr(self, method)(*arguments)

    @property
    def name(self):
        """See `short_name`."""
        return short_name(self.path)

    @property
    def integrator(self):
        """Plugin name (None: none) and plain parameters (numbers, bools and strings) of the scene's integrator."""
        nodes = self._nodes(mi.ObjectType.Integrator)
        if not nodes:
            return None, {}
        properties = mi.Properties(nodes[0].props)  # a copy: reading marks parameters as queried
        values = dict(properties.items())
        plain = {key: value for key, value in values.items() if isinstance(value, bool | int | float | str)}
        return properties.plugin_name(), plain

    @property
    def has_media(self):
        """Whether the scene contains participating media."""
        return bool(self._nodes(mi.ObjectType.Medium))

    def set_integrator(self, name, parameters=None, keep=KEPT_PARAMETERS):
        """Replace the integrator. Inherits the old parameters named by `keep` (None: all), except those given anew or
        unknown to the new integrator. If `keep` is None and the name is unchanged, the integrator also keeps its parts,
        such as nested integrators, and unknown parameters are errors. Raises RuntimeError or ValueError if the
        integrator cannot be created; one with parts is not tried, as it may need them."""
        self.changes.append(("set_integrator", (name, dict(parameters or {}), keep)))
        given, (old_name, old) = dict(parameters or {}), self.integrator
        nodes = self._nodes(mi.ObjectType.Integrator)
        if name == old_name and keep is None:
            properties = _properties(nodes[0].props, given)
        else:
            kept = {key: old[key] for key in old if key not in given and (keep is None or key in keep)}
            known = known_parameters(name, kept | given)
            properties = _properties(name, {key: kept[key] for key in kept if key in known} | given)
        if not self._parts(properties):
            mi.PluginManager.instance().create_object(mi.Properties(properties))
        if nodes:
            nodes[0].props = properties
        else:
            self._add(0, "integrator", mi.ObjectType.Integrator, properties)

    def set_max_depth(self, depth):
        """Set `max_depth`, by the integrator `path`; later integrators inherit it."""
        self.set_integrator("path", {"max_depth": depth})

    @property
    def sensors(self):
        """Number of sensors."""
        return len(self._sensors)

    @property
    def size(self):
        """Width and height of the first sensor's image in pixels, with Mitsuba's defaults; of its crop window, if there
        is one."""
        (_, width, _), (_, height, _) = _axes(self._part(self._sensors[0], mi.ObjectType.Film))
        return width, height

    @property
    def sampler_name(self):
        """Plugin of the first sensor's sampler, with Mitsuba's default."""
        return self._part(self._sensors[0], mi.ObjectType.Sampler).plugin_name()

    def set_sampler(self, name):
        """Replace the type of all samplers and keep their parameters; sensors without a sampler get one. Raises
        RuntimeError for an unknown plugin, ValueError for a plugin that is no sampler."""
        if not isinstance(mi.PluginManager.instance().create_object(mi.Properties(name)), mi.Sampler):
            raise ValueError(f"'{name}' is no sampler")
        self.changes.append(("set_sampler", (name,)))
        for sampler in self._nodes(mi.ObjectType.Sampler):
            sampler.props.set_plugin_name(name)
        self._complete(mi.ObjectType.Sampler, name)

    def set_width(self, width):
        """Set the width of all images in pixels; heights keep the aspect ratio. The image of a film with a crop window
        is the window: film, window and offset are scaled alike, and rounded. Raises ValueError for a window that does
        not lie in its film."""
        self.changes.append(("set_width", (width,)))
        self._complete(mi.ObjectType.Film, DEFAULT_PARTS["Film"])
        for film in self._nodes(mi.ObjectType.Film):
            film.props = _with_width(film.props, int(width))

    def _complete(self, kind, plugin):
        """Add a part, a film or a sampler, to the sensors without one."""
        for sensor in self._sensors:
            if not self._parts(self._state.nodes[sensor].props, kind):
                self._add(sensor, kind.name.lower(), kind, mi.Properties(plugin))

    def _add(self, parent, name, kind, properties):
        """Add a node, as the part `name` of the node of index `parent`."""
        node = mi.parser.SceneNode()
        node.type, node.props = kind, properties
        self._state.nodes.append(node)  # may move the nodes in memory: older references to them are invalid
        index = len(self._state.nodes) - 1
        self._state.nodes[parent].props[name] = mi.Properties.ResolvedReference(index)

    def fingerprint(self, camera=True):
        """Return a hash (hexadecimal) of all image dependencies except samples per pixel and seed: variant, parameters
        of the scene, content of referenced files. `camera=False` omits sensors with their parts."""
        digest = hashlib.sha256(mi.variant().encode())
        for node in self._state.nodes:
            if not camera and node.type in {getattr(mi.ObjectType, name) for name in _OF_CAMERA}:
                continue
            properties = mi.Properties(node.props)
            if node.type == mi.ObjectType.Sampler:
                for name in GIVEN_TO_RENDER:
                    if name in properties:
                        del properties[name]
            digest.update(repr(properties).encode())
            for file in self._named(node):
                digest.update(bytes.fromhex(file_hash(file)))
        return digest.hexdigest()

    def _named(self, node):
        """Yield the paths of the files that an object names."""
        properties = mi.Properties(node.props)
        for name in FILE_PROPERTIES:
            file = Path(str(self._resolver.resolve(properties[name]))) if name in properties else None
            if file and file.is_file():
                yield file

    def sampling(self, sensor):
        """Return the number of pixels and the `mi.Sampler` of a sensor (by index) without creating the scene. Raises
        ValueError for an invalid index."""
        if not 0 <= sensor < self.sensors:
            raise ValueError(f"no sensor {sensor}: the scene has {self.sensors}")
        node = self._sensors[sensor]
        film, sampler = (self._part(node, kind) for kind in (mi.ObjectType.Film, mi.ObjectType.Sampler))
        (_, width, _), (_, height, _) = _axes(film)
        return width * height, mi.PluginManager.instance().create_object(sampler)

    def load(self, threads=None):
        """Create the `mi.Scene`, once, because this consumes the parsed nodes. `threads`: limit for later work."""
        threads = threads or dr.thread_count()
        # Mitsuba deadlocks when it reads EXR files with a single thread
        dr.set_thread_count(max(threads, 2))
        resolver = mi.FileResolver(mi.file_resolver())
        mi.file_resolver().prepend(str(self.path.parent))
        try:
            mi.parser.transform_all(self._configuration, self._state)
            with garbage_kept():
                return mi.parser.instantiate(self._configuration, self._state)
        finally:
            mi.set_file_resolver(resolver)
            dr.set_thread_count(threads)

    def _nodes(self, kind):
        return [node for node in self._state.nodes if node.type == kind]

    def _parts(self, properties, kind=None):
        """Return the indices of the nodes that properties refer to, of one kind or of all. Mitsuba resolves references
        by `id` when the scene is loaded, and refuses those to nothing."""
        parts = []
        for _, value in mi.Properties(properties).items():
            if isinstance(value, mi.Properties.ResolvedReference):
                parts.append(value.index())
            elif isinstance(value, mi.Properties.Reference) and value.id() in self._ids:
                parts.append(self._ids[value.id()])
        return [index for index in parts if kind in (None, self._state.nodes[index].type)]

    def _part(self, sensor, kind):
        """Return a copy of the properties of a sensor's film or sampler, with Mitsuba's default."""
        parts = self._parts(self._state.nodes[sensor].props, kind)
        return mi.Properties(self._state.nodes[parts[0]].props if parts else mi.Properties(DEFAULT_PARTS[kind.name]))

    def _found_sensors(self):
        """Return the indices of the sensors of the scene and of its shapes; others are parts of sensors."""
        nodes, kind = self._state.nodes, mi.ObjectType.Sensor
        children = self._parts(self._state.root.props)
        sensors = {index for index, node in enumerate(nodes) if node.type == kind}
        known = sensors.intersection(children)
        known.update(*(self._parts(nodes[index].props, kind) for index in sensors))
        if known == sensors:
            # Without a look at the shapes, which takes long for many
            return [index for index in children if index in sensors]
        found = []
        for index in children:
            if index in sensors:
                found.append(index)
            elif nodes[index].type == mi.ObjectType.Shape:
                found += self._parts(nodes[index].props, kind)
        return found


def known_parameters(name, parameters):
    """Return the names of those `parameters` that a plugin has. Mitsuba has no list of a plugin's parameters: a trial
    creation, even a failed one, records the queried parameters."""
    tried = _properties(name, parameters)
    with suppress(RuntimeError, ValueError):
        mi.PluginManager.instance().create_object(tried)
    return {key for key in parameters if tried.was_queried(key)}


def file_hash(path):
    """Return a hash (hexadecimal) of the content of a file, which is read again only after a change. Raises OSError for
    an unreadable file."""
    status = os.stat(path)
    if time.time_ns() - status.st_mtime_ns < SETTLED:
        return _hash(path)
    return _hash_as_of(os.path.abspath(path), status.st_mtime_ns, status.st_size)


@lru_cache(4096)
def _hash_as_of(path, modified, size):
    return _hash(path)


def _hash(path):
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _axes(film):
    """Return size, size of the crop window, and its offset, in pixels, for both axes of a film's properties."""
    axes = []
    for name, axis, default in (("width", "x", 768), ("height", "y", 576)):  # Mitsuba's defaults
        size = film.get(name, default)
        axes.append((size, film.get(f"crop_{name}", size), film.get(f"crop_offset_{axis}", 0)))
    return axes


def _with_width(film, width):
    """Return a film's properties with an image of the given width, see `SceneFile.set_width`."""
    film, axes = mi.Properties(film), _axes(mi.Properties(film))
    (film_width, old, x), (film_height, old_height, y) = axes
    if any(crop < 1 or offset < 0 or offset + crop > size for size, crop, offset in axes):
        raise ValueError(
            f"the crop window of {old} x {old_height} pixels at ({x}, {y}) does not lie in the film of {film_width} x "
            f"{film_height}"
        )
    for (name, axis), (size, crop, offset) in zip((("width", "x"), ("height", "y")), axes, strict=True):
        crop, offset = max(1, round(crop * width / old)), round(offset * width / old)
        film[name] = max(round(size * width / old), offset + crop)
        given = {f"crop_{name}": crop, f"crop_offset_{axis}": offset}
        for key in given:
            if key in film:
                film[key] = given[key]
    return film


def _properties(base, parameters):
    """Return properties: of a plugin's name, or of other properties, with the given parameters."""
    properties = mi.Properties(base)
    for key, value in parameters.items():
        properties[key] = value
    return properties
