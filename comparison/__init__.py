"""Parts of `manylights.py` and `compare.py`: loading scenes, rendering them in passes, images, errors, and reports.

`scene_files`   parse a scene file, change its integrator or its size, and load it
`rendering`     average passes of different seeds, within samples or seconds
`render`, `pass_sizes`, `convergence`, `interruption`
                an image that ends by itself: passes of some seconds, the error that is left, Ctrl-C
`checkpoint`    what a render goes on from that was not finished
`one_image`, `batch`
                an image of the command, rendered here or by workers; which images, of frames, scenes and sensors
`occasional`    files that are written every now and then
`cluster/`      passes and runs on several processes or machines
`denoising`     Open Image Denoise, and the albedo and normals that guide it
`images`        EXR files with metadata, tone mapping, false colours
`metrics`       how far an image is from a reference
`references`    references from files, and path-traced ones that are kept and continued
`worker`        render and measure one integrator in a process of its own
`runs`          finished runs, kept to go on after an interruption
`sweeps`        which parameters integrators are rendered with, and in which order
`scene_comparison`, `progress`
                all runs on one scene; how far they are
`curves`, `analysis`
                error against time and rays: means, intervals, what is read off; from runs to these
`quantities`, `published_table`, `published`, `paper_tables`
                what the papers' tables list; their figures; the same tables from runs
`tables`, `report`, `plots`, `pictures`, `page_images`, `page`
                tables, `results.json` (`results.schema.json`) and `report.html`
`strip`         pictures beside each other, for a paper
`baseline`      have speed-ups fallen since an earlier comparison?
`machine`       processor, load, versions
`command_line`  what the two commands' options and error messages have in common
"""

import os

# FLIP's threads would otherwise wait for each other in a busy loop: a hundred times slower on a loaded machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
