"""Direct light of emitters: by next-event estimation, or by iterative adaptive sampling [IAS].

``emitter_sampling`` stands by itself: one emitter sample and one BSDF sample, as in Mitsuba's ``path``
(``direct="nee"``).  All else is [IAS]: plugins ``adaptivedirect`` and ``unoccludeddirect``, and ``direct="adaptive"``.
How data flows, which is also the order to read in::

    emitters -> emitter_pieces, environment_regions -> sources, emitter_clusters -.
                                                                                   >- cluster_cuts -> site_table
    gather points -> sites -------------------------------------------------------'

    site_table -> passes (cluster_probabilities -> cluster_sampling, again and again) or all_sources -> radiance

- ``adaptive``: the driver: sites, groups and cuts of an image; what is sampled, and what is summed
- ``sources``: everything that lights directly as rows of arrays; ``emitter_pieces``: area emitters as triangles,
  parallelograms, disks and spheres; ``environment_regions``: the environment emitter as regions, which
  ``environment_strata`` finds (Agarwal et al. 2003)
- ``emitter_clusters``: cluster trees over sources [IAS section 4.3.1]; ``cluster_cuts``: the clusters that light a
  group of points, by solid angle [IAS section 4.3]
- ``sites``: blocks of 8 × 8 pixels, classes of normals [IAS section 4.1]; ``site_table``: sites, clusters and
  statistics as kernels read them
- ``cluster_probabilities``: the learned probability of each cluster, from the uniform, the block's and the pixel's
  function [IAS equations 4 to 6]
- ``cluster_sampling``: the kernels: a cluster, a source, a point on it, its shadow ray
- ``passes``: passes, their combination, and when a pixel is done [IAS sections 4.2, 5.8 and 5.9]
- ``all_sources``: the plain sum over all sources, where it is cheaper
- ``unoccluded_passes``: the reference method: a fixed density, proportional to unoccluded light [IAS section 5.1]
"""
