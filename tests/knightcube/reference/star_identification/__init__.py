"""Tests of the classical star identification."""
