"""The same image, rendered by workers and in one process."""

import manylights
from comparison import one_image
from comparison.cluster.render import DistributedRender
from comparison.scene_files import SceneFile
from tests.support.paths import CORNELL

TINY = {"resx": "16", "resy": "16"}


def prepared(pool, integrator="path", **more):
    file = SceneFile(CORNELL, TINY)
    file.set_integrator(integrator)
    return DistributedRender(pool, one_image.LazyScene(file), seed=5, pass_spp=4, **more)


def in_one_process():
    scene = SceneFile(CORNELL, TINY).load(1)
    return manylights.render(scene, spp=200, pass_spp=4, seed=5)[0].numpy()
