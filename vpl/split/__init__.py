"""Split of the image of ``path``: virtual lights carry a part, paths trace the rest.  Plugin ``manylights``.

::

    pilot -> plan -> lights -> image                                             (start, estimator)

    image: camera rays -> traced part, gather vertices -> clusters of a pixel -> light cuts -> radiance

The formula, in the order to read in:

- :mod:`vpl.transport.carried_share`: the share w of virtual lights
- :mod:`vpl.transport.minorant`: the Lambertian minorant of a BSDF
- ``path_tracer``: the paths of Mitsuba's ``path``, minus the part carried by virtual lights
- ``chosen_pilot``: the pilot, and how its paths find emitters: what is learned, glass, relays
- ``start``: the pilot and kinds of lights, shared by the passes of a render
- ``estimator``: the steps from the plan to the image

The terms of the estimator:

- ``camera_rays``: camera rays of a view, traced to the ends of their paths
- ``view``: camera rays, streams of random numbers
- ``path_state``: settings and edges of paths, the surfaces that they hit, the result
- ``emitter_samples``: numbers of emitter samples at first scattering vertices
- ``roulette``: Russian roulette and the choice of its probabilities
- ``contributions``: sums of the contributions of paths, for the image and for its layers
- ``gather_vertices``: vertices where virtual lights are added, the choice of lit vertices, and both normalisations
- ``pixel_clusters``: a light cut for the vertices of a pixel with similar normals
- ``spread_light``: a part of the light of virtual lights, divided among the camera rays of a pixel
- ``pixel_rays``: numbers of camera rays of pixels, which may differ
- ``film_cells``: the rays of the pixels of a film that is finer than the image
- ``lattice``: stratified random numbers for the samples of a pixel
- ``emitters``: emitter samplers for next-event estimation
- ``covered``: directions at bump and normal maps, which cover the lobes of virtual lights
- ``turning``: how paths go on in new directions
- ``relays``: glass and mirrors by way of which light arrives, as targets of paths
- ``relays_found``: which glass and mirrors, and how much light arrives by each
- ``onward``: directions in which paths go on: of the BSDF, or to relays
- ``paths_from_places``: paths that find the irradiance of places on surfaces
- ``spatial_cells``: cubes of space by facing, for values learned by place

The lights and the decisions:

- ``pilot``: a few whole paths, the relative variance, the brightness of the image nearby, the sampler of the lines
- ``cost_model``: every constant of the decisions, with unit and evidence
- ``cost_table``: the constants as a table
- ``plan``: whether lights pay, the number of lights, and the fineness of the clusters
- ``arrival_octree``: boxes around the arrivals of camera paths
- ``line_sampling``, ``line_density``: random lines through the boxes, and their density on surfaces
- ``local_c``: c of the share w by place, from this density
- ``line_hits``: crossings of random lines with surfaces, each counted once
- ``surface_lights``: a virtual light at each crossing of a line with a surface; kept lights
- ``emitter_lights``: virtual lights representing many emitters
"""
