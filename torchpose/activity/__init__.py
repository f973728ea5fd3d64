"""The activity column: sequences of features in, activities out (T. 4.2 to 4.4).

`dataset` (clips, splits), `skeleton` and `subspace` (what features are computed from), `features`, `codebook`,
`inference` and `hmm`, `recognizer`. It imports nothing of the pose column: the two meet in `Clip`.
"""
