"""Drawings upon pictures."""
