"""The light matrix, with a row per gather point and a column per light: LightSlice [LS], matrix recovery [MSR].

[LS], plugin ``lightslice``: sampled rows determine the columns of each slice::

    slices (vpl.points) -> column_forest -> light_matrix -> slice_columns

- ``column_forest``: columns, which are clusters of lights, with the light trees above them in one forest
- ``light_matrix``: sampled rows, and the cost of joining columns
- ``slice_columns``: shared columns (global clustering), columns of each slice (refinement), representative lights

[MSR], plugin ``matrixrecovery``: the reduced matrix of each slice, with mostly predicted visibility::

    slice_rows (vpl.points) -> reduced_matrix -> reduced_columns -> visibility_samples -> visibility_prediction
                            -> recovery (matrix_block, separation) -> light

- ``reduced_matrix``: rows, columns and entries E V of reduced matrices [MSR section 3]
- ``reduced_columns``: the initial cut, and the splitting of clusters [MSR section 4.2, algorithm 1]
- ``visibility_samples``: traced entries
- ``visibility_prediction``: three predictors of the remaining entries [MSR section 5, algorithm 2]
- ``matrix_block``: the matrices of some slices in one dense array
- ``separation``: low-rank part and sparse errors [MSR section 6, equations 11 and 12]
- ``recovery``: prediction, separation and correction in sequence
"""
