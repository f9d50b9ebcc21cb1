"""Passes of one image, many images and comparisons on several processes or machines, by `dask.distributed`.

``compatibility``   which workers may take part: what must be the same as here, and what is only noted
``scene_travel``    scenes as files with their hashes, and how a worker gets those that it lacks
``worker``          what runs on a worker, which keeps scenes and compiled kernels between passes
``pool``            the workers that there are, two tasks for each, and what becomes of the tasks of one that dies
``passes``          the passes of an image, added up in the order of their seeds
``runs``            the runs of a comparison
``connection``      worker processes of our own, or a scheduler on the network
"""
