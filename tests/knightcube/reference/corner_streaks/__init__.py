"""Mirrors `knightcube.reference.corner_streaks`."""
