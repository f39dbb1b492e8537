"""Tests of the image model of the star camera."""
