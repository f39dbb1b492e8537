"""Tests of guidance, navigation and control."""
