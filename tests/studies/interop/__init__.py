"""Comparisons of a run as other authors' ground software reads it with the same run in our own reader."""
