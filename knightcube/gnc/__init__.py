"""Estimation, guidance, control, and the tracking of objects."""
