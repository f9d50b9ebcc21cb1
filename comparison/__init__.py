"""What `manylights.py` and `compare.py` share: loading scenes, rendering them in passes, images, errors, and reports.

`scene_files`  parse a scene file, change its integrator or its size, and load it
`rendering`    average passes of different seeds, within samples or seconds
`images`       EXR files with metadata, tone mapping, false colours
`metrics`      how far an image is from a reference (NumPy only)
`references`   references from files, and path-traced ones that are kept and continued
`worker`       render and measure one integrator in a process of its own
`report`       the table, `results.json` and `report.html`
`command_line` what the two commands' options and error messages have in common
"""
