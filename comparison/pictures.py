"""Pictures of a scene's comparison: PNG files and the images of the report's page."""

from . import images, metrics, page_images

REFERENCE = "reference"  # title of the reference picture
DISTANCE_FACTOR = 16  # brightness of images of Euclidean distance, as in [IC]


class Pictures:
    """Pictures of the scene `name`, written to `folder`.

    `views` is a list of dicts for the page, one per image: "title", "label", "image", "error" (text, may be empty),
    "exr" (file name beside the page) and "maps" (kind "relative", "signed", "distance" or "flip" -> encoding by
    page_images.py; empty without a reference). `stills` are (title, error, data URL) for browsers without scripts. The
    first image determines the common `exposure`.
    """

    def __init__(self, folder, name):
        self.folder, self.name = folder, name
        self.exposure, self.views, self.stills, self.block = None, [], [], 1
        self._aovs = {}  # channel -> title -> values, (height, width)

    def show(self, title, label, file_name, exr, image, reference=None, flip=None, error=""):
        """Add an image, (height, width, 3) linear, from the file `exr`, with the label of its integrator (None: the
        reference). With a reference, also add its error maps; `flip` is the map of metrics.flip."""
        self.exposure = self.exposure or images.automatic_exposure(image)
        self.block = page_images.block_size(*image.shape[:2])
        pixels = images.tone_map(image, self.exposure)
        images.write_png(self.path(file_name, ".png"), pixels)
        self.stills.append((title, error, page_images.jpeg(pixels)))
        view = {"title": title, "label": label, "error": error, "exr": exr, "maps": {}}
        view["image"] = page_images.colours(image, self.exposure)
        if reference is not None:
            relative = metrics.relative_error(image, reference)
            images.write_png(self.path(file_name, ".error.png"), images.false_colours(relative))
            distance = DISTANCE_FACTOR * metrics.distance(image, reference)[..., None]
            view["maps"] = {
                "relative": page_images.relative(relative),
                "signed": page_images.signed(metrics.signed_error(image, reference)),
                "distance": page_images.colours(distance, self.exposure),
                "flip": page_images.plane(flip),
            }
        self.views.append(view)

    def add_aovs(self, wanted, title, planes, channels):
        """Store the AOV channels `wanted` of an image for `write_aovs`."""
        for index, channel in enumerate(channels):
            if channel.partition(".")[0] in wanted:  # "aov", or "aov.R" of a colour AOV
                self._aovs.setdefault(channel, {})[title] = planes[..., index].copy()

    def write_aovs(self, file_names):
        """Write each channel of all images as PNG files on a common scale; `file_names` maps titles to file name parts.
        Return channel -> "scale" and "files" (see results.schema.json)."""
        shown = {}
        for channel, values_of in self._aovs.items():
            ends, files = images.logarithmic_ends(values_of.values()), {}
            for title, values in values_of.items():
                files[title] = str(self.path(f"{file_names[title]}.{channel}", ".png"))
                images.write_png(files[title], images.false_colours(values, ends))
            shown[channel] = {"scale": ends, "files": files}
        return shown

    def path(self, file_name, suffix):
        """Return the path of a file of this scene."""
        return self.folder / f"{self.name}.{file_name}{suffix}"
