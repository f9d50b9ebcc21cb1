"""Passes of images, and runs of comparisons, on several processes or machines, by `dask.distributed`.

``compatibility``   admission of workers: properties that must be equal, and properties with a warning
``scene_names``     files that a scene names
``scene_travel``    scenes as files with hashes, and their transfer to workers
``worker``          code on a worker, which keeps scenes and compiled kernels between passes
``pool``            available workers, two tasks for each, and the reassignment of lost tasks
``passes``          the passes of an image, summed in the order of their seeds
``render``          an image in passes on workers
``runs``            the runs of a comparison
``connection``      local worker processes, or a scheduler on the network
"""
