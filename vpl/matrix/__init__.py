"""The light matrix, a row for each gather point and a column for each light: LightSlice [LS], matrix recovery [MSR].

[LS], plugin ``lightslice``: the columns of each slice of rows, from sampled rows::

    slices (vpl.points) -> column_forest -> light_matrix -> slice_columns

- ``column_forest``: clusters of lights as columns, the light trees above them as one forest
- ``light_matrix``: sampled rows, and what it costs to join columns
- ``slice_columns``: the columns that all slices share (global clustering), then those of each slice (refinement); the
  lights that stand for them

[MSR], plugin ``matrixrecovery``: the reduced matrix of each slice, most of whose visibility is predicted::

    slice_rows (vpl.points) -> reduced_matrix -> reduced_columns -> visibility_samples -> visibility_prediction
                            -> recovery (matrix_block, separation) -> light

- ``reduced_matrix``: the reduced matrix of a slice; rows, columns and entries E V [MSR section 3]
- ``reduced_columns``: the initial cut, and which clusters are split [MSR section 4.2, algorithm 1]
- ``visibility_samples``: the entries that were traced
- ``visibility_prediction``: three predictors of all others [MSR section 5, algorithm 2]
- ``matrix_block``: the matrices of some slices as one dense array
- ``separation``: a part of low rank and sparse errors [MSR section 6, equations 11 and 12]
- ``recovery``: prediction, separation, correction: these steps, one after another
"""
