"""Guidance of a free satellite: attitude laws, the references that they give, and slews at the optimum."""
