"""The sky index: guide stars, their pairs and triangles, in memory-mapped files."""
