"""Comparison of this checkout's flight logs with those of another revision, packet by packet."""
