"""Tests of the star catalogue."""
