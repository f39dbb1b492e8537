"""Guidance of a free satellite: attitude laws, and the references that they give."""
