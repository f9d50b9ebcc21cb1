"""Split of the image of ``path``: virtual lights carry a part, paths trace the rest.  Plugin ``manylights``.

::

    pilot -> plan -> lights -> image                                                    (estimator)

    image: camera rays -> traced part, gather vertices -> clusters of a pixel -> light cuts -> radiance

The formula, in the order to read in:

- :mod:`vpl.transport.carried_share`: the share w of virtual lights
- ``minorant``: the Lambertian minorant of a BSDF, the diffuse part that virtual lights carry
- ``path_tracer``: paths as Mitsuba's ``path`` traces them, minus the part that virtual lights carry
- ``estimator``: the steps from the pilot to the image

The terms of the estimator:

- ``view``: camera rays, settings of their paths, streams of random numbers
- ``roulette``: Russian roulette, and how its probabilities are chosen
- ``gather_vertices``: vertices where virtual lights are added, which of them are lit, and both normalisations
- ``pixel_clusters``: one light cut for the vertices of a pixel that face the same way
- ``lattice``: stratified random numbers for the samples of a pixel
- ``emitters``: emitter samplers for next-event estimation
- ``spatial_cells``: cubes of space by facing, for values that are learned by place

The lights and the decisions:

- ``pilot``: a few whole paths, their relative variance, and the brightness of the image around them
- ``cost_model``: every constant of the decisions, with its unit and its evidence
- ``plan``: whether lights pay, how many, and how finely they are clustered
- ``line_sampling``: random lines that meet surfaces with a known density, where camera paths arrive
- ``line_hits``: surfaces that such lines meet, each counted once per crossing
- ``surface_lights``: a virtual light wherever such a line meets a surface; kept lights
- ``emitter_lights``: virtual lights that stand for many emitters
"""
