"""Nadir by the circular horizon and by the Graphic Method (Meller et al., chapter 3)."""
