"""Attitude, estimation, guidance, control, and the tracking of objects."""
