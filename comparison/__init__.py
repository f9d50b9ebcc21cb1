"""Modules of `manylights.py` and `compare.py`: scene files, rendering in passes, images, errors, reports.

`scene_files`   parse a scene file, change its integrator or size, load it
`single_pass`, `rendering`
                a pass; the average of passes with different seeds
`measuring`     passes of a comparison, for samples or seconds
`counters`      sums of the integrators' counters over passes
`render`, `pass_sizes`, `timed_sizes`, `convergence`, `ending`, `interruption`
                render until a time or an error: pass sizes, error estimate, end, Ctrl-C
`checkpoint`    state of an unfinished render
`one_image`, `batch`
                an image of the command, rendered locally or by workers; batches of frames, scenes and sensors
`occasional`    files written periodically
`cluster/`      passes and runs on several processes or machines
`denoising`     Open Image Denoise with albedo and normal
`detail`        detail that the denoiser removes, from the raw image
`fine_film`     films of twice the resolution for images that will be denoised
`sample_density`
                more samples where the denoiser leaves noise
`features`      albedo, normal and depth, for the denoiser and as layers of images
`images`        EXR files with metadata, tone mapping, false colours
`metrics`       errors against a reference
`references`    references from files, and cached path-traced references
`worker`        render and measure an integrator in a separate process
`runs`          finished runs, for resuming
`sweeps`        settings of integrators and the order of runs
`scene_comparison`, `progress`
                all runs on a scene; progress display
`curves`, `analysis`
                error against time and rays: means, intervals, interpolation; curves from runs
`quantities`, `published_table`, `published`, `paper_tables`
                quantities and figures of the papers' tables; the same tables from runs
`tables`, `report`, `plots`, `pictures`, `page_images`, `page`
                tables, `results.json` (`results.schema.json`) and `report.html`
`strip`         a row of pictures for a paper
`baseline`      regression test of speed-ups
`machine`       processor, load, versions
`threads`       limits of threads
`command_line`  common options and error messages of the two commands
"""

import os

# By default threads of FLIP wait in a busy loop, which is a hundred times slower on a loaded machine
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
