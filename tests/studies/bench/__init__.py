"""Tests of the KnightCube flight software."""
