"""Foundations of all other packages: no light, no gather point, no method.

- ``arrays``: the only safe ways between NumPy and Dr.Jit (``upload``, ``download``); which values count as numbers
  (``usable``, ``finite_or_zero``); rows worked off in chunks that fit in memory (``chunks``)
- ``sampling``: seeds derived from seeds, samplers of any width, rows chosen by weight (``Choice``, ``RowChoice``,
  ``find_interval``), evenly spread samples (``SpreadSamples``)
- ``loops``: long loops of kernels, recorded once
- ``shared_code``: shapes that differ in numbers alone are compiled once
- ``garbage``: blocks that Python's cyclic collector does not disturb
- ``morton``: codes and orders along a Morton curve
- ``cones``: axes of cones around directions, and how their cosines are rounded
- ``stages``: names of a render's stages, by which its seconds are kept
- ``parameters``: parameters of scene objects, read without ``mitsuba.traverse``
- ``registry``: a number for each of some shapes or emitters
- ``exclusive``: objects that serve one thread at a time
- ``backend``: what has to be right underneath Mitsuba, checked before it goes wrong
"""
