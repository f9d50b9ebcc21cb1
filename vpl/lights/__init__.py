"""From a scene's emitters to virtual lights and the trees over them [LC sections 3 and 5].

How data flows, which is also the order to read in::

    scene -> emitters -> emission -> tracing -> virtual_lights -> light_tree -> light_set
                                                                  (clustering)

- ``emitters``: a scene's emitters as rows of arrays (``Emitters``), so that no kernel calls emitter objects
- ``focus``: where the camera looks, and how far apart lights are there
- ``spheres``: what Mitsuba says wrongly of points on spheres
- ``emission``: rays that leave them, group by group
- ``perturbed``: surfaces with bump or normal maps, and how they scatter light paths
- ``tracing``: light paths; a virtual light at every diffuse bounce (instant radiosity)
- ``virtual_lights``: ``VirtualLights`` as NumPy arrays, ``DeviceLights`` as kernels fetch them, and ``geometry``: how
  their light arrives at a place
- ``clustering``: pairs of clusters merged bottom-up, whatever a merge costs; [LC] and [IAS] both use it
- ``light_tree``: the light tree of [LC], with representatives, boxes and cones; ``DeviceTree`` as kernels fetch it
- ``light_set``: ``LightSet``, all of the above for one render, in one ``LightGroup`` for each kind of light;
  extended emitters as virtual lights (``direct="vpl"``); what a representative stands for

Symbols of the papers: *light tree*, *cluster*, *representative light* and *cluster size* are in ``light_tree``.
"""
