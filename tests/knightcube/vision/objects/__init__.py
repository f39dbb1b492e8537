"""Tests of the detection of objects among stars."""
