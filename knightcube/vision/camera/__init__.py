"""Camera models, and the reading and writing of image files."""
