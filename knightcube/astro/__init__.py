"""Astronomy and attitude: quaternions, attitude from directions, Earth and Sun models, star catalogue."""
