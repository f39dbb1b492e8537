"""Tests of the satellite in orbit."""
