"""Components of the many-light integrators. No module here imports an integrator.

Data flow: light paths start at the emitters of a scene and deposit virtual lights, which light trees cluster. Camera
rays end at gather points, which point trees cluster. A method selects representative lights for each gather point.
The renderer then shades pairs of a point and a light, traces a shadow ray for each pair, and sums the contributions.

A package imports only from packages above it in this table (tests/documents/test_layers.py):

=============  =================================================================================================
``core``       arrays between NumPy and Dr.Jit, random numbers, Morton codes, parameters of scene objects, the backend
``lights``     emitters, light paths, virtual lights, light trees; all lights of a render
``points``     camera paths, gather points, surfaces, bounds of materials, point trees, slices
``transport``  contribution of a light to a point, its visibility, upper bounds for clusters
``direct``     direct light of emitters: next-event estimation, adaptive sampling with learned probabilities [IAS]
``cuts``       Lightcuts, Multidimensional Lightcuts, IlluminationCut: [LC], [MDLC], [IC]
``matrix``     LightSlice and matrix sampling and recovery: [LS], [MSR]
``split``      the image of ``path`` from virtual lights and a traced remainder: the plugin ``manylights``
=============  =================================================================================================

To read a method, start at ``shade`` of its plugin in ``integrators/`` and continue with the overview in the
``__init__`` of its package.

- [LC] Walter et al. 2005, "Lightcuts: a scalable approach to illumination"
- [MDLC] Walter et al. 2006, "Multidimensional lightcuts"
- [IAS] Donikian et al. 2006, "Accurate direct illumination using iterative adaptive sampling"
- [LS] Ou and Pellacini 2011, "LightSlice: matrix slice sampling for the many-lights problem"
- [MSR] Huo et al. 2015, "A matrix sampling-and-recovery approach for many-lights rendering"
- [IC] Bus, Mustafa and Biri 2015, "IlluminationCut"
"""
