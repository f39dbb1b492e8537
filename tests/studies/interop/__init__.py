"""Comparisons of our own reader with other authors' ground software on the same run."""
