"""Foundations of the other packages, independent of lights, gather points and methods.

- ``arrays``: safe copies between NumPy and Dr.Jit (``upload``, ``download``), validity of values (``usable``,
  ``finite_or_zero``), chunks of rows that fit in memory (``chunks``)
- ``sampling``: derived seeds, samplers of any width, discrete distributions (``Choice``, ``RowChoice``,
  ``GuidedSums``, ``find_interval``), low-discrepancy samples (``SpreadSamples``)
- ``loops``: kernel loops recorded once
- ``shared_code``: kernels shared by shapes that differ only in numbers
- ``garbage``: code blocks without Python's cyclic garbage collector
- ``morton``: codes and orders along a Morton curve
- ``cones``: axes of direction cones, rounding of cone cosines
- ``path_limits``: where paths end, as in Mitsuba's ``path``: the longest path and Russian roulette by throughput
- ``clock``: seconds of a render by stage
- ``compilation``: seconds that Dr.Jit compiles kernels
- ``stages``: names of the stages of a render, keys of its timings
- ``parameters``: parameters of scene objects, read without ``mitsuba.traverse``
- ``meshes``: triangles of meshes, by the names that Mitsuba gives them
- ``shapes``: shapes of a scene and of its shape groups, by their index in Mitsuba's registry
- ``interactions``: where rays meet surfaces
- ``instances``: instances of shape groups of triangles
- ``registry``: table from shapes, emitters or materials to numbers
- ``materials``: calls of the materials of a scene's surfaces, without the code of other materials
- ``exclusive``: objects for use by one thread at a time
- ``backend``: checks of the system libraries below Mitsuba
"""
