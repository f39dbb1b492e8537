"""Tests of the Earth, its field and orbits around it."""
