"""Tests of the sky index."""
