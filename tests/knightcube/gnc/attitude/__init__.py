"""Tests of the fusion of Sun, nadir, field and gyros, and of what it refers to."""
