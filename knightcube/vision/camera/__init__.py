"""Cameras as geometry, and image files as arrays."""
