"""The sky index of guide stars and of the triangles that they form, in memory-mapped files."""
