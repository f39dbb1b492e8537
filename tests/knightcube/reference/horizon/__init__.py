"""Tests of the horizon methods kept for comparison."""
