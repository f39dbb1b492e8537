"""Tests of star identification."""
