"""Tests of the Earth, its magnetic field and orbits around the Earth."""
