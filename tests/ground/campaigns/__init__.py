"""Tests of ground.campaigns."""
