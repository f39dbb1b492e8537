"""Tests of the package ground.campaigns."""
