"""Tests of `knightcube.reference.corner_streaks`."""
