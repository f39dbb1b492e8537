"""Tests of the Sun sensor: frames and strings."""
