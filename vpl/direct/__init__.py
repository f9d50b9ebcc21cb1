"""Direct light of emitters: by next-event estimation, or by iterative adaptive sampling [IAS].

``emitter_sampling`` is independent of the other modules: next-event estimation as in Mitsuba's ``path``
(``direct="nee"``).  The other modules implement [IAS] for the plugins ``adaptivedirect`` and ``unoccludeddirect`` and
for ``direct="adaptive"``.  Data flow, and reading order::

    emitters -> emitter_pieces, environment_regions -> sources, emitter_clusters -.
                                                                                   >- cluster_cuts -> site_table
    gather points -> sites -------------------------------------------------------'

    site_table -> passes (cluster_probabilities -> cluster_sampling, again and again) or all_sources -> radiance

- ``adaptive``: driver.  Builds sites, groups and cuts of an image, then samples or sums the sources of each group
- ``sources``: arrays of the sources of direct light
- ``emitter_pieces``: area emitters cut into triangles, parallelograms, disks and spheres
- ``environment_cells``: cells of the environment emitter with their light, for its regions
- ``environment_regions``: the environment emitter cut into regions, by the strata of ``environment_strata`` [SIS]
- ``emitter_clusters``: cluster trees over sources [IAS section 4.3.1]
- ``cluster_cuts``: clusters that light a group of points, by solid angle [IAS section 4.3]
- ``sites``: blocks of 8 × 8 pixels and classes of normals [IAS section 4.1]
- ``site_table``: arrays of sites, clusters and statistics for kernels
- ``cluster_probabilities``: learned cluster probabilities: a blend of the uniform, block and pixel functions [IAS
  equations 4 to 6]
- ``cluster_sampling``: kernels that draw a cluster, a source, a point on the source, and trace the shadow ray
- ``passes``: passes, their combination, and the stopping rule of a pixel [IAS sections 4.2, 5.8 and 5.9]
- ``all_sources``: the plain sum over all sources, for groups with few
- ``unoccluded_passes``: reference method, with a fixed density proportional to unoccluded light [IAS section 5.1]
"""
