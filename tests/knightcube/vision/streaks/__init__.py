"""Mirrors `knightcube.vision.streaks`."""
