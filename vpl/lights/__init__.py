"""From a scene's emitters to virtual lights and light trees [LC sections 3 and 5].

Data flow and reading order::

    scene -> emitters -> emission -> tracing -> virtual_lights -> light_tree -> device_tree -> light_set
                                                                  (clustering)

- ``emitters``: a scene's emitters in flat arrays (``Emitters``), because kernels must not call emitter objects
- ``unbound_emitters``: those that are no shapes and no environment
- ``emitter_groups``: named groups of emitters, for images of the light of each group
- ``focus``: the part of the scene that the camera sees, and the distances between lights there
- ``spheres``: corrections of Mitsuba's samples on spheres
- ``emission``: emitter samplers, which start light paths
- ``perturbed``: light paths at surfaces with bump or normal maps
- ``tracing``: light paths with a virtual light at every diffuse bounce (instant radiosity)
- ``virtual_lights``: ``VirtualLights`` in NumPy arrays, ``DeviceLights`` for kernels, and ``geometry``, the geometric
  factor between a light and a point
- ``clustering``: bottom-up clustering with any merge cost, for [LC] and [IAS]
- ``light_tree``: the light tree of [LC] with representative lights, boxes and cones
- ``device_tree``: ``DeviceTree``, a light tree in kernels, and its ``Node``
- ``light_set``: ``LightSet``, the lights of a render with one ``LightGroup`` per kind; emitters with an extent turned
  into virtual lights (``direct="vpl"``); scale factors of representative lights

Module ``light_tree`` defines the papers' terms *light tree*, *cluster*, *representative light* and *cluster size*.
"""
