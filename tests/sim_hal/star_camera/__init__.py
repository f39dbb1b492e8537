"""Tests of the star camera's image model."""
