"""The body: a kinematic tree from a readable file, spheroids and super-quadrics on it, angles out of it."""
