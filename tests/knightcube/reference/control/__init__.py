"""Tests of the controllers kept for comparison."""
