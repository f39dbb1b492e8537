"""Tests of attitude, Earth and star catalogue computations."""
