"""Comparison of this checkout's logs with those of another revision, packet by packet."""
