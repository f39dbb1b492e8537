"""The nadir methods of Meller et al. that fit a circle."""
