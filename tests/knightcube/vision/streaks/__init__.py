"""Tests of the package `knightcube.vision.streaks`."""
