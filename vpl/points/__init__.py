"""From camera rays to gather points, and the trees and slices that group these.

How data flows, which is also the order to read in::

    camera rays -> camera_paths -> bsdf_proxies -> surfaces -> point_tree, gather_tree,  -> point_clusters
                                                               slices or slice_rows

- ``camera_paths``: camera rays through mirrors, glass and masks to ``GatherPoints``; what a scene's surfaces can do
  (``SceneTraits``); how rays lie in the image (``PixelGrid``)
- ``bsdf_proxies``: an upper bound of each point's material, found by probing it; for bounds and nothing else
- ``surfaces``: gather points as kernels shade them, a ``Batch`` of Lambertian ones and one of all others; ``Receiver``:
  what bounds know of them
- ``point_tree``: the binary tree over all gather points, ``PointTree`` [IC section 3]
- ``gather_tree``: a tree for the points of each pixel, as branches of one [MDLC]
- ``slices``: points in slices, by place and normal [LS]; ``slice_rows``: slices with a bounded number of rows, and the
  curve and plane along which rows lie [MSR section 4.1]
- ``point_clusters``: any of these trees on the device (``PointClusters``), with boxes, cones and largest values for
  each node

The trees are built by NumPy from plain arrays, and tested without rendering anything.
"""
