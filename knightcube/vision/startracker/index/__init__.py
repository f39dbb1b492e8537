"""The sky index: guide stars and their triangles, in memory-mapped files."""
