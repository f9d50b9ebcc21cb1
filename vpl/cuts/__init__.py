"""Cuts: Lightcuts [LC], Multidimensional Lightcuts [MDLC] and IlluminationCut [IC].

Each method chooses how coarse clusters may be, from error bounds (:mod:`vpl.transport.bounds`) and a radiance estimate.

[LC], plugin ``lightcuts``, uses ``light_cuts`` and ``traversal``: the radiance estimate of each point
(``estimate_radiance``), the cut through the light trees (``limited_cuts``), and its radiance (``evaluate_cuts``).

[MDLC], plugin ``mdlightcuts``, uses pairs of a gather node and a light node; gather trees are in
:mod:`vpl.points.gather_tree`::

    light_cuts (estimate_radiance) -> product_cuts (raise_thresholds, find_pairs) -> pixel_cuts

[IC], plugin ``illuminationcut``, uses pairs of a point node and a light node; the tree of points is in
:mod:`vpl.points.point_tree`::

    phase_one -> product_cuts (raise_thresholds, find_pairs) -> [adaptive_visibility ->] pair_lists

- ``traversal``: traversal of a light tree for many points, which stores the nodes of their cuts
- ``product_cuts``: simultaneous descent of both trees [IC Algorithm 1]; ``Pairs``, ``find_pairs``
- ``pixel_cuts``: thresholds of pixels and of blocks of pixels; a representative point and light for each pair
- ``phase_one``: Phase I, the approximate image [IC section 3]
- ``adaptive_visibility``: few shadow rays for many points of a pair [IC Algorithm 2]
- ``pair_lists``: evaluation of Phase II's pairs: every point traverses the lists of its nodes
"""
