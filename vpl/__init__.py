"""Virtual lights, light trees, gather points, bounds and evaluation: the parts that many-light integrators share.

Data flows one way: scene -> lights -> tree -> cut -> image.  Nothing here knows an integrator.
"""
