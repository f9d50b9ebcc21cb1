"""Renders as NumPy arrays."""

from contextlib import contextmanager

import mitsuba as mi
import numpy as np

from vpl.split.cost_model import CostModel


def render(scene, integrator, spp=4, seed=0, **more):
    """Render to NumPy, (height, width, channels) float64."""
    plugin = mi.load_dict({"type": integrator, **more}) if isinstance(integrator, str) else integrator
    return np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)


def render_with_statistics(name, scene, spp=1, seed=0, **more):
    """An image by the plugin of a name, and the statistics of its render."""
    plugin = mi.load_dict({"type": name, **more})
    return render(scene, plugin, spp, seed), plugin.statistics


@contextmanager
def plugin_with_model(**constants):
    """While the block runs, the plugin ``manylights`` decides by a cost model with other ``constants``."""
    from integrators.manylights import ManyLightsIntegrator  # needs a variant

    model = CostModel(**constants)
    mi.register_integrator("manylights", lambda props: ManyLightsIntegrator(props, model))
    try:
        yield
    finally:
        mi.register_integrator("manylights", ManyLightsIntegrator)
