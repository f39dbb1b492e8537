"""Compares the logs of this checkout with those of another revision, packet by packet."""
