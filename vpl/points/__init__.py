"""From camera rays to gather points, and trees and slices of gather points.

Data flow and reading order::

    camera rays -> camera_paths -> bsdf_proxies -> surfaces -> point_tree, gather_tree,  -> point_clusters
                                                               slices or slice_rows

- ``camera_paths``: camera rays through mirrors, glass and masks to ``GatherPoints``; capabilities of a scene's surfaces
  (``SceneTraits``); layout of camera rays in the image (``PixelGrid``)
- ``alpha``: camera rays that are opaque in the film's alpha
- ``bsdf_proxies``: upper bounds of materials, found by probing, for error bounds only
- ``surfaces``: gather points for kernels, in a ``Batch`` of Lambertian points and a ``Batch`` of the remaining points;
  ``Receiver``: points or nodes for error bounds
- ``point_tree``: ``PointTree``, the binary tree over gather points [IC section 3]
- ``gather_tree``: a tree over the points of every pixel, joined in one ``PointTree`` [MDLC]
- ``slices``: groups of points by position and normal [LS]; ``slice_rows``: slices with a bounded number of rows, and
  the order of rows along a curve in a plane [MSR section 4.1]
- ``point_clusters``: ``PointClusters``, the device form of any of these trees, with boxes, cones and maxima of nodes

NumPy builds the trees from plain arrays; their tests render nothing.
"""
