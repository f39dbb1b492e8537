"""Tests of the library knightcube."""
