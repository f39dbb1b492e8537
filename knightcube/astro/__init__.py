"""Quaternions, directions and array types; attitude from directions, the Earth, and the star catalogue."""
