"""Comparison of a run as ground software of other authors reads it with our own reader."""
