"""Light from virtual lights to gather points: contributions, visibility, bounds and expected errors of clusters.

In the order to read in:

- ``carried_share``: the share w of the light between two surfaces that virtual lights carry
- ``minorant``: the Lambertian minorant of a BSDF and its lobe, the diffuse part that virtual lights carry
- ``contribution``: the formula for the contribution of a light to a point, BSDF × cosine × geometry × intensity, and
  the shadow ray between them
- ``bounds``: upper bounds of the contribution of a cluster of lights to a point or a cluster of points
  [LC section 4.1; IC section 4], and the expected error of a light that represents the cluster
- ``evaluation``: shades and traces pairs of a point and a light (``evaluate_pairs``), lists of lights in step
  (``sum_lights``), and every light (``sum_all_lights``, the oracle of every method); ``Transport``: the scene, the
  traits of surfaces, the lights

Data: surfaces of :mod:`vpl.points`, lights of :mod:`vpl.lights` -> radiance and shadow rays per pair or per point.
"""
