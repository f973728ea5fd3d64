"""The activity column: sequences of features in, activities out (T. 4.2 to 4.4).

In the order of their imports: `dataset` (clips, splits), `skeleton` and `subspace` (what features are made
of), `features`, `inference`, `hmm`, `codebook`, `recognizer`. Nothing of the pose column is imported: the two
columns meet in `Clip`.
"""
