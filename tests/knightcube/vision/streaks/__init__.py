"""Tests of `knightcube.vision.streaks`."""
