"""Renders as NumPy arrays."""

from contextlib import contextmanager

import mitsuba as mi
import numpy as np

from vpl.split.cost_model import CostModel

# Most tests compare images of equal seeds: with the camera rays of ``path``, differences have less variance
USUAL = {"manylights": {"stratified": False}}


def render(scene, integrator, spp=4, seed=0, **more):
    """Render to NumPy, (height, width, channels) float64; plugins by name have the parameters USUAL."""
    plugin = _plugin(integrator, more) if isinstance(integrator, str) else integrator
    return np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)


def render_with_statistics(name, scene, spp=1, seed=0, **more):
    """An image by the plugin of a name, with the parameters USUAL, and the statistics of its render."""
    plugin = _plugin(name, more)
    return render(scene, plugin, spp, seed), plugin.statistics


def _plugin(name, parameters):
    return mi.load_dict({"type": name} | USUAL.get(name, {}) | parameters)


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
