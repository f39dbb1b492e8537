"""Guidance about one axis: virtual motion camouflage in q2 (Sease 2013, 5.8-5.15)."""
