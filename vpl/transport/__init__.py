"""Light between virtual lights and gather points: what one sends, whether it arrives, how much a cluster can send.

In the order to read in:

- ``contribution``: the one formula for what a light sends to a point, BSDF × cosine × geometry × intensity, and the one
  way in which a shadow ray between them is traced
- ``bounds``: upper bounds of what a cluster of lights sends to a point or a cluster of points
  [LC section 4.1; IC section 4]
- ``evaluation``: pairs of a point and a light, shaded and traced: by pairs (``evaluate_pairs``), by lists in step
  (``sum_lights``), of all lights (``sum_all_lights``, the oracle of all methods); ``Transport``, what all of these
  take: the scene, the traits of its surfaces, the lights

Data: surfaces of :mod:`vpl.points`, lights of :mod:`vpl.lights` -> radiance and shadow rays per pair or per point.
"""
