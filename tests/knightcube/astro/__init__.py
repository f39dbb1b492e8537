"""Tests of the flight application's pure mathematics."""
