"""Tests of the methods kept for comparison."""
