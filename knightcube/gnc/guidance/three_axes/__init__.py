"""Guidance of a free satellite: attitude laws, their reference motions, and optimal slews."""
