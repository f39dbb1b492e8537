"""Guidance: planning of energy-optimal paths from a state estimate, and selection of the path to follow."""
