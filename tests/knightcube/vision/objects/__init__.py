"""Tests of objects among the stars."""
