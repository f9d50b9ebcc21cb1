"""The parts that many-light integrators share, and those of single methods; nothing here knows an integrator.

Data flows one way: a scene's emitters send out light paths, which leave virtual lights, over which trees are built;
camera rays end at gather points, over which trees are built too; a method decides which lights stand for which at which
points; pairs of a point and a light are shaded, their shadow rays traced, and what arrives is summed.

Packages, each of which imports only from those above it (tests/documents/test_layers.py):

=============  =================================================================================================
``core``       arrays between NumPy and Dr.Jit, random numbers, Morton codes, parameters of scene objects, the backend
``lights``     emitters, light paths, virtual lights, light trees; all lights of one render
``points``     camera paths, gather points, their surfaces and materials' bounds, trees over them, slices
``transport``  what a light sends to a point, whether it arrives, bounds on what a cluster sends
``direct``     direct light of emitters: next-event estimation, and adaptive sampling with learned probabilities [IAS]
``cuts``       Lightcuts, Multidimensional Lightcuts, IlluminationCut: [LC], [MDLC], [IC]
``matrix``     LightSlice and matrix sampling and recovery: [LS], [MSR]
``split``      the image of ``path`` from virtual lights and what they leave out: the plugin ``manylights``
=============  =================================================================================================

To read one method, begin with its plugin in ``integrators/`` (the method ``shade``), then with the map that the
``__init__`` of its package holds.

- [LC] Walter et al. 2005, "Lightcuts: a scalable approach to illumination"
- [MDLC] Walter et al. 2006, "Multidimensional lightcuts"
- [IAS] Donikian et al. 2006, "Accurate direct illumination using iterative adaptive sampling"
- [LS] Ou and Pellacini 2011, "LightSlice: matrix slice sampling for the many-lights problem"
- [MSR] Huo et al. 2015, "A matrix sampling-and-recovery approach for many-lights rendering"
- [IC] Bus, Mustafa and Biri 2015, "IlluminationCut"
"""
