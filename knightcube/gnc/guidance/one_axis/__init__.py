"""Guidance about one axis by virtual motion camouflage in q2 (Sease 2013, eqs. (5.8) to (5.15))."""
