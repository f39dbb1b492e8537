"""Drawings upon pictures of the sky and of the horizon."""
