"""Tests of orbits, Sun, shadow, exclusion and resident space objects."""
