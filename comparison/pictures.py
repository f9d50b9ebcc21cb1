"""The pictures of one scene's comparison: PNG files, and what the report's page shows."""

from . import images, metrics, page_images

REFERENCE = "reference"  # what its picture is called
DISTANCE_FACTOR = 16  # of the images of Euclidean distance, as in the paper on IlluminationCut


class Pictures:
    """Pictures of a scene called `name`, written to `folder`.

    `views` is a list for the page: a dict an image with "title", "label", "image", "error" (text, "" without one),
    "exr" (name of a file beside the page), and, if it has a reference, "maps": from the kind ("relative", "signed",
    "distance", "flip") to what page_images.py makes of it. `stills` are (title, error, data URL), for where no scripts
    run. The first image that is shown chooses the exposure of all, `exposure`.
    """

    def __init__(self, folder, name):
        self.folder, self.name = folder, name
        self.exposure, self.views, self.stills, self.block = None, [], [], 1
        self._aovs = {}  # channel -> title -> values, (height, width)

    def show(self, title, label, file_name, exr, image, reference=None, flip=None, error=""):
        """Show an image, (height, width, 3) linear, of an integrator's label (None: the reference), which is in the
        file `exr`; if it has a reference also its errors, `flip` being the map of metrics.flip."""
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
        """Keep those channels of an image that are AOVs out of `wanted`, until `write_aovs`."""
        for index, channel in enumerate(channels):
            if channel.partition(".")[0] in wanted:  # "aov", or "aov.R" of one that is a colour
                self._aovs.setdefault(channel, {})[title] = planes[..., index].copy()

    def write_aovs(self, file_names):
        """Draw each channel on one scale for all images; `file_names` maps titles to parts of names of files. Return a
        dict from channel to "scale" and "files" (see results.schema.json), {} if there are no channels."""
        shown = {}
        for channel, of in self._aovs.items():
            ends, files = images.logarithmic_ends(of.values()), {}
            for title, values in of.items():
                files[title] = str(self.path(f"{file_names[title]}.{channel}", ".png"))
                images.write_png(files[title], images.false_colours(values, ends))
            shown[channel] = {"scale": ends, "files": files}
        return shown

    def path(self, file_name, suffix):
        """Return the path of a file of this scene."""
        return self.folder / f"{self.name}.{file_name}{suffix}"
