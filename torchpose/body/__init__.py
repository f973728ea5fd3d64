"""The body: a kinematic tree from a readable file, ellipsoids and super-quadrics on it, angles out of it."""
