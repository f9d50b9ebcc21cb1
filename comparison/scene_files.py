"""Parse scene files, change integrator or image size, compute fingerprints, load scenes.

Mitsuba's parser substitutes `$parameters` and resolves includes. Changes apply to the parsed nodes before objects are
created; a scene may therefore name an integrator that does not exist here, if it is replaced.
"""

import hashlib
from contextlib import suppress
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
GIVEN_TO_RENDER = ("sample_count", "seed")  # sampler parameters overridden by each render


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
        if not self._nodes(mi.ObjectType.Sensor):
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
        unknown to the new integrator. If `keep` is None and the name is unchanged, unknown parameters are errors.
        Raises RuntimeError or ValueError if the integrator cannot be created."""
        self.changes.append(("set_integrator", (name, dict(parameters or {}), keep)))
        given, (old_name, old) = dict(parameters or {}), self.integrator
        kept = {key: old[key] for key in old if key not in given and (keep is None or key in keep)}
        if name != old_name or keep is not None:
            known = known_parameters(name, kept | given)
            kept = {key: kept[key] for key in kept if key in known}
        properties = _properties(name, kept | given)
        mi.PluginManager.instance().create_object(_properties(name, kept | given))
        nodes = self._nodes(mi.ObjectType.Integrator)
        if nodes:
            nodes[0].props = properties
        else:
            self._state.root.props["integrator"] = self._add(mi.ObjectType.Integrator, properties)

    def set_max_depth(self, depth):
        """Set `max_depth`, by the integrator `path`; later integrators inherit it."""
        self.set_integrator("path", {"max_depth": depth})

    @property
    def sensors(self):
        """Number of sensors."""
        return len(self._nodes(mi.ObjectType.Sensor))

    @property
    def size(self):
        """Width and height of the first film in pixels, with Mitsuba's defaults."""
        films = self._nodes(mi.ObjectType.Film)
        properties = mi.Properties(films[0].props if films else mi.Properties("hdrfilm"))
        return properties.get("width", 768), properties.get("height", 576)

    @property
    def sampler_name(self):
        """Plugin of the first sampler, with Mitsuba's default."""
        samplers = self._nodes(mi.ObjectType.Sampler)
        return samplers[0].props.plugin_name() if samplers else "independent"

    def set_sampler(self, name):
        """Replace the type of all samplers and keep their parameters; sensors without a sampler get one. Raises
        RuntimeError for an unknown plugin, ValueError for a plugin that is no sampler."""
        if not isinstance(mi.PluginManager.instance().create_object(mi.Properties(name)), mi.Sampler):
            raise ValueError(f"'{name}' is no sampler")
        self.changes.append(("set_sampler", (name,)))
        for sampler in self._nodes(mi.ObjectType.Sampler):
            sampler.props.set_plugin_name(name)
        for sensor in self._nodes(mi.ObjectType.Sensor):
            if all(part.type != mi.ObjectType.Sampler for part in self._parts(sensor)):
                sensor.props["sampler"] = self._add(mi.ObjectType.Sampler, mi.Properties(name))

    def _add(self, kind, properties):
        """Add a node; return the reference to it."""
        node = mi.parser.SceneNode()
        node.type, node.props = kind, properties
        self._state.nodes.append(node)
        return mi.Properties.ResolvedReference(len(self._state.nodes) - 1)

    def set_width(self, width):
        """Set the width in pixels; the height keeps the aspect ratio of the first film."""
        self.changes.append(("set_width", (width,)))
        old_width, old_height = self.size
        for film in self._nodes(mi.ObjectType.Film):
            film.props["width"] = int(width)
            film.props["height"] = max(1, round(old_height * width / old_width))

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
                digest.update(hashlib.sha256(file.read_bytes()).digest())
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
        sensors = self._nodes(mi.ObjectType.Sensor)
        if not 0 <= sensor < len(sensors):
            raise ValueError(f"no sensor {sensor}: the scene has {len(sensors)}")
        parts = self._parts(sensors[sensor])
        film, sampler = (
            mi.Properties(next((part.props for part in parts if part.type == kind), mi.Properties(default)))
            for kind, default in ((mi.ObjectType.Film, "hdrfilm"), (mi.ObjectType.Sampler, "independent"))
        )
        width, height = film.get("width", 768), film.get("height", 576)
        pixels = film.get("crop_width", width) * film.get("crop_height", height)
        return pixels, mi.PluginManager.instance().create_object(sampler)

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

    def _parts(self, node):
        """Return the nodes that a node refers to."""
        values = [value for _, value in mi.Properties(node.props).items()]
        return [self._state.nodes[one.index()] for one in values if isinstance(one, mi.Properties.ResolvedReference)]


def known_parameters(name, parameters):
    """Return the names of those `parameters` that a plugin has. Mitsuba has no list of a plugin's parameters: a trial
    creation, even a failed one, records the queried parameters."""
    tried = _properties(name, parameters)
    with suppress(RuntimeError, ValueError):
        mi.PluginManager.instance().create_object(tried)
    return {key for key in parameters if tried.was_queried(key)}


def _properties(name, parameters):
    properties = mi.Properties(name)
    for key, value in parameters.items():
        properties[key] = value
    return properties
