"""Tests of the reference methods that are kept for comparison."""
