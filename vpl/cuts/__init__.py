"""Cuts: Lightcuts [LC], Multidimensional Lightcuts [MDLC] and IlluminationCut [IC].

Each decides with bounds (:mod:`vpl.transport.bounds`) how coarse clusters may be, given what radiance is expected.

[LC], plugin ``lightcuts``: ``light_cuts`` alone: the radiance expected at each point (``estimate_radiance``), the cut
through the light tree (``limited_cuts``), its light (``evaluate_cuts``).

[MDLC], plugin ``mdlightcuts``: pairs of a gather node and a light node; gather trees are in
:mod:`vpl.points.gather_tree`::

    light_cuts (estimate_radiance) -> product_cuts (raise_thresholds, find_pairs) -> pixel_cuts

[IC], plugin ``illuminationcut``: pairs of a point node and a light node; the tree of points is in
:mod:`vpl.points.point_tree`::

    phase_one -> product_cuts (raise_thresholds, find_pairs) -> [adaptive_visibility ->] pair_lists

- ``product_cuts``: both trees descended at once [IC Algorithm 1]; ``Pairs``, ``find_pairs``
- ``pixel_cuts``: thresholds of pixels and of blocks of them; one point and one light for each pair
- ``phase_one``: Phase I, the approximate image [IC section 3]
- ``adaptive_visibility``: a few shadow rays for all points of a pair [IC Algorithm 2]
- ``pair_lists``: Phase II's pairs evaluated: every point walks the lists of its nodes
"""
